"""The model-reference network as printed: two errors in, the MV out, no memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from pipeline.laws.base import Analysis, require_kind, require_single_loop
from pipeline.laws.reference.reference_law import ReferenceLaw, ReferenceParams
from pipeline.laws.reference.reference_loops import Training
from pipeline.laws.reference.reference_networks import TwoErrorNetwork
from pipeline.laws.reference.reference_training import Trained, gain_sign, story, train
from pipeline.models.base import Model
from pipeline.models.memory import Named
from pipeline.models.state_space.state_space import StateSpace
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator
from pipeline.tuning.reference_model import ReferenceModel


class ModelReferenceTwoError(ReferenceLaw):
    """u = N(y_m - y, r - y), limited: the controller network of the paper, which sees two errors and nothing else.

    A loop without offset has both errors zero, and then one MV, N(0, 0), for every set point: but each set
    point needs another. So it rests with an offset at all set points except one, however it is trained.

    Source: [reference_ann, section "ANN Controller Design" and figure 4].
    """

    name: ClassVar[str] = "model_reference_two_error"
    title: ClassVar[str] = "Model-reference network, two errors"

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Params(ReferenceParams):
        """The reference model, and in ``training`` how the network is trained to follow it."""

        training: Training = field(default_factory=Training)

    readout: Tensor  # (hidden, 1) [mv]
    level: Tensor  # (1,) [mv]

    def __init__(
        self,
        signals: Signals,
        model: ReferenceModel,
        network: TwoErrorNetwork,
        trained: Trained,
        mv_rate: float | None = None,
    ) -> None:
        super().__init__(signals, model, mv_rate)
        self.network, self.trained = network, trained
        weights, shift, out, level = network.weights(trained.theta)
        table, bias = torch.from_numpy(weights), torch.from_numpy(shift)

        def formulas(p: Named) -> Named:
            return {"units": network.features(p) @ table + bias}

        self.stage = self.prepared(formulas)
        span = self.high - self.low
        self.register_buffer("readout", torch.from_numpy(out)[:, None] * span)
        self.register_buffer("level", self.low + span * level)

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law trained through part ``state_space``; raises LawError without it."""
        require_single_loop(signals, cls.name)
        network = require_kind(models, StateSpace, cls.name)
        reference = params.model(cls.name)
        policy = TwoErrorNetwork(signals, params.order, gain_sign(network, signals), params.training.hidden)
        return cls(signals, reference, policy, train(policy, network, reference, params.training), params.mv_rate)

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as in ControlLaw."""
        x = self.recalled(sp, pv, mv_applied, state)
        done = self.stage(x)
        mv = torch.tanh(done["units"]) @ self.readout + self.level
        return self.stepped(x, done, self.limited(mv, mv_applied))

    def analysis(self, plant: Simulator | None) -> Analysis:
        """How the training went, and the one set point that the law can hold without offset."""
        told = story(self.trained, self.signals)
        at_rest = float(self.level + torch.tanh(self._at_zero()) @ self.readout)
        said = (
            f"With both errors zero the MV is {at_rest:.4g} {self.signals.mv[0].unit}, at every set point: only where "
            "that is the steady MV is there no offset."
        )
        return Analysis({**told.figures, "mv_at_zero_errors": at_rest}, told.arrays, (*told.notes, said))

    def _at_zero(self) -> Tensor:
        x = torch.zeros(sum(self.layout.values()), dtype=torch.float64)
        return self.stage(x)["units"]
