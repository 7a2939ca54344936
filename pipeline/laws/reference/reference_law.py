"""Shared parts of the laws that make the controlled variable follow a reference model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import ControlLaw, Stepped, require_single_loop
from loopwright.pipeline.laws.reference.reference_loops import Training
from loopwright.pipeline.models.memory import Named
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.tuning.reference_model import ReferenceModel

REQUEST_BAND = 0.01  # of the MV's range: an applied MV this close to the last request is the request


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceParams:
    """The reference model, and in ``training`` how a controller is trained to follow it.

    ``order`` n of the ITAE-optimal model, 1..6, and ``wn`` its natural frequency [rad/s]; ``mv_rate`` [mv]
    the largest change a sample, None unlimited.
    """

    order: int = 2
    wn: float
    training: Training = field(default_factory=Training)
    mv_rate: float | None = None

    def model(self, law: str) -> ReferenceModel:
        """The reference model; raises LawError for an order or a frequency that make none."""
        try:
            return ReferenceModel.optimal(self.order, self.wn)
        except ValueError as error:
            raise LawError(f"law {law!r}: {error}") from error


class ReferenceLaw(ControlLaw):
    """A law whose state holds a reference model, x_m(k+1) = phi x_m(k) + gamma r(k), y_m = first of x_m.

    The state is [started, x_m (n), e(k-1), the MV that was asked for], with e = y_m - y. The model starts at
    rest at the measured CV: without a past, and whenever the applied MV is not the one that was asked for
    (manual, another controller). So a transfer to automatic begins a new course from where the plant is.
    """

    parts: ClassVar[Mapping[str, str]] = {"state_space": "kind state_space"}
    looks_ahead: ClassVar[int | None] = 1  # its plant's network knows the PVs and the MV of now alone
    followed: Tensor  # (1,) [mv]
    phi: Tensor  # (n, n) transposed
    gamma: Tensor  # (1, n) transposed

    def __init__(self, signals: Signals, model: ReferenceModel, mv_rate: float | None = None) -> None:
        super().__init__(signals, mv_rate)
        require_single_loop(signals, self.name)
        self.model = model
        phi, gamma = model.sampled(signals.period_s)
        self.register_buffer("phi", torch.from_numpy(phi.T.copy()))
        self.register_buffer("gamma", torch.from_numpy(gamma.T.copy()))
        self.register_buffer("followed", REQUEST_BAND * (self.high - self.low))
        self.n_state = 3 + model.order
        self.info = ("reference",)

    def recalled(self, sp: Tensor, pv: Tensor, mv_applied: Tensor, state: Tensor) -> dict[str, Tensor]:
        """Sample and past by name: r, y, u, ``course`` x_m (..., n), ``before`` e(k-1); at rest where not obeyed."""
        y = pv[..., :1]
        at_rest = torch.cat([y, torch.zeros_like(state[..., 2:-1])], dim=-1)
        # 1 less the distance from what was asked for: above 0 only where the law was started and followed.
        known = state[..., :1] - (mv_applied - state[..., -1:]).abs() / self.followed
        past = torch.where(known > 0, state[..., 1:-1], at_rest)
        return {"r": sp, "y": y, "u": mv_applied, "course": past[..., :-1], "before": past[..., -1:]}

    def stepped(self, p: Named, mv: Tensor) -> Stepped:
        """The results of ``forward``, from what was recalled and the MV: the model and the error one step on."""
        course, reference = p["course"], p["course"][..., :1]
        following = course @ self.phi + p["r"] @ self.gamma
        state = torch.cat([torch.ones_like(mv), following, reference - p["y"], mv], dim=-1)
        return mv, state, reference
