"""Hybrid fuzzy model of a jacketed vessel: a mode chooses the consequents, the jacket's temperature blends them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model

COEFFICIENTS = ("a1", "a2", "b", "r")


class JacketAffine(NamedTuple):
    """The next jacket temperature as the throttle's affine function, T_w(k+1) = base + gain k_M [degC].

    Both of shape (..., n_modes), the mode of value 1 first: every mode at once, so that a law can
    compare them and select afterwards.
    """

    base: Tensor
    gain: Tensor


class HybridFuzzy(Model):
    """Takagi-Sugeno rules on the jacket's temperature, one set of consequents a mode.

        T(k+1)   = c_w T_w(k) + c_t T(k)
        T_w(k+1) = sum_j beta_j(T_w) [a1_jq T_w(k) + a2_jq T(k) + b_jq k_M(k) + r_jq]   in mode q(k)

    with triangles beta_j that meet at the ``centres`` and keep 1 beyond the outer ones: they sum to
    1, so that every blended coefficient is the straight line between its values at two centres.
    The jacket's temperature is affine in k_M in every mode, which is what an inverse needs:
    ``jacket`` gives both modes' lines, ``core_next`` the core, ``forward`` one whole step.

    ``consequents`` hold Theta_w of every mode, the first of which has the value 1, the next 2, ...

    Raises ModelError for shapes that do not fit, centres that do not ascend, a number that is not finite.

    Source: [karer, eqs. 24-31].
    """

    kind: ClassVar[str] = "hybrid_fuzzy"
    centres: Tensor  # (K,) [degC] jacket temperatures of the rules, ascending, at least two
    consequents: Tensor  # (n_modes, 4, K) rows a1 [-], a2 [-], b [degC], r [degC]
    core: Tensor  # (2,) [-] c_w, c_t
    low: Tensor  # (K-1,) where each straight piece begins
    width: Tensor  # (K-1,)
    first: Tensor  # (4 n_modes,) coefficients at the lowest centre: a1 of all modes, a2 of all modes, b, r
    rise: Tensor  # (K-1, 4 n_modes) what each piece adds to them
    mode_values: Tensor  # (n_modes,) 1, 2, ...

    def __init__(
        self, centres: Sequence[float], consequents: Sequence[Sequence[Sequence[float]]], core: Sequence[float]
    ) -> None:
        super().__init__()
        c, theta, weights = (np.asarray(v, dtype=np.float64) for v in (centres, consequents, core))
        if c.ndim != 1 or len(c) < 2 or not np.all(np.diff(c) > 0):
            raise ModelError(f"a hybrid fuzzy model has the centres {list(centres)}; give two or more, ascending")
        if theta.ndim != 3 or theta.shape[1:] != (len(COEFFICIENTS), len(c)) or weights.shape != (2,):
            raise ModelError(
                f"a hybrid fuzzy model has consequents of shape {theta.shape} and core weights of shape "
                f"{weights.shape}; {len(c)} centres need (n_modes, {len(COEFFICIENTS)}, {len(c)}) and (2,)"
            )
        if not all(np.isfinite(v).all() for v in (c, theta, weights)):
            raise ModelError("a hybrid fuzzy model holds a number that is not finite; identify it from other data")
        # Rows a1, a2, b, r of every mode at a centre, side by side: one product with a vector blends them all.
        columns = theta.transpose(2, 1, 0).reshape(len(c), -1)
        values = {
            "centres": c,
            "consequents": theta,
            "core": weights,
            "low": c[:-1],
            "width": np.diff(c),
            "first": columns[0],
            "rise": np.diff(columns, axis=0),
        }
        for name, value in values.items():
            self.register_buffer(name, torch.from_numpy(np.array(value)))
        self.n_modes = len(theta)
        self.register_buffer("mode_values", torch.arange(1, self.n_modes + 1, dtype=torch.float64))

    def config(self) -> dict[str, Any]:
        """JSON-ready arguments of the constructor."""
        return {k: getattr(self, k).tolist() for k in ("centres", "consequents", "core")}

    def core_next(self, t: Tensor, t_w: Tensor) -> Tensor:
        """T(k+1), shape (..., 1), from T(k) and T_w(k), each (..., 1) [degC]; the MVs do not act on it yet."""
        return self.core[:1] * t_w + self.core[1:] * t

    def jacket(self, t: Tensor, t_w: Tensor) -> JacketAffine:
        """Every mode's T_w(k+1) over k_M, from T(k) and T_w(k), each (..., 1) [degC]; ten nodes when exported."""
        blended = self.first + self._into(t_w) @ self.rise
        a1, a2, b, r = torch.split(blended, self.n_modes, dim=-1)
        return JacketAffine(a1 * t_w + a2 * t + r, b)

    def forward(self, x: Tensor) -> Tensor:
        """[T, T_w] one period later, shape (..., 2), for [T, T_w, k_M, mode], shape (..., 4)."""
        t, t_w, k_m, mode = torch.split(x, 1, dim=-1)
        line = self.jacket(t, t_w)
        # 1 for the mode chosen, 0 for the others; arithmetic, so that a mode that is not a number is not lost.
        chosen = (1 - (mode - self.mode_values).abs()).clamp(min=0)
        t_w_next = (chosen * (line.base + line.gain * k_m)).sum(dim=-1, keepdim=True)
        return torch.cat([self.core_next(t, t_w), t_w_next], dim=-1)

    def _into(self, t_w: Tensor) -> Tensor:
        """How far T_w has come through each piece between two centres, 0 to 1, shape (..., K-1)."""
        return ((t_w - self.low) / self.width).clamp(0.0, 1.0)
