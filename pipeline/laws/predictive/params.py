"""The predictive law's parameters, and what of them must fit the plant's signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest
from typing import Literal

import numpy as np

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import Rates
from loopwright.pipeline.laws.predictive.disturbance_model import Where
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Array, Signals

LONGEST_HORIZON = 500  # samples of a horizon: the law's graph and its design grow with each
USUAL_SWEEPS = 4  # of each quadratic problem of a law without `operate`
USUAL_CHANGES = 2  # of what lies at a bound, of a law with `operate`
Limits = tuple[float | None, ...] | None


@dataclass(frozen=True, slots=True)
class PredictiveParams:
    """Two knobs, and the numbers behind them, which follow from the model where they are None.

    ``speed`` > 0: 2 moves as boldly as a quarter of ``move_weight``. ``caution`` > 0: 2 follows loads as slowly
    as a quarter of ``q_d``. ``horizon`` N samples, 8 to 500; None: 90 % of the model's step responses
    settle within it, 12 to 50. ``moves`` of each MV in a plan; None: 8 of one MV, 5 of each of several. ``move_weight``
    lambda > 0 of squared moves, mu = lambda (N - dead time)/10, MVs in units of half their range. ``eps`` > 0: errors
    smaller than this share of a PV's standard deviation count by their square, larger ones by their size. ``weights`` >
    0 of the CVs in units of their standard deviation in the record, for the stated range is often a sensor's and not
    the plant's; None: all 1. ``q_x`` and ``q_d`` > 0: variance of the model's error and of the load's change a period,
    in units of the noise's; q_d None: 3e-5 over the noise. ``jumps`` > 0: share of the observer's jump after a step of
    a load; less calms loops over a plant that is not the model. ``loads`` act on the ``mvs``, where
    there are as many as outputs, or else on the ``outputs``; ``record``: on the outputs, and each changes
    as much as in the record; None: ``record`` of a law with ``operate`` whose model was identified with its
    loads, else ``mvs``.
    ``passes`` of Gauss-Newton and ``sweeps`` of each QP, 1 or more; None: 4. With ``operate`` each takes ``changes``, 0
    or more, of what lies at a bound in place of sweeps; None: 2. ``damping`` kappa of a pass, 0 or more; None: .5 of
    one MV, .25 of several, and with a search the least that the loops stand. ``tuning``: ``given`` takes these numbers,
    ``search`` starts from them and chooses speed, caution, horizon and jumps in closed loops over the model with errors
    and loads, drawn by ``seed``. ``mv_rate`` [mv]: largest MV change a sample, which the plan knows, one number or one
    for each MV; None: that of the plant. ``cv_low`` and ``cv_high`` [pv]: soft limits, one a CV, None where a CV has
    none; None: no limits. A set point beyond a limit counts as one at the limit. ``preview`` of the set points:
    ``held``, as they are now; ``ramp``, their last slope goes on, as in a recipe of ramps; ``course``, as the input
    ``ahead`` gives them at each sample, steps to come and forecasts of measured disturbances included, and as now where
    nothing is given. ``operate``: other defaults, by name, of the numbers that operators change while the law runs, as
    ``TIC-1.low`` or ``valve.rest``, and may be empty: the law then reads these numbers and which readings are fresh,
    soft limits are the defaults of its ranges, and no operator lets an MV move faster than ``mv_rate``; None: it has
    none of this.
    """

    speed: float = 1.0
    caution: float = 1.0
    horizon: int | None = None
    moves: int | None = None
    move_weight: float = 0.1
    eps: float = 0.1
    weights: tuple[float, ...] | None = None
    q_x: float = 0.01
    q_d: float | None = None
    jumps: float = 1.0
    loads: Literal["mvs", "outputs", "record"] | None = None
    damping: float | None = None
    passes: int = 2
    sweeps: int | None = None
    changes: int | None = None
    tuning: Literal["given", "search"] = "given"
    seed: int = 0
    mv_rate: Rates = None
    cv_low: Limits = None
    cv_high: Limits = None
    preview: Literal["held", "ramp", "course"] = "held"
    operate: Mapping[str, float | bool] | None = None

    def __post_init__(self) -> None:
        for name in ("speed", "caution", "jumps", "move_weight", "eps", "q_x", "q_d"):
            given = getattr(self, name)
            if given is not None and not 0 < given < np.inf:
                raise ValueError(f"{name} is {given}; it must be above 0, and finite")
        choices: dict[str, tuple[str | None, ...]] = {
            "loads": (None, "mvs", "outputs", "record"),
            "tuning": ("given", "search"),
            "preview": ("held", "ramp", "course"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                words = ", ".join(word for word in allowed if word)
                raise ValueError(f"{name} is {getattr(self, name)!r}; allowed are {words}")
        if self.damping is not None and not 0 <= self.damping < np.inf:
            raise ValueError(f"damping is {self.damping}; it must be 0 or above, and finite")
        for name, least in (("horizon", 8), ("moves", 1), ("passes", 1), ("sweeps", 1), ("changes", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name} is {value}; it must be at least {least}")
        self._refuse_idle()
        if self.horizon is not None and self.horizon > LONGEST_HORIZON:
            raise ValueError(
                f"horizon is {self.horizon}; give 8 to {LONGEST_HORIZON} samples, or leave it out: 50 or fewer suffice "
                "where the sampling period suits the plant"
            )
        if any(not 0 < w < np.inf for w in self.weights or ()):
            raise ValueError(f"weights are {list(self.weights or ())}; each must be above 0, and finite")
        for i, (low, high) in enumerate(zip_longest(self.cv_low or (), self.cv_high or ())):
            if low is not None and high is not None and not low < high:
                raise ValueError(
                    f"cv_low[{i}] is {low} and cv_high[{i}] {high}; a low limit must be below the high one"
                )

    def _refuse_idle(self) -> None:
        """ValueError for a number that the law would never read."""
        if self.operate is None and self.changes is not None:
            raise ValueError("changes has no effect without `operate`: leave it out, or give sweeps")
        if self.operate is not None and self.sweeps is not None:
            raise ValueError(
                "sweeps has no effect with `operate`: leave it out, or give changes, of what lies at a bound"
            )


def weights_of(signals: Signals, params: PredictiveParams) -> tuple[float, ...]:
    """One weight a set point; LawError for another number."""
    weights: tuple[float, ...] = tuple(params.weights or (1.0 for _ in signals.sp))
    if len(weights) != len(signals.sp):
        raise LawError(f"law 'predictive' has {len(weights)} weights; give one for each set point ({_names(signals)})")
    return weights


def loads_at(model: Identified, params: PredictiveParams) -> Where:
    """Where the law's loads act, and as the record's, by ``loads``; LawError for those of a record without them."""
    if params.loads == "record" and not model.recorded:
        raise LawError(
            "law 'predictive': loads is 'record', and the model was identified without the loads of its record; "
            "leave `loads` out, or choose mvs or outputs"
        )
    return params.loads or ("record" if params.operate is not None and model.recorded else "mvs")


def limits_of(signals: Signals, params: PredictiveParams) -> tuple[Array, Array] | None:
    """The CVs' limits (n_cv,) and (n_cv,) [pv], infinite where a CV has none; None where no CV has one.

    LawError for another number of limits than of set points, or for one outside the signal's range.
    """
    found = []
    for name, none in (("cv_low", -np.inf), ("cv_high", np.inf)):
        given = getattr(params, name) or (None,) * len(signals.sp)
        if len(given) != len(signals.sp):
            raise LawError(
                f"law 'predictive' has {len(given)} limits in {name}; give one for each set point "
                f"({_names(signals)}), null where there is none"
            )
        for signal, limit in zip(signals.pv, given, strict=False):
            if limit is not None and not signal.low <= limit <= signal.high:
                raise LawError(
                    f"law 'predictive': {name} of {signal.name} is {limit}, outside the signal's range "
                    f"[{signal.low:g}, {signal.high:g}] {signal.unit}; give a limit within it, or null for none"
                )
        found.append(np.array([none if limit is None else limit for limit in given]))
    low, high = found
    return (low, high) if np.isfinite(found).any() else None


def refuse_discrete(signals: Signals) -> None:
    """LawError for an MV that has only some values."""
    for s in signals.mv:
        if s.values:
            raise LawError(
                f"law 'predictive' moves its MVs continuously; {s.name} has only the values {list(s.values)}: "
                "leave out `values` of the signal, or choose a law for discrete MVs"
            )


def check_sizes(signals: Signals, model: Identified) -> None:
    """LawError unless the model has the plant's MVs and measured disturbances, and all set points as outputs."""
    plant = (len(signals.mv), len(signals.dv))
    if (model.n_mv, model.n_dv) != plant or not len(signals.sp) <= model.n_y <= len(signals.pv):
        raise LawError(
            f"law 'predictive': the identified model has {model.n_y} outputs, {model.n_mv} MVs and {model.n_dv} "
            f"measured disturbances; the plant has {len(signals.sp)} set points among {len(signals.pv)} PVs, "
            f"{plant[0]} MVs and {plant[1]} measured disturbances: identify the model from this plant's record"
        )


def _names(signals: Signals) -> str:
    return ", ".join(s.name for s in signals.sp)
