"""Random closed loops over a plant's network, for the training of a controller through time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import LawError
from pipeline.laws.base import LawSignals
from pipeline.models.mlp import scaled_layers
from pipeline.models.state_space import StateSpace

Array = NDArray[np.float64]

NEWTON_STEPS = 30
INSET = 0.02  # of the MV's range: set points whose steady MV is nearer to an end are not trained on
LOADED = (0.1, 0.8)  # of a hold: when a load may come


@dataclass(frozen=True, slots=True)
class Training:
    """The loops that are trained on, and how.

    ``hidden`` units of a network. ``lanes`` closed loops side by side, each of ``holds`` random set points for
    ``hold`` samples: a third of them with measurement noise of deviation ``noise`` [pv], a third with a load
    that comes within each hold, as large as if up to ``load`` of the steady MV were missing, and a third as
    they are. ``move_weight`` weighs the MV's changes against the distance from the reference model, both in
    their ranges. At most ``iterations`` of Levenberg-Marquardt for each of ``restarts`` draws of weights,
    ending after ``patience`` without a gain on the validation loops, which are others of the same kind.
    ``seed`` is that of the training loops; those of validation and weights follow from it.
    """

    hidden: int = 6
    lanes: int = 48
    holds: int = 2
    hold: int = 80
    noise: float = 0.0
    load: float = 0.3
    move_weight: float = 0.02
    iterations: int = 60
    patience: int = 10
    restarts: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("hidden", "lanes", "holds", "hold", "iterations", "patience", "restarts"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("noise", "load", "move_weight"):
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

    def rest(self, cv: Array, x: Array, u: Array) -> tuple[Array, Array]:
        """Steady states (B, n_x) and MVs (B, 1) at the controlled variables cv (B,), by Newton's method from x, u.

        NaN where it does not converge.
        """
        found = np.concatenate([np.broadcast_to(x, (len(cv), self.n_x)), np.broadcast_to(u, (len(cv), 1))], axis=1)
        found[:, 0] = cv
        for _ in range(NEWTON_STEPS):
            after, jac = self.step(found[:, :-1], found[:, -1:])
            by_state = jac.transpose(0, 2, 1)[:, :, 1:].copy()
            by_state[:, :, :-1] -= np.eye(self.n_x)[:, 1:]
            move = np.linalg.solve(by_state, (after - found[:, :-1])[:, :, None])[:, :, 0]
            found[:, 1:] -= move
        after, _ = self.step(found[:, :-1], found[:, -1:])
        far = np.abs(after - found[:, :-1]).max(axis=1) > 1e-9 * np.abs(found).max()
        found[far] = np.nan
        return found[:, :-1], found[:, -1:]


@dataclass(frozen=True, slots=True, eq=False)
class Loops:
    """Closed loops side by side: where they start, their set points, noise and loads."""

    x0: Array  # (B, n_x)
    u0: Array  # (B, 1)
    sp: Array  # (n, B)
    noise: Array  # (n, B) [pv] of the measured CV
    load: Array  # (n, B, n_x) added to the state a period

    @classmethod
    def drawn(cls, plant: PlantNetwork, signals: LawSignals, options: Training, rng: np.random.Generator) -> Self:
        """Loops as ``options`` says, at set points that the plant's network can hold.

        Raises LawError where it can hold hardly any.
        """
        sp, mv, pv = signals.sp[0], signals.mv[0], signals.pv
        count = options.lanes * (options.holds + 1)
        wanted = rng.uniform(sp.low, sp.high, 4 * count)
        middle = np.array([(s.low + s.high) / 2 for s in pv])
        with np.errstate(all="ignore"):
            xs, us = plant.rest(wanted, middle, np.array([mv.middle]))
        inset = INSET * (mv.high - mv.low)
        held = (us[:, 0] >= mv.low + inset) & (us[:, 0] <= mv.high - inset)
        if held.sum() < count:
            raise LawError(
                f"the plant's network holds {held.sum()} of {len(wanted)} set points from {sp.low:g} to {sp.high:g} "
                f"{sp.unit} with {mv.name} in its range: learn it from a record over that range"
            )
        pick = np.flatnonzero(held)[:count].reshape(options.holds + 1, options.lanes)
        levels, lanes = wanted[pick[1:]], np.arange(options.lanes)
        n = options.holds * options.hold
        noise = options.noise * rng.standard_normal((n, options.lanes)) * (lanes % 3 == 0)
        x, u = xs[pick[1:].ravel()], us[pick[1:].ravel()]
        _, jac = plant.step(x, u)
        missing = (jac[:, -1] * u).reshape(options.holds, options.lanes, -1)
        shares = rng.uniform(-options.load, options.load, levels.shape) * (lanes % 3 == 1)
        begins = rng.uniform(*LOADED, levels.shape) * options.hold
        on = np.arange(options.hold)[None, :, None] >= begins[:, None, :]
        load = (on[..., None] * (shares[..., None] * missing)[:, None]).reshape(n, options.lanes, -1)
        return cls(xs[pick[0]], us[pick[0]], np.repeat(levels, options.hold, axis=0), noise, load)
