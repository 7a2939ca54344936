"""Objective of a state-space network's training: its free-run error over windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.models.training.jacobian import input_jacobian, parameter_jacobian
from loopwright.pipeline.models.training.objectives import Rows, Sums, check_finite, chunks
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record


@dataclass(frozen=True, slots=True, eq=False)
class StateWindows(Rows):
    """Free-run error of a state-space network over k steps: mean over windows, steps and PVs of (x - x*)^2 / s^2.

    Each window starts from what was measured and is then fed its own predictions; s is the network's
    output scale, so that k = 1 is the one-step error. The Jacobian follows the recursion

        dx(t+1)/dtheta = dNN/dtheta(x(t), u(t)) + dNN/dx(x(t), u(t)) dx(t)/dtheta,   dx(0)/dtheta = 0

    Raises ModelError for shapes that do not match, no window, or a value that is not finite.
    """

    start: Array  # (N, n_pv) measured PVs at the start of each window
    mv: Array  # (N, k, n_mv) MVs held over the window's periods
    future: Array  # (N, k, n_pv) measured PVs at the periods' ends

    def __post_init__(self) -> None:
        shapes = self.start.shape, self.mv.shape, self.future.shape
        fits = [len(s) for s in shapes] == [2, 3, 3] and shapes[1][:2] == shapes[2][:2] and self.future.size > 0
        if not fits or shapes[0] != (shapes[2][0], shapes[2][2]):
            raise ModelError(f"windows have shapes {shapes}; give (N, n_pv), (N, k, n_mv), (N, k, n_pv) with N, k > 0")
        check_finite("windows", self.start, self.mv, self.future)

    @classmethod
    def of(cls, record: Record, steps: int, *, every: int = 1) -> Self:
        """Each ``every``-th of all windows of ``steps`` periods, none reaching over the end of a run.

        Raises RecordError where no run is long enough.
        """
        k = record.starts(steps)[::every]
        after = k[:, None] + np.arange(steps)
        return cls(record.pv[k], record.mv[after], record.pv[after + 1])

    @property
    def steps(self) -> int:
        """Periods per window, k."""
        return int(self.future.shape[1])

    def loss(self, net: MLP) -> Tensor:
        """Mean squared error of the free run, scaled."""
        x, mv, future = (torch.from_numpy(a) for a in (self.start, self.mv, self.future))
        total = x.new_zeros(())
        for step in range(self.steps):
            x = net(torch.cat([x, mv[:, step]], dim=1))
            total = total + (((x - future[:, step]) / net.y_scale) ** 2).sum()
        return total / self.future.size

    @torch.no_grad()
    def normal_equations(self, net: MLP, chunk: int) -> tuple[Tensor, Tensor, Tensor]:
        """(loss, J'r, J'J)."""
        start, mv, future = (torch.from_numpy(a) for a in (self.start, self.mv, self.future))
        root = self.future.size**-0.5 / net.y_scale  # (n_pv,)
        n_pv = start.shape[1]
        sums = Sums(net)
        for rows in chunks(len(self), chunk):
            x, sensitivity = start[rows], None
            for step in range(self.steps):
                phi = torch.cat([x, mv[rows, step]], dim=1)
                s, jac = parameter_jacobian(net, phi)
                jac.mul_(net.y_scale[:, None])
                if sensitivity is not None:
                    slope = input_jacobian(net, phi)
                    for i in range(n_pv):
                        for j in range(n_pv):
                            jac[:, i].addcmul_(slope[:, i, j, None], sensitivity[:, j])
                x, sensitivity = x + net.y_center + net.y_scale * s, jac
                sums.add((x - future[rows, step]) * root, jac * root[:, None])
        return sums.result
