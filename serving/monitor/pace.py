"""How fast a loop is, and how long it is learnt: from its period and the evidence of its validation."""

from __future__ import annotations

from math import ceil

from loopwright.serving.manifest import Manifest

SETTLE, LEAST_SETTLE, MOST_SETTLE = 100, 20, 2000  # scans
DEAD, MOST_DEAD = 2, 200  # scans
DAY_S, WEEK_S = 86_400.0, 7 * 86_400.0
LEARN_S = 3 * DAY_S  # that rests and blocks are learnt at least: loads of a fast plant need not be fast
FINE_S = DAY_S  # that the fewest figures of a fast plant last at least
NOISE = "_noise"  # how the names of the validation's tests with noise end


def settle_scans(m: Manifest) -> int:
    """Scans of a settling time: the median over the evidence's tests without noise, which would hide it."""
    rows = m.evidence.get("scenarios")
    known = {n: row for n, row in rows.items() if isinstance(row, dict)} if isinstance(rows, dict) else {}
    found = [row.get("settling") for name, row in known.items() if not name.endswith(NOISE)]
    times = sorted(float(v) for v in found if isinstance(v, int | float) and v > 0)
    scans = round(times[len(times) // 2] / m.period_s) if times else SETTLE
    return min(max(scans, LEAST_SETTLE), MOST_SETTLE)


def dead_times(m: Manifest) -> list[int]:
    """Scans after which each controlled variable first answers a move: the evidence's; DEAD where nobody knows."""
    told = m.evidence.get("dead_time_periods")
    known = told if isinstance(told, list) and len(told) == len(m.sp) else [None] * len(m.sp)
    return [d if type(d) is int and 1 <= d <= MOST_DEAD else DEAD for d in known]


def pooled(least: int, figure_s: float) -> tuple[int, int]:
    """(figures to learn, figures that make one): ``least`` made ones last FINE_S, all of them LEARN_S."""
    pool = max(ceil(FINE_S / figure_s / least), 1)
    return max(least, ceil(LEARN_S / (pool * figure_s))) * pool, pool


def blocks(least: int, shortest_s: float) -> tuple[float, float]:
    """(seconds of a block, times ``least`` blocks that are learnt): ``least`` last FINE_S, all of them LEARN_S."""
    block_s = max(shortest_s, FINE_S / least)
    return block_s, max(LEARN_S / (least * block_s), 1.0)
