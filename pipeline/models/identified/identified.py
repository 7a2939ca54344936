"""The identified model: a linear state space with tanh units, its scaling, its noise and its rests inside."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model


class Identified(Model):
    """A sampled plant with ``n_y`` outputs, ``n_mv`` manipulated variables and ``n_dv`` measured disturbances.

        x(k+1) = A x + B v + c + W2 tanh(W1 [x, v] + b1),      y(k) = x[:n_y]

    in scaled numbers: y is (y - y_center) / y_scale, v is ([mv, dv] - v_center) / v_scale. The first ``n_y`` of the
    ``n_x`` states are the outputs. The inputs of row k act on the outputs of row k + 1. Without a hidden unit
    (``n_hidden`` 0) the model is linear.

    ``forward`` maps [x scaled, v in engineering units] (..., n_x + n_v) to the next x (..., n_x), scaled;
    ``measured`` gives y in engineering units.

    ``noise`` is the scaled standard deviation of the measurement noise, were it white; its ``colour`` is phi of
    e(k) = phi e(k-1) + w(k), with which its own standard deviation is 1/sqrt(1 - phi) times as large. ``gain_sd`` of
    each MV and ``pace_sd`` of the time constant are relative, ``dead_sd`` counts periods: what the record leaves open.
    ``rest`` gives the state of a rest from [y scaled, v scaled, 1], ``rest_cov`` the covariance of its error. ``dead``
    holds, for each MV, the fewest whole periods that pass before any output answers (0: the next sample does).
    ``load_moves`` are changes of the loads from row to row over ``recorded`` rows of a record in closed loop, 0 of
    another: x(k+1) has the sum of them added to its first ``n_y`` states. ``dv_noise`` and ``dv_change`` are standard
    deviations of the measured disturbances: of their noise, which is 0 where none is seen, and of their own change a
    period.

    Raises ModelError for numbers of signals, states or units that cannot be.
    """

    kind: ClassVar[str] = "identified"
    a: Tensor  # (n_x, n_x)
    b: Tensor  # (n_x, n_v)
    c: Tensor  # (n_x,)
    w1: Tensor  # (n_hidden, n_x + n_v)
    b1: Tensor  # (n_hidden,)
    w2: Tensor  # (n_x, n_hidden)
    y_center: Tensor  # (n_y,) [unit of the PV]
    y_scale: Tensor  # (n_y,) [unit of the PV]
    v_center: Tensor  # (n_v,) [unit of the input]
    v_scale: Tensor  # (n_v,) [unit of the input]
    noise: Tensor  # (n_y,) scaled
    colour: Tensor  # (n_y,)
    gain_sd: Tensor  # (n_mv,)
    pace_sd: Tensor  # (1,)
    dead_sd: Tensor  # (1,) [periods]
    rest: Tensor  # (n_x, n_y + n_v + 1)
    rest_cov: Tensor  # (n_x, n_x)
    dead: Tensor  # (n_mv,) [periods]
    load_moves: Tensor  # (recorded, n_y) scaled, a period
    dv_noise: Tensor  # (n_dv,) scaled
    dv_change: Tensor  # (n_dv,) scaled, a period

    def __init__(self, n_y: int, n_mv: int, n_dv: int, n_x: int, n_hidden: int = 0, recorded: int = 0) -> None:
        super().__init__()
        sizes = {"n_y": n_y, "n_mv": n_mv, "n_dv": n_dv, "n_x": n_x, "n_hidden": n_hidden}
        if min(n_y, n_mv) < 1 or min(n_dv, n_hidden) < 0 or n_x < n_y:
            stated = ", ".join(f"{name}={value}" for name, value in sizes.items())
            raise ModelError(f"an identified model has {stated}; give n_y and n_mv >= 1, n_x >= n_y, the others >= 0")
        self.n_y, self.n_mv, self.n_dv, self.n_x, self.n_hidden = n_y, n_mv, n_dv, n_x, n_hidden
        self.recorded = recorded
        n_v = n_mv + n_dv
        self.reserve(a=(n_x, n_x), b=(n_x, n_v), c=(n_x,))
        self.reserve(w1=(n_hidden, n_x + n_v), b1=(n_hidden,), w2=(n_x, n_hidden))
        self.reserve(y_center=(n_y,), y_scale=(n_y,), v_center=(n_v,), v_scale=(n_v,))
        self.reserve(noise=(n_y,), rest=(n_x, n_y + n_v + 1), rest_cov=(n_x, n_x), dead=(n_mv,))
        self.reserve(colour=(n_y,), gain_sd=(n_mv,), pace_sd=(1,), dead_sd=(1,))
        self.reserve(load_moves=(recorded, n_y), dv_noise=(n_dv,), dv_change=(n_dv,))

    @property
    def n_v(self) -> int:
        """Number of inputs: manipulated variables, then measured disturbances."""
        return self.n_mv + self.n_dv

    def scaled_inputs(self, v: Tensor) -> Tensor:
        """Scaled inputs (..., n_v) of [mv, dv] (..., n_v) in engineering units."""
        return (v - self.v_center) / self.v_scale

    def scaled_outputs(self, y: Tensor) -> Tensor:
        """Scaled outputs (..., n_y) of PVs (..., n_y) in engineering units."""
        return (y - self.y_center) / self.y_scale

    def forward(self, x: Tensor) -> Tensor:
        """The next state (..., n_x), scaled, of [x scaled, v in engineering units] (..., n_x + n_v)."""
        z = torch.cat([x[..., : self.n_x], self.scaled_inputs(x[..., self.n_x :])], dim=-1)
        ahead = z @ torch.cat([self.a, self.b], dim=1).T + self.c
        return ahead + torch.tanh(z @ self.w1.T + self.b1) @ self.w2.T if self.n_hidden else ahead

    def measured(self, x: Tensor) -> Tensor:
        """The outputs (..., n_y) of states (..., n_x), in engineering units."""
        return x[..., : self.n_y] * self.y_scale + self.y_center

    def at_rest(self, y: Tensor, v: Tensor) -> Tensor:
        """The state (..., n_x) of a rest at the outputs y (..., n_y) under [mv, dv] (..., n_v), engineering units.

        It is the linear estimate ``rest``, its outputs put on y.
        """
        seen = self.scaled_outputs(y)
        one = torch.ones_like(seen[..., :1])
        x = torch.cat([seen, self.scaled_inputs(v), one], dim=-1) @ self.rest.T
        return torch.cat([seen, x[..., self.n_y :]], dim=-1)
