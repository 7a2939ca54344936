"""Shared parts of the laws that follow a reference model: the law, and random closed loops to train it through time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import ControlLaw, Stepped, require_single_loop
from loopwright.pipeline.models.memory import Named
from loopwright.pipeline.models.state_space import StateSpace
from loopwright.pipeline.models.static.mlp import scaled_layers
from loopwright.pipeline.plants.simulator import Array, Signals
from loopwright.pipeline.tuning.reference_model import ReferenceModel

# periods until a free run rests, and the relative change of a period that is rest
LONGEST_FREE_RUN, FREE_RUN_AT_REST = 20_000, 1e-10
CURVE_STATES = 200  # steady states, between which are drawn
INSET = 0.02  # of the MV's range: steady states nearer to its ends are not trained on
LOADED = (0.1, 0.8)  # of a hold: when a load may come


@dataclass(frozen=True, slots=True)
class Training:
    """The loops that are trained on, and how.

    ``hidden`` units of a network. ``lanes`` closed loops side by side, each of ``holds`` random set points for
    ``hold`` samples: a third of them with measurement noise of deviation ``noise`` [pv], a third with a load
    that comes within each hold, as large as if up to ``load`` of the steady MV were missing, and a third as
    they are. ``move_weight`` weighs the MV's changes against the distance from the reference model, both in
    their ranges; ``decay`` each weight's distance from where it started: where the loops do not go, a network
    stays the slow controller that it was. At most ``iterations`` of Levenberg-Marquardt for each of ``restarts``
    draws of weights, ending after ``patience`` without a gain on the validation loops, which are others of the
    same kind. ``seed`` is that of the training loops; those of validation and weights follow from it.
    """

    hidden: int = 6
    lanes: int = 48
    holds: int = 2
    hold: int = 80
    noise: float = 0.0
    load: float = 0.3
    move_weight: float = 0.02
    decay: float = 5e-4
    iterations: int = 60
    patience: int = 10
    restarts: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("hidden", "lanes", "holds", "hold", "iterations", "patience", "restarts"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("noise", "load", "move_weight", "decay"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must not be negative")


class PlantNetwork:
    """A state-space network in numpy, with its Jacobian: x(k+1) = f(x(k), u(k))."""

    def __init__(self, model: StateSpace) -> None:
        self.n_x, self.n_u = model.n_pv, model.n_mv
        self.layers = [(w.numpy(), b.numpy()) for w, b in scaled_layers(model.net)]

    def step(self, x: Array, u: Array) -> tuple[Array, Array]:
        """The next x (B, n_x), and its Jacobian by [x, u], (B, n_x + n_u, n_x), for x (B, n_x), u (B, n_u)."""
        a = np.concatenate([x, u], axis=1)
        weight, bias = self.layers[0]
        a = np.tanh(a @ weight + bias)
        chain = (1 - a * a)[:, None, :] * weight
        for weight, bias in self.layers[1:-1]:
            a = np.tanh(a @ weight + bias)
            chain = (chain @ weight) * (1 - a * a)[:, None, :]
        weight, bias = self.layers[-1]
        jac = chain @ weight
        each = np.arange(self.n_x)
        jac[:, each, each] += 1.0
        return a @ weight + bias + x, jac

    def steady_curve(self, start: Array, mv: Array) -> tuple[Array, Array]:
        """States (n, n_x) and MVs (n, 1) at rest, the smallest CV first, by running free under each of mv (n,).

        Raises LawError where a run does not come to rest, or the CV has an extremum over the MV.
        """
        x, u = np.tile(start, (len(mv), 1)), mv[:, None]
        for _ in range(LONGEST_FREE_RUN):
            before, x = x, self.step(x, u)[0]
            if np.abs(x - before).max() < FREE_RUN_AT_REST * np.abs(x).max():
                break
        else:
            raise LawError("the plant's network does not come to rest under a held MV: it cannot be trained through")
        slopes = np.diff(x[:, 0])
        if not (np.all(slopes > 0) or np.all(slopes < 0)):
            raise LawError("the gain of the plant's network changes its sign over the MV's range: narrow that range")
        order = np.argsort(x[:, 0])
        return x[order], u[order]


@dataclass(frozen=True, slots=True, eq=False)
class Loops:
    """Closed loops side by side: where they start, their set points, noise and loads."""

    x0: Array  # (B, n_x)
    u0: Array  # (B, 1)
    sp: Array  # (n, B)
    noise: Array  # (n, B) [pv] of the measured CV
    load: Array  # (n, B, n_x) added to the state a period

    @classmethod
    def drawn(cls, plant: PlantNetwork, signals: Signals, options: Training, rng: np.random.Generator) -> Self:
        """Loops as ``options`` says, at set points that the plant's network can hold.

        Raises LawError where it can hold none.
        """
        mv, pv = signals.mv[0], signals.pv
        inset = INSET * (mv.high - mv.low)
        middle = np.array([(s.low + s.high) / 2 for s in pv])
        states, mvs = plant.steady_curve(middle, np.linspace(mv.low + inset, mv.high - inset, CURVE_STATES))
        sp = signals.sp[0]
        low, high = max(states[0, 0], sp.low), min(states[-1, 0], sp.high)
        if not low < high:
            raise LawError(
                f"the plant's network rests at {states[0, 0]:g} to {states[-1, 0]:g} {sp.unit}, beyond the set "
                f"points' range of {sp.low:g} to {sp.high:g}: learn it from a record over that range"
            )
        levels, lanes = rng.uniform(low, high, (options.holds + 1, options.lanes)), np.arange(options.lanes)
        at_rest = [np.interp(levels.ravel(), states[:, 0], column) for column in (*states.T, mvs[:, 0])]
        x, u = np.stack(at_rest[:-1], axis=1), at_rest[-1][:, None]
        x0, u0 = x[: options.lanes], u[: options.lanes]
        levels, x, u = levels[1:], x[options.lanes :], u[options.lanes :]
        n = options.holds * options.hold
        noise = options.noise * rng.standard_normal((n, options.lanes)) * (lanes % 3 == 0)
        _, jac = plant.step(x, u)
        missing = (jac[:, -1] * u).reshape(options.holds, options.lanes, -1)
        shares = rng.uniform(-options.load, options.load, levels.shape) * (lanes % 3 == 1)
        begins = rng.uniform(*LOADED, levels.shape) * options.hold
        on = np.arange(options.hold)[None, :, None] >= begins[:, None, :]
        load = (on[..., None] * (shares[..., None] * missing)[:, None]).reshape(n, options.lanes, -1)
        return cls(x0, u0, np.repeat(levels, options.hold, axis=0), noise, load)


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
