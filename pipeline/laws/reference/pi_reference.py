"""PI control towards a reference model's output: what a network that follows one is to be compared with."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import Analysis, Stepped, require_single_loop
from loopwright.pipeline.laws.reference.reference_law import ReferenceLaw, ReferenceParams
from loopwright.pipeline.laws.reference.reference_networks import TrainablePi
from loopwright.pipeline.laws.reference.reference_training import Trained, trained_policy, training_analysis
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.plants.simulator import Signals, Simulator
from loopwright.pipeline.tuning.reference_model import ReferenceModel
from loopwright.pipeline.tuning.rules import PidSettings


class PiReference(ReferenceLaw):
    """u = u_applied + Kc [e - e(k-1) + (h/Ti) e], e = y_m - y, limited: a PI controller whose set point is y_m.

    The reference model alone shapes the response here; its two numbers are trained on the same loops, and
    with the same noise and loads, as the networks that it stands beside.
    """

    name: ClassVar[str] = "pi_reference"
    title: ClassVar[str] = "PI on the reference model"
    velocity_form: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Params(ReferenceParams):
        """``tuning``: trained as ``training`` says, or manual with ``kc`` [mv/pv] and ``ti_s`` [s]."""

        tuning: Literal["trained", "manual"] = "trained"
        kc: float | None = None
        ti_s: float | None = None

        def __post_init__(self) -> None:
            if self.tuning == "manual" and None in (self.kc, self.ti_s):
                raise LawError("tuning `manual` needs kc and ti_s; give both or take trained")
            PidSettings(*(1.0 if v is None else v for v in (self.kc, self.ti_s)))  # refuses wrong numbers

    def __init__(
        self,
        signals: Signals,
        model: ReferenceModel,
        kc: float,
        ti_s: float,
        trained: Trained | None = None,
        mv_rate: float | None = None,
    ) -> None:
        super().__init__(signals, model, mv_rate)
        self.kc, self.ti_s, self.trained = kc, ti_s, trained
        self.share = signals.period_s / ti_s

    @classmethod
    def needs(cls, params: Any, given: Collection[str] = ()) -> tuple[str, ...]:
        """No part where ``kc`` and ``ti_s`` are given."""
        return () if params.tuning == "manual" else tuple(cls.parts)

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law with the numbers of ``params``, or trained through part ``state_space``; raises LawError."""
        require_single_loop(signals, cls.name)
        if params.tuning == "manual":
            return cls(signals, params.model(cls.name), params.kc, params.ti_s, mv_rate=params.mv_rate)

        def pi(sign: float) -> TrainablePi:
            return TrainablePi(signals, params.order, sign)

        reference, policy, trained = trained_policy(pi, params, models, signals, cls.name)
        return cls(signals, reference, *policy.settings(trained.theta), trained, params.mv_rate)

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        p = self.recalled(sp, pv, mv_applied, state)
        e = p["course"][..., :1] - p["y"]
        # The set point acts one sample later, by the reference model; one that is no number must show at once.
        move = self.kc * (e - p["before"] + self.share * e) + 0.0 * sp
        return self.stepped(p, self.limited(mv_applied + move, mv_applied))

    def analysis(self, plant: Simulator | None) -> Analysis:
        """The two numbers, and how their training went."""
        own = {"kc": self.kc, "ti_s": self.ti_s}
        if self.trained is None:
            return Analysis(own)
        training = training_analysis(self.trained, self.signals)
        return Analysis({**training.figures, **own}, training.arrays, training.notes)
