"""The free run of an identified model over a horizon, and the few moves of each MV that cover it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import hold_numbers
from loopwright.pipeline.laws.predictive.disturbance_model import Loads
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.memory import AffineMap, Named
from loopwright.pipeline.plants.simulator import Array


@dataclass(frozen=True, slots=True)
class Moves:
    """Moves z_1 .. z_J of each MV over a horizon of N samples, short at first and then ever longer.

    Move j starts at sample ``starts[j]``. It holds its value until the next one starts, or with ``ramps`` the MV
    runs straight from one value to the next, as an actuator of limited speed does. A plan (..., J n_mv) has the
    first move of all MVs in front, then the second: it is in the order of time.
    """

    horizon: int
    starts: tuple[int, ...]
    n_mv: int
    ramps: bool

    @classmethod
    def over(cls, horizon: int, moves: int, n_mv: int, *, ramps: bool = False) -> Moves:
        """Moves whose lengths grow geometrically from 1 to fill the horizon; LawError if they do not fit in."""
        if not 1 <= moves <= horizon:
            raise LawError(f"{moves} moves do not fit in a horizon of {horizon} samples; give 1 to {horizon} moves")
        low, high = 1.0, float(horizon)
        for _ in range(60):  # the ratio of the lengths, whose sum grows with it
            ratio = 0.5 * (low + high)
            low, high = (ratio, high) if sum(ratio**j for j in range(moves)) < horizon else (low, ratio)
        starts = [0]
        for j in range(1, moves):
            starts.append(max(starts[-1] + 1, round(sum(low**i for i in range(j)))))
        return cls(horizon, tuple(starts), n_mv, ramps)

    @property
    def count(self) -> int:
        """Number of entries of a plan, J n_mv."""
        return len(self.starts) * self.n_mv

    @property
    def profile(self) -> Array:
        """Share (N, J) of each move in an MV at each sample of the horizon."""
        at = np.arange(self.horizon, dtype=np.float64)
        if self.ramps:
            each = np.eye(len(self.starts))
            return np.stack([np.interp(at, self.starts, row) for row in each], axis=1)
        ends = np.array([*self.starts[1:], self.horizon])
        return ((at[:, None] >= np.array(self.starts)) & (at[:, None] < ends)).astype(np.float64)

    @property
    def lengths(self) -> Array:
        """Samples (J n_mv,) between the start of a move and that of the move before; 1 for the first."""
        return np.repeat(np.diff(self.starts, prepend=self.starts[0] - 1), self.n_mv).astype(np.float64)

    @property
    def shift(self) -> Array:
        """Matrix (J n_mv, J n_mv) S of a plan one sample later: plan @ S."""
        later = np.minimum(np.array(self.starts) + 1, self.horizon - 1)
        return self._each_mv(self.profile[later].T)

    @property
    def before(self) -> Array:
        """Matrix (J n_mv, J n_mv) from a plan to the move before each move; 0 before the first."""
        return self._each_mv(np.eye(len(self.starts), k=1))

    @property
    def curvature(self) -> Array:
        """Matrix D'D (J n_mv, J n_mv) of the sum of squared changes from move to move, the first from 0."""
        d = np.eye(self.count) - self.before
        return d @ d.T

    @property
    def first(self) -> Array:
        """Matrix (n_mv, J n_mv) that puts a value of each MV in the place of its first move."""
        return np.eye(self.n_mv, self.count)

    def _each_mv(self, matrix: Array) -> Array:
        return np.asarray(np.kron(matrix, np.eye(self.n_mv)), dtype=np.float64)

    def courses(self, plan: Tensor) -> Tensor:
        """The MVs (..., N, n_mv) of a plan (..., J n_mv)."""
        each = plan.reshape(*plan.shape[:-1], len(self.starts), self.n_mv)
        return torch.from_numpy(self.profile) @ each


def product(x: Tensor, w: Tensor, b: Tensor) -> Tensor:
    """Affine map x W + b for x (..., i, n), w (..., n, k), b broadcastable to (..., i, k).

    Matrices without leading dimensions, as in an exported graph, take one operator (Gemm), which has half the cost of
    two in a chain of small products.
    """
    return torch.addmm(b, x, w) if x.ndim == w.ndim == 2 else x @ w + b


# ---------------------------------------------------------------- one step of the model, in the pieces that are affine
def one_step(model: Identified, loads: Loads, p: Named) -> dict[str, Tensor]:
    """``next`` = A x + B v' + c + X d and ``hidden`` = W1 [x, v'] + b1, which a linear model lacks; v' = v + V d.

    x+ = next + W2 tanh(hidden), of x (..., n_x), d (..., n_d) and v (..., n_v), all scaled.
    """
    x, d = p["x"], p["d"]
    v = p["v"] + d @ loads.into_v.T
    found = {"next": x @ model.a.T + v @ model.b.T + model.c + d @ loads.into_x.T}
    if model.n_hidden:
        found["hidden"] = torch.cat([x, v], dim=-1) @ model.w1.T + model.b1
    return found


# ---------------------------------------------------------------------------------------------- the run over a horizon
Scaling = Callable[[Tensor], Tensor]
"""The scaled MVs (..., n_mv) of a model for MVs (..., n_mv) within -1..1."""
SMALL_TANH = 1e-6  # tanh(SMALL_TANH x)/SMALL_TANH is x to 3e-13 x^3


class Prediction(NamedTuple):
    """The outputs over the horizon, sample by sample, and their slopes over the entries of the plan."""

    y: Tensor  # (..., 1, N n_cv)
    slopes: Tensor  # (..., m, N n_cv)
    slopes_t: Tensor  # (..., N n_cv, m) the same, by output


class LinearHorizon(nn.Module):
    """Free run x(1) .. x(N) of a linear model from [x, d, dv] under a plan z, loads and measured disturbances held.

    It is affine in [x, d, dv, z], one product, and its slopes are constant. With ``forecasts`` measured disturbances
    may differ from dv later: the run is affine in that, too.
    """

    slopes: Tensor  # (m, N n_cv)
    slopes_t: Tensor  # (N n_cv, m)
    later: Tensor | None  # (N n_dv, N n_cv) from dv(i) - dv, i = 1 .. N, to the run

    @torch.no_grad()
    def __init__(
        self, model: Identified, loads: Loads, moves: Moves, mv_of: Scaling, n_cv: int, *, forecasts: bool = False
    ) -> None:
        super().__init__()

        def run(p: Named) -> dict[str, Tensor]:
            v, x, y = inputs(moves, mv_of, p), p["x"], []
            for i in range(moves.horizon):
                x = one_step(model, loads, {"x": x, "d": p["d"], "v": v[..., i, :]})["next"]
                y.append(x[..., :n_cv])
            return {"y": torch.cat(y, dim=-1)}

        self.run = AffineMap(layout_of(model, loads, moves), run)
        self.register_buffer("later", later_of(model, loads, moves, run) if forecasts else None)
        slopes = self.run.matrix[-moves.count :].clone()
        self.register_buffer("slopes", slopes)
        self.register_buffer("slopes_t", slopes.T.contiguous())

    def forward(self, start: Tensor, plan: Tensor, offset: Tensor | None = None) -> Prediction:
        """The run from ``start`` (..., 1, n_x + n_d + n_dv) [x, d, dv] under ``plan`` (..., 1, m), all scaled.

        ``offset`` is of ``forecast``; None: measured disturbances stay as they are.
        """
        return Prediction(self.run(torch.cat([start, plan], dim=-1), offset)["y"], self.slopes, self.slopes_t)

    def forecast(self, later: Tensor) -> Tensor:
        """The run's offset where measured disturbances change: ``later`` (..., 1, N n_dv) dv(i) - dv, scaled."""
        return forecast_offset(self.run, self.later, later)


class NetworkHorizon(nn.Module):
    """Free run x(1) .. x(N) from [x, d, dv] under a plan z, loads and measured disturbances held; and its slopes.

    The run is x(i+1) = A x(i) + B v(i) + c + X d + W2 tanh(h(i)), h(i) = W1 [x(i), v(i)] + b1, with v(i) from
    the moves that act at sample i, and V d. Everything but the tanh is affine, so the units [h, e x] with a small e
    all pass the tanh, which hardly bends e x, and a step is one tanh and one product with a constant:

        p(i+1) = tanh(p(i)) M + P(i+1),   p = [h, e x]

    P is affine in [x, d, dv, z] and computed once for the whole horizon. The slopes S(i) (m, n_s) of [x(i), v(i)]
    over the m entries of z are exact, n_s = n_x + n_mv:

        S(i+1) = S(i) F(i) + [0, Z(i+1)],   F(i) = [[A'], [B']] + W1' diag(1 - t^2) W2', zero in the columns of v

    for t = tanh(h(i)) and Z(i) the share of each entry of the plan in v(i). F is affine in t^2. With ``forecasts``
    measured disturbances may differ from dv later: P is affine in that, too.
    """

    later: Tensor | None  # (N n_dv, (N + 1) n_p) from dv(i) - dv, i = 1 .. N, to P
    step: Tensor  # (n_p, n_p) M
    bends: Tensor  # (n_h, n_s n_s) -W1' W2' of each unit
    straight: Tensor  # (n_s n_s,) F where no unit bends
    pushes: Tensor  # (N + 1, m, n_s) [0, Z(i)]
    pick: Tensor  # (m N n_cv,) the controlled outputs' slopes among all
    pick_t: Tensor  # (N n_cv m,)
    by_small: Tensor  # (1,)

    @torch.no_grad()
    def __init__(
        self, model: Identified, loads: Loads, moves: Moves, mv_of: Scaling, n_cv: int, *, forecasts: bool = False
    ) -> None:
        super().__init__()
        n, m, n_x, n_mv = moves.horizon, moves.count, model.n_x, model.n_mv
        self.n, self.m, self.n_h, self.n_cv, self.n_s = n, m, model.n_hidden, n_cv, n_x + n_mv

        def forced(p: Named) -> Named:
            return {f"p{i}": u for i, u in enumerate(_forced(model, loads, moves, mv_of, p))}

        self.run = AffineMap(layout_of(model, loads, moves), forced)
        self.register_buffer("later", later_of(model, loads, moves, forced) if forecasts else None)
        # from tanh(p) to the unforced x
        w1_x, to_x = model.w1[:, :n_x], torch.cat([model.w2, model.a / SMALL_TANH], dim=1)
        gain = mv_of(torch.eye(n_mv, dtype=torch.float64)) - mv_of(torch.zeros(n_mv, dtype=torch.float64))
        into = torch.cat([w1_x, model.w1[:, n_x : n_x + n_mv] @ gain.T], dim=1)  # (n_h, n_s)
        bends = into.unsqueeze(-1) * pad(model.w2.T, (0, n_mv)).unsqueeze(-2)  # (n_h, n_s, n_s)
        linear = pad(torch.cat([model.a.T, gain @ model.b[:, :n_mv].T]), (0, n_mv))  # (n_s, n_s)
        shares = torch.einsum("ij,ab->ijab", torch.from_numpy(moves.profile), torch.eye(n_mv, dtype=torch.float64))
        # From the flat (m, N, n_s) slopes to those of the controlled outputs, in both orders.
        at = np.arange(m * n * self.n_s).reshape(m, n, self.n_s)[:, :, :n_cv].reshape(m, n * n_cv)
        buffers = {
            "step": torch.cat([w1_x @ to_x, SMALL_TANH * to_x]).T,
            "bends": -bends.flatten(1),
            "straight": (linear + bends.sum(dim=0)).flatten(),
            "pushes": pad(pad(shares.reshape(n, m, n_mv), (n_x, 0)), (0, 0, 0, 0, 0, 1)),  # (N + 1, m, n_s)
            "pick": torch.from_numpy(at.ravel()),
            "pick_t": torch.from_numpy(at.T.ravel()),
        }
        for name, matrix in buffers.items():
            self.register_buffer(name, matrix.contiguous())
        hold_numbers(self, by_small=1 / SMALL_TANH)

    def forecast(self, later: Tensor) -> Tensor:
        """The run's offset where measured disturbances change: ``later`` (..., 1, N n_dv) dv(i) - dv, scaled."""
        return forecast_offset(self.run, self.later, later)

    def forward(self, start: Tensor, plan: Tensor, offset: Tensor | None = None) -> Prediction:
        """The run from ``start`` (..., 1, n_x + n_d + n_dv) [x, d, dv] under ``plan`` (..., 1, m), all scaled.

        ``offset`` is of ``forecast``; None: measured disturbances stay as they are.
        """
        given = torch.cat([start, plan], dim=-1)
        batch, n_h = given.shape[:-2], self.n_h
        forced = list(self.run(given, offset).values())
        t = torch.tanh(forced[0])
        steps = [t]
        for force in forced[1:]:
            t = torch.tanh(product(t, self.step, force))
            steps.append(t)
        every = torch.cat(steps, dim=-2)  # (..., N + 1, n_h + n_x)
        y = self.by_small * every[..., 1:, n_h : n_h + self.n_cv]
        slopes = self._slopes(every[..., :-1, :n_h]).flatten(-2)
        return Prediction(
            y.reshape(*batch, 1, self.n * self.n_cv),
            slopes.index_select(-1, self.pick).reshape(*batch, self.m, self.n * self.n_cv),
            slopes.index_select(-1, self.pick_t).reshape(*batch, self.n * self.n_cv, self.m),
        )

    def _slopes(self, t: Tensor) -> Tensor:
        """Slopes (..., m, N n_s) of the states and MVs over the plan, from tanh(h(0)) .. tanh(h(N-1)) (..., N, n_h)."""
        f = product(t * t, self.bends, self.straight).reshape(*t.shape[:-2], self.n * self.n_s, self.n_s)
        x, slopes = self.pushes[0], []
        for step, push in zip(torch.split(f, self.n_s, dim=-2), self.pushes[1:], strict=True):
            x = product(x, step, push)
            slopes.append(x)
        return torch.cat(slopes, dim=-1)


def horizon_of(
    model: Identified, loads: Loads, moves: Moves, mv_of: Scaling, n_cv: int, *, forecasts: bool = False
) -> LinearHorizon | NetworkHorizon:
    """The free run of a model over the first ``n_cv`` of its outputs; ``forecasts`` of measured disturbances or not."""
    kind = NetworkHorizon if model.n_hidden else LinearHorizon
    return kind(model, loads, moves, mv_of, n_cv, forecasts=forecasts)


def layout_of(model: Identified, loads: Loads, moves: Moves) -> dict[str, int]:
    """Names and sizes of what a free run depends on."""
    return {"x": model.n_x, "d": loads.count, "dv": model.n_dv, "z": moves.count}


def inputs(moves: Moves, mv_of: Scaling, p: Named) -> Tensor:
    """Scaled v over the horizon, (..., N, n_v), of a plan p["z"] and measured disturbances p["dv"].

    p["later"] (..., N n_dv), where there is one, says by how much these differ from it at the samples 1 .. N; the last
    one acts on no output of the horizon.
    """
    mv = mv_of(moves.courses(p["z"]))
    dv = p["dv"].unsqueeze(-2).expand(*mv.shape[:-1], p["dv"].shape[-1])
    if "later" in p:
        dv = dv + pad(p["later"].reshape(dv.shape)[..., :-1, :], (0, 0, 1, 0))
    return torch.cat([mv, dv], dim=-1)


def later_of(model: Identified, loads: Loads, moves: Moves, run: Callable[[Named], Named]) -> Tensor:
    """Answers of the results of ``run`` to a unit of each p["later"], (N n_dv, their size)."""
    rest = {name: torch.zeros(n, dtype=torch.float64) for name, n in layout_of(model, loads, moves).items()}

    def formulas(p: Named) -> Named:
        count = p["later"].shape[:-1]
        return run({**{name: zero.expand(*count, -1) for name, zero in rest.items()}, **p})

    return AffineMap({"later": moves.horizon * model.n_dv}, formulas).matrix


def forecast_offset(run: AffineMap, matrix: Tensor | None, later: Tensor) -> Tensor:
    """The offset of ``run`` where measured disturbances differ from what they are by ``later`` (..., 1, N n_dv)."""
    assert matrix is not None  # the law was built with forecasts
    return product(later, matrix, run.offset)


def _forced(model: Identified, loads: Loads, moves: Moves, mv_of: Scaling, p: Named) -> list[Tensor]:
    """P(0) .. P(N), each (..., n_h + n_x): what does not come through the tanh of the sample before."""
    v, found, x = inputs(moves, mv_of, p), [], p["x"]
    for i in range(moves.horizon + 1):
        here = v[..., min(i, moves.horizon - 1), :]
        hidden = one_step(model, loads, {"x": x, "d": p["d"], "v": here})["hidden"]
        found.append(torch.cat([hidden, SMALL_TANH * x], dim=-1))
        x = one_step(model, loads, {"x": torch.zeros_like(x), "d": p["d"], "v": here})["next"]
    return found
