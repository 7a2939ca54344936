"""Metrics of closed loops: name, unit, words, and the rule that combines the figures of several loops."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from numpy.typing import ArrayLike

from loopwright.pipeline import metrics
from loopwright.pipeline.errors import ParamsError

Figures = dict[str, float]
How = Literal["mean", "max", "min", "sum"]
REDUCE: Mapping[How, Callable[[Iterable[float]], float]] = {
    "mean": statistics.fmean,
    "max": max,
    "min": min,
    "sum": sum,
}
NO_UNIT = frozenset({"", "-", "1"})
"""Units of a signal that is a plain number."""
TRAVEL = "mv_travel"
"""The figure of how far the MVs go in a loop, whose unit a case states: see ``Case.metrics``."""
DRAW_SEEDS = 1_000  # added to the noise's seed for every further draw of it


def with_unit(words: str, unit: str) -> str:
    """``words [unit]``; ``unit`` is empty for a plain number."""
    return f"{words} [{unit}]" if unit else words


@dataclass(frozen=True, slots=True)
class Floor:
    """The error that measurement noise can hide in a test; a smaller error counts as perfect.

    ``error`` computes it from the noise's standard deviation [CV] and the number of samples. ``text``
    describes it, with ``{noise}`` for the deviation and ``{unit}`` for a space and its unit.
    """

    error: Callable[[float, float], float]
    text: str


@dataclass(frozen=True, slots=True)
class Metric:
    """A figure of a closed loop.

    ``unit`` has ``{cv}`` in place of the controlled variable's unit. ``together`` combines the figures of
    several sequences; for a worst-case figure it is the worst of them. A metric with a ``floor`` can compare
    the laws of a case. The bounds then minimize its errors, ``squared`` or absolute, from the ``reference`` or
    from the set point. ``late`` names the same figure over the late part of a test. ``of`` computes the figure
    from the set points and the controlled variable, each (n,), if they are sufficient.
    """

    name: str
    short: str  # in a table
    long: str = ""  # in a sentence
    unit: str = ""
    together: How = "mean"
    floor: Floor | None = None
    squared: bool = False
    reference: bool = False
    late: str = ""
    of: Callable[[ArrayLike, ArrayLike], float] | None = None

    def unit_of(self, cv: str) -> str:
        """The unit where the controlled variable has the unit ``cv``; empty for a plain number."""
        if cv in NO_UNIT:  # only the rest of the unit remains
            own = self.unit.replace("{cv}²", "").replace("{cv}", "").strip()
        else:
            own = self.unit.replace("{cv}²", f"({cv})²" if {" ", "/"} & set(cv) else f"{cv}²").replace("{cv}", cv)
        return "" if own in NO_UNIT else own.replace("deg", "°")

    def label(self, cv: str) -> str:
        """Short words and unit, for the head of a table: IAE [mol/l min]."""
        return with_unit(self.short, self.unit_of(cv))


def _deviation(noise: float, samples: float) -> float:
    return noise


def _sum_of_squares(noise: float, samples: float) -> float:
    return noise**2 * samples


def _detectable(noise: float, samples: float) -> float:
    """An error whose square is the standard deviation of the mean square of the noisy samples."""
    return float(noise * (2 / samples) ** 0.25)


_ABSOLUTE = Floor(_deviation, "{noise:.4g}{unit} (the measurement noise)")
_SUM = Floor(_sum_of_squares, "the SSE of the measurement noise alone ({noise:g} squared times the samples)")
_MEAN_SQUARE = Floor(
    _detectable, "the smallest error that the samples can show in their noise ({noise:g} times (2/samples)^(1/4))"
)

METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric("mae", "MAE", "mean absolute error", "{cv}", floor=_ABSOLUTE, of=metrics.mae),
        Metric(
            "sse", "SSE", "sum of squared errors", "{cv}²", floor=_SUM, squared=True, late="sse_late", of=metrics.sse
        ),
        Metric(
            "tracking",
            "tracking RMS",
            "RMS distance from the reference model",
            "{cv}",
            floor=_MEAN_SQUARE,
            squared=True,
            reference=True,
        ),
        Metric("sse_late", "late SSE", "sum of squared errors after the start", "{cv}²"),
        Metric("ise", "ISE", "integral of the squared error", "{cv}² s"),
        Metric("masse", "MASSE", "mean absolute steady-state error", "{cv}"),
        Metric("max_asse", "MaxASSE", "largest absolute steady-state error", "{cv}", "max"),
        Metric("overshoot", "overshoot", "mean overshoot of the steps"),
        Metric("settling", "settling time", "median settling time", "s"),
        Metric(TRAVEL, "MV travel", "travel of the MVs"),
        # Of a PID's analysis.
        Metric("kc", "Kc", "gain of the PID, ideal form, in units of MV and CV"),
        Metric("ti_s", "Ti", "integral time of the PID", "s"),
        Metric("td_s", "Td", "derivative time of the PID", "s"),
        # Of the bounds alone.
        Metric("failures", "failures", "plans that were not solved", together="sum"),
        Metric("from_nmpc", "taken from the NMPC", "plans for which the NMPC's figures stand", together="sum"),
        Metric("step_ms_p50", "step, median", "median time of a step", "ms"),
        Metric("step_ms_p99", "step, 99 %", "time that one step in a hundred exceeds", "ms", "max"),
    )
}
"""The figures that every case has, and those of its bounds; a case adds its own, ``Case.own_metrics``."""


def together(sequences: Iterable[Figures], known: Mapping[str, Metric] = METRICS) -> Figures:
    """Figures of several sequences of a test as one, each by its metric's rule.

    Laws and bounds use this rule: the mean, but the largest of largest values (``max_asse``), the smallest of
    smallest values, and the sum of counts. Raises ParamsError for a figure without a metric, because it has
    no rule.
    """
    rows = list(sequences)
    names = dict.fromkeys(name for row in rows for name in row)
    for name in names:
        if name not in known:
            raise ParamsError(
                f"the figure {name!r} is scored, but is no metric; add Metric({name!r}, ...) to the case's own_metrics"
            )
    # A count of zero may be missing: ``from_nmpc``.
    return {
        name: float(REDUCE[how](row.get(name, 0.0) if how == "sum" else row[name] for row in rows))
        for name, how in ((name, known[name].together) for name in names)
    }


def mean_of_draws(draws: Iterable[Figures]) -> Figures:
    """Figures of one sequence under several draws of the noise: means, of every figure.

    A draw repeats the measurement of one loop. The largest value over the draws would grow with their
    number, so it is no property of the loop.
    """
    rows = list(draws)
    return {name: statistics.fmean(row[name] for row in rows) for name in rows[0]}


def ratio_to_bound(own: float, bound: float, floor: float) -> float | None:
    """Error over the bound's; None if noise can hide the bound.

    Example: an NMPC that knows a disturbance in advance has an error of 1e-11.
    """
    return own / bound if bound > 0 and bound >= floor else None


def gate_ratio(own: float, bound: float, floor: float) -> float:
    """Error over the bound's, both at least ``floor`` > 0; 1 is the bound, or an error that noise can hide."""
    return max(own, floor) / max(bound, floor)
