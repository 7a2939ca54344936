"""Networks trained through time so that the loop follows a reference model: in velocity form, and as printed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.laws.base import Analysis, Stepped, hold_numbers
from loopwright.pipeline.laws.reference.reference_law import ReferenceLaw, ReferenceParams
from loopwright.pipeline.laws.reference.reference_networks import (
    E_BEFORE,
    FIRST_COURSE,
    IncrementalNetwork,
    R,
    TwoErrorNetwork,
    U,
    Y,
)
from loopwright.pipeline.laws.reference.reference_training import Trained, trained_policy, training_analysis
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.plants.simulator import Array, Signals, Simulator
from loopwright.pipeline.tuning.reference_model import ReferenceModel

ROOT_GRID_POINTS = 21  # of MV and CV each, at which the roots are looked for
ERRORS = np.geomspace(1e-4, 1.0, 41)  # of the CV's range


class NetworkLaw(ReferenceLaw):
    """A law whose MV a network gives that is trained through the plant's state-space network."""

    Params: ClassVar[type[Any]] = ReferenceParams
    Network: ClassVar[type[Any]]
    table: Tensor  # (features, hidden) W
    bias: Tensor  # (hidden,) b
    out: Tensor  # (hidden,) w

    def __init__(
        self, signals: Signals, model: ReferenceModel, network: Any, trained: Trained, mv_rate: float | None = None
    ) -> None:
        super().__init__(signals, model, mv_rate)
        self.network, self.trained = network, trained
        hold_numbers(self, **dict(zip(("table", "bias", "out", "level"), network.weights(trained.theta), strict=False)))

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law trained through part ``state_space``; raises LawError without it."""

        def network(sign: float) -> Any:
            return cls.Network(signals, params.order, sign, params.training.hidden)

        return cls(signals, *trained_policy(network, params, models, signals, cls.name), params.mv_rate)


class ModelReference(NetworkLaw):
    """u = u_applied + (c0 + c1 u_applied) [g(z, E) - g(z, 0)], limited; ``IncrementalNetwork`` has g, z and E.

    The errors E vanish where the loop rests on the reference model, and so does the move: there is no
    offset, whatever the plant. The network is trained through the plant's state-space network by forward
    sensitivities and Levenberg-Marquardt, over random set points, noise and loads.

    Source: [reference_ann, section "ANN Controller Design"], whose network has two errors
    as its only inputs and no memory (``ModelReferenceTwoError``); the velocity form is ours.
    """

    name: ClassVar[str] = "model_reference"
    title: ClassVar[str] = "Model-reference network"
    velocity_form: ClassVar[bool] = True

    Network: ClassVar[type[Any]] = IncrementalNetwork

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        p = self.recalled(sp, pv, mv_applied, state)
        features = self.network.features(p)
        z, errors = features[..., :2], features[..., 2:]
        still = z @ self.table[:2] + self.bias
        g = (torch.tanh(still + errors @ self.table[2:]) - torch.tanh(still)) @ self.out.unsqueeze(-1)
        return self.stepped(p, self.limited(mv_applied + self.network.reach(p) * g, mv_applied))

    def analysis(self, plant: Simulator | None) -> Analysis:
        """How the training went, and whether the move has another root than zero error anywhere in the law's domain."""
        gains = self.resting_gains()
        wrong = int(np.sum(gains * self.network.sign <= 0))
        training = training_analysis(self.trained, self.signals)
        low, high = np.sort(np.abs([gains.min(), gains.max()]))
        figures = {
            **training.figures,
            "other_roots": float(wrong),
            "least_gain": float(low),
            "largest_gain": float(high),
        }
        note = (
            f"In steady state only zero error gives zero move. On {gains.size:,} points (MV and CV in their ranges, "
            f"errors of {ERRORS[0]:g} to {ERRORS[-1]:g} of the CV's range, both signs) the move is {low:.3g} to "
            f"{high:.3g} MV units per CV unit of error and always reduces the error."
            if not wrong
            else f"In steady state the move has the wrong sign at {wrong} of {gains.size:,} points."
        )
        return Analysis(figures, {**training.arrays, "gains": gains}, (*training.notes, note))

    def resting_gains(self) -> Array:
        """Move over error [mv/pv] with a constant error, (u, y, e): where it is zero the loop could rest with it."""
        mv, cv = self.signals.mv[0], self.signals.sp[0]
        span = cv.high - cv.low
        grid = np.meshgrid(
            np.linspace(mv.low, mv.high, ROOT_GRID_POINTS),
            np.linspace(cv.low, cv.high, ROOT_GRID_POINTS),
            span * np.concatenate([-ERRORS[::-1], ERRORS]),
            indexing="ij",
        )
        u, y, e = (a.ravel() for a in grid)
        inputs = np.zeros((u.size, 4 + self.model.order))
        inputs[:, R] = inputs[:, FIRST_COURSE] = y + e
        inputs[:, Y], inputs[:, U], inputs[:, E_BEFORE] = y, u, e
        gains: Array = ((self.network.act(self.trained.theta, inputs).mv - u) / e).reshape(grid[0].shape)
        return gains


class ModelReferenceTwoError(NetworkLaw):
    """u = N(y_m - y, r - y), limited: the controller network of the paper, whose only inputs are two errors.

    A loop without offset has both errors zero, and then one MV, N(0, 0), for every set point: but each set
    point needs another. So it rests with an offset at all set points except one, however it is trained.

    Source: [reference_ann, section "ANN Controller Design" and figure 4].
    """

    name: ClassVar[str] = "model_reference_two_error"
    title: ClassVar[str] = "Model-reference network, two errors"
    Network: ClassVar[type[Any]] = TwoErrorNetwork
    level: Tensor  # (1,) d

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        p = self.recalled(sp, pv, mv_applied, state)
        return self.stepped(p, self.limited(self.asked(self.network.features(p)), mv_applied))

    def asked(self, errors: Tensor) -> Tensor:
        """N of scaled errors (..., 2), the MV (..., 1) before its limits."""
        units = torch.tanh(errors @ self.table + self.bias)
        return self.low + (self.high - self.low) * (units @ self.out.unsqueeze(-1) + self.level)

    def analysis(self, plant: Simulator | None) -> Analysis:
        """How the training went, and the one set point that the law can hold without offset."""
        training = training_analysis(self.trained, self.signals)
        at_rest = float(self.asked(torch.zeros(2, dtype=torch.float64)))
        note = (
            f"With both errors at zero the MV is {at_rest:.4g} {self.signals.mv[0].unit}, whatever the set point. The "
            "loop has an offset wherever the steady MV differs."
        )
        return Analysis({**training.figures, "mv_at_zero_errors": at_rest}, training.arrays, (*training.notes, note))
