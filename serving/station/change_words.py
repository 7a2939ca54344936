"""Changes that somebody makes of a loop, in operators' words: set points, MVs, and values of ``operate``."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import groupby

from loopwright.serving.manifest import OperateEntry, Signal
from loopwright.serving.operating import unit_words

SWITCHED = {
    "use": ("taken out", "back in use"),
    "track": ("left alone within its range", "follows its set point"),
    "rest_use": ("without a resting value", "with a resting value"),
}
NAMED = {
    "low": "low limit",
    "high": "high limit",
    "rank": "priority",
    "max_move": "largest move",
    "rest": "resting value",
}


def operate_words(
    entries: Sequence[OperateEntry], before: Mapping[str, float], wanted: Mapping[str, float], period_s: float
) -> str:
    """The values of ``operate`` in ``wanted`` by name that are others than ``before``, signal by signal.

    ``LIC-2 taken out; TIC-1: high limit 80 -> 75 degC``. A name that the law has no entry of stands as it is.
    ``period_s`` [s] is the law's.
    """
    moved = [e for e in entries if e.name in wanted and wanted[e.name] != before.get(e.name)]
    known = {e.name: e.signal or "the law" for e in entries}
    if not moved and set(wanted) <= set(known):
        return f"{', '.join(dict.fromkeys(known[name] for name in wanted))} as it was"
    words = []
    for signal, group in groupby(moved, key=lambda e: e.signal):
        those = [_words(e, before.get(e.name), wanted[e.name], period_s) for e in _without_doubles(list(group), wanted)]
        alone = len(those) == 1 and those[0] in SWITCHED["use"]
        words.append(f"{signal or 'the law'}{' ' if alone else ': '}{', '.join(those)}")
    return "; ".join([*words, *(f"{name} {value:g}" for name, value in wanted.items() if name not in known)])


def _without_doubles(moved: list[OperateEntry], wanted: Mapping[str, float]) -> list[OperateEntry]:
    """Without the switch of a resting value where its number changes with it; without the number where it goes."""
    switch = next((e for e in moved if e.what == "rest_use"), None)
    if switch is None or all(e.what != "rest" for e in moved):
        return moved
    return [e for e in moved if e.what != ("rest_use" if wanted[switch.name] else "rest")]


def _words(e: OperateEntry, old: float | None, new: float, period_s: float) -> str:
    if e.what in SWITCHED and new in (0, 1):
        return SWITCHED[e.what][int(new)]
    unit = unit_words(e, period_s)
    change = f"{new:g}" if old is None else f"{old:g} -> {new:g}"
    return f"{NAMED.get(e.what, e.what)} {change} {unit}".rstrip(" -")


def by_hand_words(
    before: Sequence[float], wanted: Sequence[float], signals: Sequence[Signal], taken: Collection[str]
) -> str:
    """Where operators send ``signals`` (n,) by hand: ``FV-2 taken out, by hand 33 -> 30 %`` for one of ``taken``."""
    words = []
    for s, old, new in zip(signals, before, wanted, strict=True):
        way = f"at {new:g}" if old == new else f"{old:g} -> {new:g}"
        words.append(f"{s.name} {'taken out, ' if s.name in taken else ''}by hand {way} {s.unit}".rstrip(" -"))
    return "; ".join(words)


def moved_words(before: Sequence[float], wanted: Sequence[float], signals: Sequence[Signal], what: str) -> str:
    """The values (n,) of ``signals`` that change, each with its name: ``set point TIC-1 45 -> 46 degC``."""
    moves = [
        f"{s.name} {old:g} -> {new:g} {s.unit}".rstrip(" -")
        for s, old, new in zip(signals, before, wanted, strict=True)
        if old != new
    ]
    return f"{what} {', '.join(moves) or 'as it was'}"
