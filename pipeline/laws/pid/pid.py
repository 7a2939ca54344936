"""The PID controller, the baseline of the other laws."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import isfinite
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import (
    Analysis,
    ControlLaw,
    Rates,
    Stepped,
    never_given,
    require_single_loop,
    stood_still,
)
from loopwright.pipeline.laws.pid.tuned import (
    TriedLoops,
    by_simulation,
    given_pairs,
    linearization,
    require_numbers,
    tried_words,
    tuned,
)
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.plants.equations import equations
from loopwright.pipeline.plants.simulator import Signals, Simulator
from loopwright.pipeline.tuning.loop_search import Loops
from loopwright.pipeline.tuning.pairing import ONE_LOOP, Pairs, TunedPairing, choice_words, pairings
from loopwright.pipeline.tuning.pid_forms import PidForms, whole_span
from loopwright.pipeline.tuning.responses import StepResponses
from loopwright.pipeline.tuning.rules import AllPole, PidSettings
from loopwright.pipeline.tuning.stability import FrozenLoops, spectral_radius

EXAMINED = 40  # linear closed loops over a range of the CV


class PID(ControlLaw):
    """Velocity-form PID, derivative on the measurement; one loop, or one for each pair of a CV and an MV.

        mv(k) = mv(k-1) + Kc [ p(k) - p(k-1) + (h/Ti) (r - y) - (d(k) - d(k-1)) ],   p = b r - y
        d(k)  = (Tf d(k-1) + Td (y(k) - y(k-1))) / (Tf + h)
        mv(k-1) = mv_applied + (1 - h/Tt) (last request - last limited request)

    d is the filtered derivative, h the period. The law adds its move to the MV that the actuator
    holds. This is the anti-windup, and makes the transfer from manual to auto bumpless. The law keeps
    the part of a request beyond its limits; this part decays with the tracking time Tt. Without it
    (Tt = h, the plain velocity form) one saturated sample erases the proportional and derivative
    kicks, and their end then moves the MV in the wrong direction. If the actuator did not follow the
    limited request (manual, stuck), the law starts from the applied MV alone. If the actuator did not
    move and the set point then returns to the process variable, the law does not subtract a
    proportional action that the actuator never received (``never_given``).

    Each of several loops has its own numbers; of the two pairings with relative gains nearest to 1 (``pairings``) the
    pairs are those of the smaller error in closed loop, unless they are given. An MV that no loop moves stays where it
    is.

    Source: the PID that [inverse_rbf, section 4.3] compares with; the tracking
    is that of Astrom and Hagglund, Advanced PID Control, section 3.5.
    """

    name: ClassVar[str] = "pid"
    title: ClassVar[str] = "PID"
    velocity_form: ClassVar[bool] = True
    one_loop: ClassVar[bool] = False

    @dataclass(frozen=True, slots=True)
    class Params:
        """The tuning of the PID.

        ``tuning``: ``optimized`` chooses the IMC filter and the set-point weight in closed loop, by the
        ``criterion``, ``mae`` (mean absolute error) or ``itae`` (time-weighted); over a plant that is known by
        simulation alone, and over one with several loops, it chooses all numbers: the least MV travel among those that
        were tried within 5 % of the least error; ``imc`` and ``simc`` use ``lambda_s`` [s] (None: a robust value);
        ``itae`` is the minimum-ITAE rule for a set-point step; ``manual`` uses ``kc`` [mv/pv], ``ti_s`` [s], ``td_s``
        [s] and the derivative filter ``filter_s`` [s]; of
        several loops it takes a list of these numbers, and of ``set_point_weight``, an entry for each of ``pairs``.
        ``pairs``: MV -> the CV that it holds, of several loops; None: pairs are chosen.
        ``tracking_s`` [s]: tracking time; None is sqrt(Ti Td). ``set_point_weight``: None is 1, or
        optimized with the filter. ``operating_cv`` [pv]: steady state of the linearization if the model
        set has no part ``linearized``; None is the middle of the set-point range.
        ``development_seeds``, ``development_set_points``, ``development_hold``: random set points for
        ``optimized``; each seed gives so many, each held for so many samples (None: 100; of a plant that is known by
        simulation alone, twice the time that it takes to settle, or three times that in which an integrating CV
        crosses the set points, 60 to 400). ``sampling``: share of a period that ``itae`` counts as dead time; 0.5 is
        the textbook value, 1 is more cautious.
        ``examined_cv`` [pv]: range of the stability analysis; None: no analysis. ``mv_rate`` [mv]:
        largest MV change per sample, one number or one for each MV; None: that of the plant.
        """

        tuning: Literal["optimized", "imc", "simc", "itae", "manual"] = "optimized"
        criterion: Literal["mae", "itae"] = "mae"
        pairs: Mapping[str, str] | None = None
        kc: float | tuple[float, ...] | None = None
        ti_s: float | tuple[float, ...] | None = None
        td_s: float | tuple[float, ...] = 0.0
        filter_s: float = 0.0
        tracking_s: float | None = None
        set_point_weight: float | tuple[float, ...] | None = None
        lambda_s: float | None = None
        operating_cv: float | None = None
        development_seeds: tuple[int, ...] = (1, 2, 3)
        development_set_points: int = 12
        development_hold: int | None = None
        sampling: float = 0.5
        examined_cv: tuple[float, float] | None = None
        mv_rate: Rates = None

        def __post_init__(self) -> None:
            self.given()

        def given(self) -> tuple[PidSettings, ...]:
            """The settings of each loop that stand here, 1 for those that a tuning finds; LawError for wrong ones."""
            listed = {
                name: (1.0 if value is None else value)
                for name in ("kc", "ti_s", "td_s", "set_point_weight")
                for value in (getattr(self, name),)
            }
            n = len(self.pairs or {}) or 1
            for name, value in listed.items():
                if isinstance(value, tuple) and (len(value) != n or self.tuning != "manual"):
                    raise LawError(
                        f"{name} of the PID has {len(value)} entries; give one number, or with tuning `manual` one "
                        f"for each of `pairs`, which has {len(self.pairs or {})}"
                    )
            each = zip(*(v if isinstance(v, tuple) else (v,) * n for v in listed.values()), strict=True)
            return tuple(PidSettings(kc, ti, td, self.filter_s, b, self.tracking_s) for kc, ti, td, b in each)

    kc: Tensor  # (..., loops)
    integral: Tensor  # h/Ti
    keep: Tensor  # Tf/(Tf + h)
    derivative: Tensor  # Td/(Tf + h)
    weight: Tensor  # b
    fade: Tensor  # 1 - h/Tt
    near: Tensor  # [mv] an actuator this close to the limited request has followed it
    cvs: Tensor | None  # (loops,) of each loop; None: one loop, the first CV
    mvs: Tensor | None  # (loops,) of each loop; None: all MVs, in their order
    places: Tensor | None  # (n_mv,) of each MV among [the loops' MVs, all applied MVs]; None: as the loops

    examined_cv: tuple[float, float] | None = None
    pairings: tuple[TunedPairing, ...] = ()  # of several loops, those that were tuned; the first is this law's
    pairs_given: bool = False
    calm: Loops | None = None  # settings of last resort, of a search
    tried: tuple[TriedLoops, ...] = ()  # settings of a search on the pairs, the cheapest first
    mv_rate: Rates = None

    def __init__(
        self,
        signals: Signals,
        settings: PidSettings | Loops | list[PidSettings] | list[Loops],
        mv_rate: Rates = None,
        pairs: Pairs = ONE_LOOP,
    ) -> None:
        """The law with ``settings`` of its loop, or of each of ``pairs`` (CV, MV), which are in the order of the MVs.

        A list holds candidates in one module: they broadcast over a leading dimension.
        """
        super().__init__(signals, mv_rate)
        if len(pairs) == 1:
            require_single_loop(signals, self.name)
        candidates = settings if isinstance(settings, list) else [settings]
        rows = [(c,) if isinstance(c, PidSettings) else c for c in candidates]
        h = signals.period_s
        formulas: dict[str, Callable[[PidSettings], float]] = {
            "kc": lambda s: s.kc,
            "integral": lambda s: h / s.ti_s,
            "keep": lambda s: s.filter_s / (s.filter_s + h),
            "derivative": lambda s: s.td_s / (s.filter_s + h),
            "weight": lambda s: s.set_point_weight,
            "fade": lambda s: max(0.0, 1 - h / s.tracking_time_s),
        }
        for name, of in formulas.items():
            values = torch.tensor([[of(s) for s in row] for row in rows], dtype=torch.float64)
            self.register_buffer(name, values[:, None] if isinstance(settings, list) else values[0])
        cvs, mvs = ([pair[i] for pair in pairs] for i in range(2))
        idle = [j for j in range(len(signals.mv)) if j not in mvs]
        # Where the loops' MVs are all MVs, they stand in their order already.
        places = [mvs.index(j) if j in mvs else len(mvs) + j for j in range(len(signals.mv))]
        self.register_buffer("cvs", torch.tensor(cvs) if len(pairs) > 1 else None)
        self.register_buffer("mvs", torch.tensor(mvs) if idle else None)
        self.register_buffer("places", torch.tensor(places) if idle else None)
        self.register_buffer("near", 1e-3 * _of(self.high - self.low, self.mvs))
        self.settings, self.loops, self.pairs = rows[0][0], rows[0], pairs
        self.n_state = 1 + 6 * len(pairs)  # started; p, y, d, the last request, the same limited, mv_applied, all k-1
        names = [signals.mv[j].name for j in mvs]
        self.info = ("mv_requested",) if len(pairs) == 1 else tuple(f"{name}_requested" for name in names)

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The PID tuned as ``params`` says, on part ``linearized`` or on the plant; raises LawError."""
        found = tuned(params, models, signals, plant, partial(cls, signals, mv_rate=params.mv_rate))
        law = cls(signals, found.settings, params.mv_rate, found.pairs)
        law.examined_cv, law.pairings, law.pairs_given = params.examined_cv, found.pairings, params.pairs is not None
        law.calm, law.tried, law.mv_rate = found.calm, found.tried, params.mv_rate
        return law

    @classmethod
    def check_settings(cls, params: Any, signals: Signals) -> None:
        """Raise LawError for rates that do not fit the signals, or a tuning that lacks numbers or takes one loop."""
        super().check_settings(params, signals)
        given = given_pairs(params, signals) is not None and params.tuning == "manual"
        if not given and (params.tuning != "optimized" or params.operating_cv is not None):
            require_single_loop(signals, cls.name)
        require_numbers(params)

    @classmethod
    def check(cls, params: Any, models: Mapping[str, Model], plant: Simulator) -> None:
        """Raise LawError where the tuning does not apply to the linearized plant; no closed loop is run."""
        if given_pairs(params, plant.signals) is not None:
            return
        if by_simulation(params, plant):
            pairings(StepResponses.near_start(plant).share)
        elif params.tuning == "optimized":
            require_single_loop(plant.signals, cls.name)
            AllPole.near(linearization(params, models, plant)[0])
        else:
            tuned(params, models, plant.signals, plant, partial(cls, plant.signals, mv_rate=params.mv_rate))

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        n = len(self.pairs)
        sp, y = (v[..., :1] if self.cvs is None else v.index_select(-1, self.cvs) for v in (sp, pv))
        applied = _of(mv_applied, self.mvs)
        p = self.weight * sp - y
        fresh = torch.cat([p, y, torch.zeros_like(p), applied, applied, applied], dim=-1)
        past = torch.where(state[..., :1] > 0, state[..., 1:], fresh)
        p1, y1, d1, requested1, limited1, applied1 = (past[..., i * n : (i + 1) * n] for i in range(6))
        # An actuator that is not at the limited request was moved by something else: no part is unmet.
        followed = (applied - limited1).abs() <= self.near
        unmet = torch.where(followed, requested1 - limited1, torch.zeros_like(requested1))
        d = self.keep * d1 + self.derivative * (y - y1)
        still = stood_still(applied, applied1, limited1, self.near)
        # The state holds no set point; b (r - r1) and b (r1 - y1) follow from p.
        spared = never_given(p - p1 + (y - y1), p1 + (1 - self.weight) * y1)
        move = p - p1 + torch.where(still, spared, torch.zeros_like(p)) + self.integral * (sp - y) - (d - d1)
        requested = applied + self.fade * unmet + self.kc * move
        asked = (
            requested
            if self.places is None
            else torch.cat([requested, mv_applied], dim=-1).index_select(-1, self.places)
        )
        mv = self.limited(asked, mv_applied)
        started = torch.ones_like(p[..., :1])
        return mv, torch.cat([started, p, y, d, requested, _of(mv, self.mvs), applied], dim=-1), requested

    def calmed(self) -> Self | None:
        """A slow PI on the same pairs, see ``calm`` of tuning/loop_search.py; None without a search."""
        return None if self.calm is None else type(self)(self.signals, self.calm, self.mv_rate, self.pairs)

    def analysis(self, plant: Simulator | None) -> Analysis:
        """The settings in words; what a search tried; stability over ``examined_cv``; the pairs of several loops."""
        if self.pairings:
            return self._pairing()
        if self.examined_cv is None:
            return Analysis(self._figures(), notes=self._in_words(), table=self._tried_rows())
        known = equations(plant, "law 'pid' with `examined_cv`")
        loops = FrozenLoops.of(known, self, self.n_state, np.linspace(*self.examined_cv, EXAMINED))
        radius = spectral_radius(loops.matrices())
        figures = self._figures() | {"frozen_radius": float(radius.max()), "gain_margin": loops.gain_margin()}
        return Analysis(figures, {"frozen_cv": loops.cv, "frozen_radius": radius}, self._in_words())

    def _pairing(self) -> Analysis:
        cvs, (chosen, *others) = self.signals.sp, self.pairings
        gains = zip(chosen.pairs, chosen.relative_gains, strict=True)
        figures = self._figures() | {f"relative_gain_{cvs[i].name}": gain for (i, _), gain in gains}
        return Analysis(
            figures,
            notes=(*self._in_words(), *choice_words(chosen, others, cvs, self.signals.mv, given=self.pairs_given)),
            table=self._tried_rows(),
        )

    def _figures(self) -> dict[str, float]:
        """Kc [MV/CV], Ti [s] and Td [s] of the loop, or of each by its MV; without an integral part there is no Ti."""
        numbers = self._numbers(self.loops, "kc", "ti_s", "td_s")
        return {name: value for name, value in numbers.items() if isfinite(value)}

    def _numbers(self, loops: Loops, *names: str) -> dict[str, float]:
        """These numbers of each loop, by name, and of several loops by their MVs too."""
        rows = zip(self.pairs, loops, strict=True)
        of = {f"_{self.signals.mv[j].name}" if len(self.pairs) > 1 else "": s for (_, j), s in rows}
        return {f"{name}{mv}": float(getattr(s, name)) for mv, s in of.items() for name in names}

    def _tried_rows(self) -> tuple[dict[str, float], ...]:
        """The table of an analysis: each settings of the search, what they gave, and which are the law's."""
        names = ("kc", "ti_s", "td_s", "filter_s", "set_point_weight")
        return tuple(
            self._numbers(c.loops, *names) | c.row() | {"taken": float(c.loops == self.loops)} for c in self.tried
        )

    def _in_words(self) -> tuple[str, ...]:
        """The settings of each loop, as somebody types them into another PID, and what a search tried."""
        words = []
        for (i, j), s in zip(self.pairs, self.loops, strict=True):
            cv, mv = self.signals.sp[i], self.signals.mv[j]
            integral = f"Ti {s.ti_s:.4g} s" if isfinite(s.ti_s) else "no integral part"
            derivative = f"Td {s.td_s:.4g} s with a filter of {s.filter_s:.4g} s" if s.td_s else "no derivative"
            forms = PidForms.of(s, cv.high - cv.low, whole_span(mv))
            words.append(
                f"{mv.name} by {cv.name}: Kc {s.kc:.4g} {mv.unit}/({cv.unit}), {integral}, {derivative}, set-point "
                f"weight {s.set_point_weight:.4g}, anti-windup within {s.tracking_time_s:.4g} s "
                f"(ideal form; derivative of the process variable); {forms.words(cv.unit, mv.unit)}."
            )
        return (*words, tried_words(self.tried)) if self.tried else tuple(words)


def _of(values: Tensor, which: Tensor | None) -> Tensor:
    """The entries ``which`` of the last dimension; all of them for None."""
    return values if which is None else values.index_select(-1, which)
