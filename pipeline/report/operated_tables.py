"""Laws that operators steer by more than set points: the tables of their tests, and what is required of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

from loopwright.pipeline.evaluation.closed_loop import UNREACHED_ERROR
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.metric import NO_UNIT
from loopwright.pipeline.evaluation.operated import (
    LEAST_BORNE,
    MOST_MOVED_OUT,
    MOST_REST_MISS,
    MvResult,
    OperatedResult,
    RangeResult,
)
from loopwright.pipeline.evaluation.validation import CheckedStatement
from loopwright.pipeline.pictures.numbers import figure, number
from loopwright.pipeline.report.own_acceptance import shipped_laws

HASTY_TRAVEL = 5.0  # of an MV's range in one test: from here on calmer settings are the first thing to try
OFTEN_CLAMPED = 0.2  # of the time at an operator's limit: then it is named as what stands in the way
PERCENT_DIGITS = 6  # decimal places of a share in %: what is behind them is rounding
VALUE_DECIMALS = 9  # of a value in its unit: the solver's last digits are no distance
T = TypeVar("T")
Tests = Mapping[str, OperatedResult]


# ------------------------------------------------------------------------------------------------------------ required
def operated_rows(evidence: Evidence) -> Iterator[CheckedStatement]:
    """Requirements on the shipped laws with ``operate``: a row for each figure of each that was measured."""
    for law in shipped_laws(evidence):
        tests = evidence.laws[law].metrics.operated
        yield from _outside(law, tests)
        yield from _gains(law, tests)
        yield from _ranks(law, tests)
        yield from _rests(law, tests)
        yield from _taken_out(law, tests)


def _outside(law: str, tests: Tests) -> Iterator[CheckedStatement]:
    """The share of time outside, in the test where it is worst by its limit."""
    known = [(name, of, late) for name, of in tests.items() if (late := of.late) is not None]
    for most in dict.fromkeys(of.limits.most_outside for _, of, _ in known):
        name, result, late = max((k for k in known if k[1].limits.most_outside == most), key=lambda k: k[2])
        worst = max((one for one in result.ranges if one.allowed), key=lambda one: one.late)
        holds = late <= most
        yield CheckedStatement(
            f"{law}, operators' changes: time outside a range that a steady state keeps, in the end of a test",
            f"≤ {percent(most)} of the time",
            f"{percent(late)}, {worst.signal} in test {name}",
            holds,
            "" if holds else _wider(worst, result),
        )


def _wider(worst: RangeResult, result: OperatedResult) -> str:
    """The remedy for a range that is not kept."""
    if hasty := _hasty(result):
        return hasty
    if clamped := _clamped(result):
        return f"{clamped}: wider limits of it give the law room"
    return (
        f"{worst.signal} was up to {_value(worst.most, worst.unit)} outside: give it a range that much wider, or a "
        "rank before the others'; caution below 1 lets the law answer to loads sooner"
    )


def _gains(law: str, tests: Tests) -> Iterator[CheckedStatement]:
    """The share of the optimum's gain, in the test where it is least by its limit."""
    known = [(name, of, gain) for name, of in tests.items() if (gain := of.gain) is not None]
    for least in dict.fromkeys(of.limits.least_gain for _, of, _ in known):
        name, result, gain = min((k for k in known if k[1].limits.least_gain == least), key=lambda k: k[2])
        holds = gain >= least
        made, best = result.mean("profit"), result.mean("optimum")
        beside = "" if made is None or best is None else f" ({number(made, 5)} of {number(best, 5)} an hour)"
        yield CheckedStatement(
            f"{law}, operators' changes: share of the profit that the best steady state of each model would gain",
            f"≥ {percent(least)}",
            f"{percent(gain)} in test {name}{beside}",
            holds,
            "" if holds else _calmer(result),
        )


def _calmer(result: OperatedResult) -> str:
    """The remedy for a profit that is not made."""
    if hasty := _hasty(result):
        return hasty
    if clamped := _clamped(result):
        return f"{clamped}: the best steady state is within these limits, so that the law is slow; give it time"
    return "the law keeps off the ends of ranges by what its model's error asks: wider ranges, or a better model"


def _hasty(result: OperatedResult) -> str:
    """The remedy for an MV that travels very far; empty where none does."""
    worst = max(result.mvs, key=lambda one: one.travel_share)
    if worst.travel_share <= HASTY_TRAVEL:
        return ""
    far = number(worst.travel_share, 2)
    return f"{worst.signal} travelled {far} times its range: speed of .5 or less, or a max_move, makes it calmer"


def _clamped(result: OperatedResult) -> str:
    """The MV that stood longest at an operator's limit, a clause; empty where none did for long."""
    worst = max(result.mvs, key=lambda one: one.clamped)
    if worst.clamped < OFTEN_CLAMPED:
        return ""
    return f"{worst.signal} stood at an operator's limit for {percent(worst.clamped)} of the time"


def _ranks(law: str, tests: Tests) -> Iterator[CheckedStatement]:
    """The share of the violation that the last rank bears, where two ranges are at odds."""
    name, borne = _worst({name: of.borne for name, of in tests.items()}, min)
    if borne is None:
        return
    holds, hasty = borne >= LEAST_BORNE, _hasty(tests[name])
    yield CheckedStatement(
        f"{law}, ranges at odds: share of the violation that the last rank bears",
        f"≥ {percent(LEAST_BORNE)}",
        f"{percent(borne)} in test {name}",
        holds,
        "" if holds else hasty or "give the two ranges ranks that are farther apart, such as 1 and 4",
    )


def _rests(law: str, tests: Tests) -> Iterator[CheckedStatement]:
    """How far an MV is from its resting value in the end."""
    name, miss = _worst({name: of.miss.miss_share for name, of in tests.items() if of.miss}, max)
    if miss is None:
        return
    worst, holds = tests[name].miss, miss <= MOST_REST_MISS
    signal = "" if worst is None else worst.signal
    yield CheckedStatement(
        f"{law}, resting values: distance of an MV from its own, in the end of a test",
        f"≤ {percent(MOST_REST_MISS)} of its range",
        f"{percent(miss)}, {signal} in test {name}",
        holds,
        "" if holds else "set points and ranges come first: let some of them go, or give the MV more time",
    )


def _taken_out(law: str, tests: Tests) -> Iterator[CheckedStatement]:
    """An MV out of use does not move, and set points are reached again in the end."""
    name, moved = _worst({name: of.moved_out.moved_out for name, of in tests.items() if of.moved_out}, max)
    if moved is not None:
        yield CheckedStatement(
            f"{law}, MVs taken out: largest move of one while it is out",
            f"≤ {percent(MOST_MOVED_OUT)} of its range",
            f"{percent(moved)} in test {name}",
            moved <= MOST_MOVED_OUT,
        )
    name, share = _worst({name: of.error.share for name, of in tests.items() if of.error}, max)
    if share is None:
        return
    worst, holds = tests[name].error, share <= UNREACHED_ERROR
    away = "" if worst is None else f", {worst.signal} by {_value(worst.error, worst.unit)} in test {name}"
    yield CheckedStatement(
        f"{law}, operators' changes: distance from where the best steady state holds a set point, in the end of a test",
        f"≤ {percent(UNREACHED_ERROR)} of what set points move it by",
        f"{percent(share)}{away}",
        holds,
        "" if holds else _clamped(tests[name]) or "ranges and MVs that are out come first: the law needs more time",
    )


def _worst(of: Mapping[str, float | None], choose: Callable[..., Any]) -> tuple[str, float | None]:
    """(test, figure) of the worst of those that were measured; ("", None) where none was."""
    known = {name: value for name, value in of.items() if value is not None}
    name = choose(known, key=lambda name: known[name], default="")
    return name, known.get(name)


# -------------------------------------------------------------------------------------------------------------- tables
RANGES = (
    "Variable", "Range", "Outside [% of time]", "In the end [% of time]", "Outside on average", "At most",
    "Best steady state",
)  # fmt: skip
MVS = (
    "MV",
    "Travel",
    "At operators' limits [% of time]",
    "Moved while out [% of range]",
    "Resting value",
    "From there in the end",
)
PROFITS = ("Test", "At the start", "In the end", "Best steady state", "Share of the gain [%]")


def operated_tables(evidence: Evidence, pictures: Mapping[str, str]) -> list[dict[str, Any]]:
    """A section for each law with ``operate``: its tests with their tables and pictures; empty without such a law."""
    return [
        {
            "law": law,
            "title": evidence.laws[law].title,
            "tests": [_test(law, name, result, pictures) for name, result in tests.items()],
            "profits": [
                (name, *(figure(result.mean(what), 5) for what in ("before", "profit", "optimum")),
                 figure(None if result.gain is None else 100 * result.gain))
                for name, result in tests.items()
                if result.mean("profit") is not None
            ],
        }
        for law in evidence.laws
        if (tests := evidence.laws[law].metrics.operated)
    ]  # fmt: skip


def _test(law: str, name: str, result: OperatedResult, pictures: Mapping[str, str]) -> dict[str, Any]:
    """The tables of one test: the worst of its loops for each signal."""
    picture = picture_name(law, name)
    ends = sorted({f"{number(loop.late_s / 60)} min of {number(loop.duration_s / 60)}" for loop in result.loops})
    return {
        "name": name,
        "title": result.title,
        "loops": len(result.loops),
        "ends": ", ".join(ends),
        "ranges": [
            _range_row(max(rows, key=lambda r: (r.late, r.outside)), len({r.rank for r in result.ranges}) > 1)
            for rows in _by_signal(result.ranges)
        ],
        "mvs": [_mv_row(rows) for rows in _by_signal(result.mvs)],
        "words": _words(result),
        "refused": sum(loop.refused for loop in result.loops),
        "picture": picture if picture in pictures else "",
    }


def picture_name(law: str, test: str) -> str:
    """The file of a test's picture."""
    return f"operated_{law}_{test}.png"


def _range_row(one: RangeResult, ranked: bool) -> tuple[str, ...]:
    best = "–" if one.least is None else "keeps it" if one.allowed else f"{_value(one.least, one.unit)} outside"
    return (
        f"{one.signal}, rank {one.rank:g}" if ranked else one.signal,
        f"{number(one.low, 4)} … {_value(one.high, one.unit, 4)}",
        number(100 * one.outside),
        number(100 * one.late),
        _value(one.mean, one.unit),
        _value(one.most, one.unit),
        best,
    )


def _mv_row(rows: list[MvResult]) -> tuple[str, ...]:
    """An MV over the loops of a test: mean travel, the worst of the rest."""
    first, travel = rows[0], sum(one.travel for one in rows) / len(rows)
    out = max((one.moved_out for one in rows if one.moved_out is not None), default=None)
    worst = max(rows, key=lambda one: one.miss_share or 0.0)
    return (
        first.signal,
        _value(travel, first.unit, 4),
        number(100 * max(one.clamped for one in rows)),
        "–" if out is None else number(100 * out),
        "–" if worst.rest is None else _value(worst.rest, worst.unit, 4),
        "–" if worst.miss is None else _value(worst.miss, worst.unit),
    )


def _words(result: OperatedResult) -> list[str]:
    """Sentences on what the tables have no column for."""
    words = []
    if (borne := result.borne) is not None:
        words.append(f"The range of the last rank bears {percent(borne)} of the violation.")
    if (error := result.error) is not None:
        words.append(
            f"In the end {error.signal} is {_value(error.error, error.unit)} from where the best steady state has it."
        )
    return words


def _by_signal(rows: Iterable[T]) -> list[list[T]]:
    """Rows of several loops by their signal, in the first order."""
    found: dict[str, list[T]] = {}
    for row in rows:
        found.setdefault(row.signal, []).append(row)  # type: ignore[attr-defined]  # a RangeResult or an MvResult
    return list(found.values())


def percent(share: float) -> str:
    """A share in %: three digits, four near 100; 0 where the solver's last digits are all there is."""
    value = round(100 * share, PERCENT_DIGITS)
    return f"{value:.4g} %" if 90 <= value < 100 else f"{number(value)} %"


def _value(value: float, unit: str, digits: int = 3) -> str:
    shown = "" if unit in NO_UNIT else f" {unit.replace('deg', '°')}"
    return f"{number(round(value, VALUE_DECIMALS), digits)}{shown}"
