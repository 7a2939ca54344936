"""Shared parts of the laws that make the controlled variable follow a reference model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from pipeline.errors import LawError
from pipeline.laws.base import ControlLaw, Stepped, require_single_loop
from pipeline.laws.reference.reference_loops import Training
from pipeline.models.memory import Named, Stage
from pipeline.plants.signals import Signals
from pipeline.tuning.reference_model import ReferenceModel

FOLLOWED = 0.01  # of the MV's range: an applied MV this close to the last request is the request


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

    A law gives ``formulas``, affine in the sample and the past, to ``prepared`` and computes its MV of their values.
    """

    parts: ClassVar[Mapping[str, str]] = {"state_space": "kind state_space"}
    looks_ahead: ClassVar[int | None] = 1  # its plant's network knows the PVs and the MV of now alone
    followed: Tensor  # (1,) [mv]

    def __init__(self, signals: Signals, model: ReferenceModel, mv_rate: float | None = None) -> None:
        super().__init__(signals, mv_rate)
        require_single_loop(signals, self.name)
        self.model = model
        self.layout = {"r": 1, "y": 1, "u": 1, "course": model.order, "before": 1, "asked": 1}
        self.register_buffer("followed", FOLLOWED * (self.high - self.low))
        self.n_state = 3 + model.order
        self.info = ("reference",)

    def prepared(self, formulas: Callable[[Named], Named]) -> Stage:
        """The stage of the law's own formulas, the next state of the reference model, and e(k).

        ``formulas`` takes r, y, u, course (n), before: all (..., 1) but the course.
        """
        phi, gamma = self.model.sampled(self.signals.period_s)
        forward, pushed = torch.from_numpy(phi.T.copy()), torch.from_numpy(gamma.T.copy())
        return Stage(
            self.layout,
            lambda p: {
                **formulas(p),
                "next": p["course"] @ forward + p["r"] @ pushed,
                "error": p["course"][..., :1] - p["y"],
            },
        )

    def recalled(self, sp: Tensor, pv: Tensor, mv_applied: Tensor, state: Tensor) -> Tensor:
        """Sample and past as one vector of ``layout``, (..., n); where nobody followed the law, at rest."""
        y = pv[..., :1]
        at_rest = torch.cat([y, torch.zeros_like(state[..., 2:])], dim=-1)
        # 1 less the distance from what was asked for: above 0 only where the law was started and followed.
        known = state[..., :1] - (mv_applied - state[..., -1:]).abs() / self.followed
        return torch.cat([sp, y, mv_applied, torch.where(known > 0, state[..., 1:], at_rest)], dim=-1)

    def stepped(self, x: Tensor, done: Named, mv: Tensor) -> Stepped:
        """The results of ``forward``, from ``recalled``'s vector, the stage's results and the MV."""
        state = torch.cat([torch.ones_like(mv), done["next"], done["error"], mv], dim=-1)
        return mv, state, x[..., 3:4]
