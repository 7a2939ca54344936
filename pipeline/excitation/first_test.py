"""The first step test of a simulator: how long it takes to settle, its gains, and how far each MV may go."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.simulator import Array, Simulator

STEP = 0.05  # of an MV's range
SHORT, LONGEST = 200, 6_400  # periods of a run: doubled until it settles
SETTLED = 0.05  # of the change
EXPLODES = 1e5  # ranges of a PV within LONGEST periods: no integrator that can be controlled gets there
STILL_MOVES = 0.1  # of the change, in the last fifth of a run: it does not settle
RESTS = 0.02  # of a PV's range, in LONGEST periods without a step: the start is a rest
TRIED = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.1, 0.05)  # shares of the way from the start to an end of the MV's range
CROSSED = 0.1  # of the PV's range: a plant that does not settle is measured by the time it takes to cross that


@dataclass(frozen=True, slots=True)
class FirstTest:
    """Findings of single steps from the start; lists in the order of the signals."""

    settling_periods: int  # of the slowest answer; of a plant that does not settle, to cross CROSSED of a PV's range
    settles: bool
    at_rest: bool  # without a step the PVs stay
    gain: tuple[tuple[float, ...], ...]  # PV x MV, by a step of STEP; per period where a plant does not settle
    low: tuple[float, ...]  # of each MV: from there on a step alone leaves a PV's range
    high: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)


def first_test(plant: Simulator) -> FirstTest:
    """Steps of each MV from the start, up and down, without noise and under the nominal disturbances.

    Raises PlantError where no MV moves any PV, and where the plant explodes without a controller.
    """
    _x0, mv0 = plant.start
    room = np.array([s.high - s.low for s in plant.pv_signals])
    base = _course(plant, mv0, LONGEST)
    _refuse_exploding(plant, base, "without a step")
    times, gains, settles = [], np.zeros((len(room), len(mv0))), True
    for j, signal in enumerate(plant.mv_signals):
        step = STEP * (signal.high - signal.low)
        step = step if mv0[j] + step <= signal.high else -step
        moved = mv0.copy()
        moved[j] += step
        change, rests = _settled(plant, base, moved)
        _refuse_exploding(plant, change + base[: len(change)], f"after a step of {signal.name} to {moved[j]:.4g}")
        if not np.any(np.abs(change) > 1e-9 * room):
            continue
        settles &= rests
        if rests:
            gains[:, j] = change[-1] / step
            times.append(_settling(change, room))
        else:
            slope = (change[-1] - change[4 * len(change) // 5]) / (len(change) / 5)
            gains[:, j] = slope / step
            # A step as large as the MV's range allows, STEP as it is, says how long a hold may be.
            times.append(int(CROSSED / np.max(np.abs(slope) / room)))
    if not times:
        raise PlantError(
            f"plant {plant.name!r}: no process variable answers to a step of {100 * STEP:g} % of any MV within "
            f"{LONGEST} periods; check step() and measure()"
        )
    slowest = int(np.clip(max(times), 2, LONGEST))
    look = int(min(LONGEST, 3 * slowest)) if settles else slowest
    ends = [[_reach(plant, mv0, j, end, look) for j, end in enumerate(side)] for side in _sides(plant)]
    stays = bool(np.all(np.abs(base - base[0]) <= RESTS * room)) if len(base) else False
    return FirstTest(slowest, settles, stays, tuple(map(tuple, gains.tolist())), tuple(ends[0]), tuple(ends[1]))


def _refuse_exploding(plant: Simulator, course: Array, when: str) -> None:
    """PlantError where a PV of a course (n, n_pv) goes EXPLODES of its ranges away, or to no finite number."""
    for s, y in zip(plant.pv_signals, course.T, strict=True):
        if np.abs(y - y[0]).max() > EXPLODES * (s.high - s.low):
            raise PlantError(
                f"plant {plant.name!r}: {when} {s.name} goes to {y[-1]:.3g} {s.unit} within {len(y)} periods, far "
                f"from its range {s.low:g} to {s.high:g}: the plant is unstable, and its experiment holds the MVs "
                "without a controller; check the signs in step(), or put a controller that stabilises it into the "
                "simulator"
            )


def _sides(plant: Simulator) -> tuple[list[float], list[float]]:
    return [s.low for s in plant.mv_signals], [s.high for s in plant.mv_signals]


def _course(plant: Simulator, mv: Array, periods: int, *, within: bool = False) -> Array:
    """PVs (n, n_pv) of up to ``periods`` periods under a constant mv; cut where one leaves its range, if asked."""
    x, dv, p = plant.start[0], plant.dv_nominal, plant.parameters()
    low, high = (np.array([getattr(s, end) for s in plant.pv_signals]) for end in ("low", "high"))
    rows = []
    for _ in range(periods):
        y = plant.measure(x)
        if not np.isfinite(y).all() or (within and np.any((y < low) | (y > high))):
            break
        rows.append(y)
        x = plant.step(x, mv, dv, p)
    return np.array(rows).reshape(-1, len(low))


def _settled(plant: Simulator, base: Array, mv: Array) -> tuple[Array, bool]:
    """Changes (n, n_pv) by a step, over a run long enough to settle, and whether it does."""
    length, change = SHORT, np.zeros((0, base.shape[1]))
    while length <= LONGEST:
        course = _course(plant, mv, length)
        n = min(len(course), len(base))
        change = course[:n] - base[:n]
        late = np.ptp(change[4 * n // 5 :], axis=0) if n > 5 else np.full(base.shape[1], np.inf)
        most = np.max(np.abs(change), axis=0, initial=0.0)
        room = np.array([s.high - s.low for s in plant.pv_signals])
        if n == length and np.all((late <= STILL_MOVES * SETTLED * most) | (most <= 1e-9 * room)):
            return change, bool(np.any(most > 1e-9 * room)) or length == LONGEST
        length *= 2
    return change, bool(np.all(late <= STILL_MOVES * most))


def _settling(change: Array, room: Array) -> int:
    """Periods after which every PV that moves stays within SETTLED of its end."""
    longest = 1
    for y in change[:, np.max(np.abs(change), axis=0) > 1e-6 * room].T:
        outside = np.flatnonzero(np.abs(y - y[-1]) > SETTLED * np.max(np.abs(y)))
        longest = max(longest, int(outside[-1]) + 1 if outside.size else 1)
    return longest


def _reach(plant: Simulator, mv0: Array, j: int, end: float, periods: int) -> float:
    """The MV's value nearest to ``end``, of TRIED, under which no PV leaves its range within ``periods``."""
    for share in TRIED:
        mv = mv0.copy()
        mv[j] += share * (end - mv0[j])
        if len(_course(plant, mv, periods, within=True)) == periods:
            return float(mv[j])
    return float(mv0[j])
