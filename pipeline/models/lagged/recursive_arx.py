"""An ARX model that a control law learns on: recursive least squares with all that it remembers in the state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from loopwright.pipeline.models.lagged.arx import ARX
from loopwright.pipeline.models.lagged.recursive import RecursiveLeastSquares
from loopwright.pipeline.models.memory import Named, Slot, lag_slots, regressors
from loopwright.serving.manifest import Signal


class Sample(NamedTuple):
    """x(t), x(t+1) with u(t) = u(t-1), (..., n) each, and psi(t) (..., 1)."""

    x: Tensor
    x_ahead: Tensor
    psi: Tensor


class Estimate(NamedTuple):
    """Parameters theta (..., n) with what this sample taught; what a law asks of them, and remembers.

    ``slope`` (..., 1) [pv] is that of y(t+1) over one unit of move.
    """

    theta: Tensor
    slope: Tensor
    kept: dict[str, Tensor]


class RecursiveArx(nn.Module):
    """The parameters theta of a linear model of a filtered output, learnt on at every sample.

        psi(t) = eta(t) + p_1 eta(t-1) + .. = theta' x(t),
        x(t) = [eta(t-1), .., eta(t-n_y), v(t-1), .., v(t-n_u), 1]

    with eta = (y - middle of the set point's range)/half of it and v = (u - middle of the MV's
    range)/unit, so that all of x is of the order of one, as RecursiveLeastSquares wants it. Without
    a prefilter p this is the ARX model itself. A sample whose lags are not all measured teaches
    nothing.

    A law gives ``slots`` to its Memory.

    Parameters
    ----------
    model
        Where theta starts: an ARX of one MV with delay 1.
    sp, mv
        Signals whose ranges scale y and u.
    unit
        What v counts [mv]: half of the MV's range, with the sign of the plant's gain.
    rls
        How it learns; theta starts with its largest covariance.
    prefilter
        p_1, p_2, ..; theta then starts where model and prefilter say.
    n_y
        Lags of y, at least those of the model and of the prefilter; None takes as many.
    """

    pv_unit: Tensor  # (1,) [pv]

    def __init__(
        self,
        model: ARX,
        sp: Signal,
        mv: Signal,
        unit: float,
        rls: RecursiveLeastSquares,
        prefilter: Sequence[float] = (),
        n_y: int | None = None,
    ) -> None:
        super().__init__()
        self.rls = rls
        self.n_y = max(model.n_y, len(prefilter)) if n_y is None else n_y
        self.n_u, self.size = model.n_u, self.n_y + model.n_u + 1
        self.middle_y, self.half_y = (sp.low + sp.high) / 2, (sp.high - sp.low) / 2
        self.middle_u, self.unit = (mv.low + mv.high) / 2, unit
        self.prefilter = list(prefilter) + [0.0] * (self.n_y - len(prefilter))
        start = torch.zeros(self.size, dtype=torch.float64)
        start[: model.n_y] = model.weight[: model.n_y]
        start[: self.n_y] += torch.tensor(self.prefilter, dtype=torch.float64)
        start[self.n_y : -1] = model.weight[model.n_y :] * unit / self.half_y
        level = self.middle_y * (float(model.weight[: model.n_y].sum()) - 1)
        start[-1] = (float(model.bias) + level + self.middle_u * float(model.weight[model.n_y :].sum())) / self.half_y
        self.first = start
        self.register_buffer("pv_unit", torch.tensor([self.half_y], dtype=torch.float64))
        lags = max(self.n_y, self.n_u)
        none = torch.zeros(lags, dtype=torch.float64)
        self.slots = {
            **lag_slots(self.n_y, self.n_u),
            "seen": Slot(lags, none, lambda p: torch.cat([torch.ones_like(p["y"]), p["seen"]], -1)[..., :-1]),
            "theta": Slot(self.size, start),
            "root": Slot(self.size**2, rls.start(self.size).flatten()),
        }

    def sample(self, p: Named) -> Sample:
        """Regressors from the past and the sample, scaled."""
        now, ahead = (self._scaled(x) for x in regressors(p, self.n_y, self.n_u))
        eta = (p["y"] - self.middle_y) / self.half_y
        for i, weight in enumerate(self.prefilter):
            eta = eta + weight * now[..., i : i + 1]
        return Sample(now, ahead, eta)

    def output(self, x: Tensor, theta: Tensor) -> Tensor:
        """theta'x, shape (..., 1), of x and theta (..., n)."""
        return (x * theta).sum(dim=-1, keepdim=True)

    def _scaled(self, phi: Tensor) -> Tensor:
        y, u = phi[..., : self.n_y], phi[..., self.n_y :]
        one = torch.ones_like(phi[..., :1])
        return torch.cat([(y - self.middle_y) / self.half_y, (u - self.middle_u) / self.unit, one], dim=-1)

    def forward(self, p: Named, sample: Sample) -> Estimate:
        """The parameters after this sample."""
        theta, flat = p["theta"], p["root"]
        root = flat.reshape(*flat.shape[:-1], self.size, self.size)
        # While lags are missing, x counts as nothing: theta stays, and so does a covariance that is the largest.
        complete = p["seen"][..., -1:]
        theta, root, _ = self.rls(theta, root, complete * sample.x, sample.psi)
        slope = theta[..., self.n_y : self.n_y + 1] * self.pv_unit
        return Estimate(theta, slope, {"theta": theta, "root": root.flatten(-2)})
