"""A move in plain words: which parts make it, in percent, and which hold it back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from loopwright.serving.explain.explanation import MovePart

LEAST_SHARE = 0.05  # of a side's sum: a smaller part is not named
MOST_NAMED = 3  # parts of a side: more than that nobody reads
STANDS = 1e-4  # of an MV's range: a smaller move is none


def sentence_of(move: float, span: float, parts: Sequence[MovePart], news: Mapping[str, float]) -> str:
    """A move [mv] of an MV whose range is ``span`` [mv] wide, by its ``parts``.

    ``news`` by the name of a signal: by how much a measured disturbance changed, or a reading is above the
    predicted one.
    """
    least = STANDS * span
    if abs(move) <= least:
        held = [p for p in parts if abs(p.value) > least]
        if not held:
            return "stands: nothing asks for a move"
        one, other = ([p for p in held if (p.value > 0) is up] for up in (True, False))
        both = "; against it ".join(filter(None, (_listed(one, news), _listed(other, news))))
        return f"stands: {both}"
    ahead, back = (
        [p for p in parts if (p.value * move > 0) is same and abs(p.value) > least] for same in (True, False)
    )
    return "; held back by ".join(_listed(side, news) for side in (ahead, back) if side)


def _listed(parts: Sequence[MovePart], news: Mapping[str, float]) -> str:
    """The largest parts of one side with their shares of that side's sum."""
    whole = sum(abs(p.value) for p in parts)
    largest = sorted(parts, key=lambda p: -abs(p.value))[:MOST_NAMED]
    named = [p for p in largest if abs(p.value) >= LEAST_SHARE * whole] or largest[:1]
    return "; ".join(f"{100 * abs(p.value) / whole:.0f} %: {words(p, news)}" for p in named)


def words(part: MovePart, news: Mapping[str, float]) -> str:
    """A cause in words."""
    name, up = part.signal, news.get(part.signal, 0.0) >= 0
    return {
        "setpoint": f"{name} towards its set point",
        "range_low": f"{name} towards its low limit",
        "range_high": f"{name} towards its high limit",
        "disturbance": f"{name} {'rose' if up else 'fell'}",
        "forecast": f"{name} as it is to come",
        "load": f"something not measured {'raises' if up else 'lowers'} {name}",
        "cost": f"cost of {name}",
        "rest": f"{name} to its resting value",
        "mv_low": f"{name} at its low limit",
        "mv_high": f"{name} at its high limit",
        "max_move": f"{name} moves no faster",
        "not_in_use": f"{name} is not in use",
        "plan": "the last plan, not yet worked off",
    }[part.cause]
