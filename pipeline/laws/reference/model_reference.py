"""A network trained through time so that the loop follows a reference model, in incremental form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from pipeline.laws.base import Analysis, require_kind, require_single_loop
from pipeline.laws.reference.reference_law import ReferenceLaw, ReferenceParams
from pipeline.laws.reference.reference_loops import Training
from pipeline.laws.reference.reference_networks import BEFORE, COURSE, IncrementalNetwork, R, U, Y
from pipeline.laws.reference.reference_training import Trained, gain_sign, story, train
from pipeline.models.base import Model
from pipeline.models.memory import Named
from pipeline.models.state_space.state_space import StateSpace
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Array, Simulator
from pipeline.tuning.reference_model import ReferenceModel

POINTS = 21  # of MV and CV each, at which the roots are looked for
ERRORS = np.geomspace(1e-4, 1.0, 41)  # of the CV's range


class ModelReference(ReferenceLaw):
    """u = u_applied + (c0 + c1 u_applied) [g(z, E) - g(z, 0)], limited; ``IncrementalNetwork`` has g, z and E.

    The errors E vanish where the loop rests on the reference model, and so does the move: there is no
    offset, whatever the plant. The network is trained through the plant's state-space network by forward
    sensitivities and Levenberg-Marquardt, over random set points, noise and loads.

    Source: [reference_ann, section "ANN Controller Design"], whose network has two errors
    as its only inputs and no memory (``ModelReferenceTwoError``); the incremental form is ours.
    """

    name: ClassVar[str] = "model_reference"
    title: ClassVar[str] = "Model-reference network"
    incremental: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Params(ReferenceParams):
        """The reference model, and in ``training`` how the network is trained to follow it."""

        training: Training = field(default_factory=Training)

    readout: Tensor  # (2 hidden, 1)

    def __init__(
        self,
        signals: Signals,
        model: ReferenceModel,
        network: IncrementalNetwork,
        trained: Trained,
        mv_rate: float | None = None,
    ) -> None:
        super().__init__(signals, model, mv_rate)
        self.network, self.trained = network, trained
        table, bias, out = (torch.from_numpy(a) for a in network.weights(trained.theta))

        def formulas(p: Named) -> Named:
            f = network.features(p)
            still = f[..., :2] @ table[:2] + bias
            return {"units": torch.cat([still + f[..., 2:] @ table[2:], still], dim=-1), "reach": network.reach(p)}

        self.stage = self.prepared(formulas)
        self.register_buffer("readout", torch.cat([out, -out])[:, None].contiguous())

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law trained through part ``state_space``; raises LawError without it."""
        require_single_loop(signals, cls.name)
        network = require_kind(models, StateSpace, cls.name)
        reference = params.model(cls.name)
        policy = IncrementalNetwork(signals, params.order, gain_sign(network, signals), params.training.hidden)
        return cls(signals, reference, policy, train(policy, network, reference, params.training), params.mv_rate)

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as in ControlLaw."""
        x = self.recalled(sp, pv, mv_applied, state)
        done = self.stage(x)
        move = torch.tanh(done["units"]) @ self.readout
        return self.stepped(x, done, self.limited(mv_applied + done["reach"] * move, mv_applied))

    def analysis(self, plant: Simulator | None) -> Analysis:
        """How the training went, and whether the move has another root than zero error anywhere in the law's domain."""
        gains = self.resting_gains()
        wrong = int(np.sum(gains * self.network.sign <= 0))
        told = story(self.trained, self.signals)
        low, high = np.sort(np.abs([gains.min(), gains.max()]))
        figures = {**told.figures, "other_roots": float(wrong), "least_gain": float(low), "largest_gain": float(high)}
        said = (
            f"At rest the move has no root but zero error: over {gains.size:,} points (MV and CV over their ranges, "
            f"errors of {ERRORS[0]:g} to {ERRORS[-1]:g} of the CV's range, either sign) it is {low:.3g} to "
            f"{high:.3g} MV units a CV unit of error, always of the sign that closes it."
            if not wrong
            else f"At rest the move has the wrong sign at {wrong} of {gains.size:,} points."
        )
        return Analysis(figures, {**told.arrays, "gains": gains}, (*told.notes, said))

    def resting_gains(self) -> Array:
        """Move over error [mv/pv] with a constant error, (u, y, e): where it is zero the loop could rest with it."""
        mv, cv = self.signals.mv[0], self.signals.sp[0]
        span = cv.high - cv.low
        grid = np.meshgrid(
            np.linspace(mv.low, mv.high, POINTS),
            np.linspace(cv.low, cv.high, POINTS),
            span * np.concatenate([-ERRORS[::-1], ERRORS]),
            indexing="ij",
        )
        u, y, e = (a.ravel() for a in grid)
        seen = np.zeros((u.size, 4 + self.model.order))
        seen[:, R] = seen[:, COURSE] = y + e
        seen[:, Y], seen[:, U], seen[:, BEFORE] = y, u, e
        found: Array = ((self.network.act(self.trained.theta, seen).mv - u) / e).reshape(grid[0].shape)
        return found
