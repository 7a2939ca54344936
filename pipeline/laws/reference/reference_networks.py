"""Controllers that can be trained through time: their MV, and its derivatives by weights and by inputs.

Each is written twice, as a training needs it (batches, derivatives) and as a law's stage needs it (affine
formulas); a test holds the two to each other. Its inputs at sample k, in columns, are r, y, u(k-1), e(k-1),
and the reference model's state x_m (n), with e = y_m - y.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from loopwright.pipeline.models.memory import AffineMap, Named
from loopwright.pipeline.plants.simulator import Array, Signals

R, Y, U, E_BEFORE, FIRST_COURSE = 0, 1, 2, 3, 4  # columns of the inputs
RANGE = 20.0  # of an exponent: beyond it a weight is nothing, or far too large
USUAL_ERROR, USUAL_STEP, USUAL_SPEED = 0.07, 0.3, 0.15  # of the CV's range: usual e, r - y_m and x_m,i, i >= 2
MOVE_REACH = (0.15, 0.35)  # of the MV's range: a move's scale at its low end, and what is added up to its high end


class Action(NamedTuple):
    """The MV [mv] of each lane (B,), and its derivatives by the weights (B, P) and by y, u(k-1), e(k-1), each (B,)."""

    mv: Array
    by_theta: Array
    by_cv: Array
    by_mv: Array
    by_before: Array


@dataclass(frozen=True)
class Trainable(ABC):
    """A controller with weights theta (P,). ``sign`` is that of the plant's gain, dy/du."""

    signals: Signals
    order: int
    sign: float

    @property
    @abstractmethod
    def size(self) -> int:
        """P."""

    @abstractmethod
    def drawn(self, rng: np.random.Generator) -> Array:
        """Weights to start from."""

    @abstractmethod
    def act(self, theta: Array, inputs: Array) -> Action:
        """The action at ``inputs`` (B, 4 + order)."""

    @property
    def _mv(self) -> tuple[float, float]:
        signal = self.signals.mv[0]
        return signal.low, signal.high - signal.low

    @property
    def _cv(self) -> tuple[float, float]:
        signal = self.signals.sp[0]
        return (signal.low + signal.high) / 2, signal.high - signal.low


@dataclass(frozen=True)
class Network(Trainable):
    """A controller that scales its inputs to features, and has ``hidden`` units."""

    hidden: int

    @abstractmethod
    def features(self, p: Named) -> torch.Tensor:
        """The features (..., k), affine in r, y, u, before and course."""

    @cached_property
    def _scaling(self) -> tuple[Array, Array]:
        """(matrix (4 + order, k), offset (k,)) from the inputs to the features."""
        layout = {"r": 1, "y": 1, "u": 1, "before": 1, "course": self.order}
        stage = AffineMap(layout, lambda p: {"all": self.features(p)})
        return stage.matrix.numpy(), stage.offset.numpy()


@dataclass(frozen=True)
class IncrementalNetwork(Network):
    """Adds to the MV a move that is zero where all errors are.

        u = u(k-1) + (c0 + c1 u(k-1)) [g(z, E) - g(z, 0)],   g(z, E) = sum_j w_j tanh(z Wz_j + E We_j + b_j)

    In scaled units, with z = [u(k-1), y], E = [e, e - e(k-1), r - y_m, x_m,2 .. x_m,n], and the hidden
    units j. Where all errors are zero the move is zero, whatever the weights. At rest E = [e, 0, .., 0], and
    w_j = exp(.) > 0 with the weights of e = sign exp(.): the move then has the sign of sign e and no other
    root. Training moves the exponents.
    """

    @property
    def size(self) -> int:
        """P."""
        return self.hidden * (self.order + 6)

    def drawn(self, rng: np.random.Generator) -> Array:
        """Weights of about a slow PI controller: any loop is stable with it, and so is the first free run."""
        h = self.hidden
        by_state, by_other = rng.uniform(-0.3, 0.3, (2, h)), rng.uniform(-0.03, 0.03, (self.order, h))
        by_error = np.log(0.03) + rng.uniform(-0.5, 0.5, (1, h))
        by_change = self.sign * 0.15 + rng.uniform(-0.05, 0.05, (1, h))
        bias, out = rng.uniform(-0.5, 0.5, h), np.log(2.4 / h) + rng.uniform(-0.3, 0.3, h)
        return np.concatenate([np.vstack([by_state, by_error, by_change, by_other]).ravel(), bias, out])

    def weights(self, theta: Array) -> tuple[Array, Array, Array]:
        """(W (2 + errors, H), b (H,), w (H,)): the weights themselves, of which some are exponentials."""
        h = self.hidden
        table, bias, out = theta[: -2 * h].reshape(-1, h).copy(), theta[-2 * h : -h], theta[-h:]
        table[2] = self.sign * np.exp(np.clip(table[2], -RANGE, RANGE))
        return table, bias, np.exp(np.clip(out, -RANGE, RANGE))

    def features(self, p: Named) -> torch.Tensor:
        """[z, E], shape (..., 2 + errors), in scaled units."""
        (middle, span), (low, reach) = self._cv, self._mv
        e = p["course"][..., :1] - p["y"]
        return torch.cat(
            [
                (p["u"] - low) / reach,
                (p["y"] - middle) / (span / 2),
                e / (USUAL_ERROR * span),
                (e - p["before"]) / (USUAL_ERROR * span),
                (p["r"] - p["course"][..., :1]) / (USUAL_STEP * span),
                p["course"][..., 1:] / (USUAL_SPEED * span),
            ],
            dim=-1,
        )

    def reach(self, p: Named) -> torch.Tensor:
        """c0 + c1 u(k-1) in the MV's unit."""
        low, span = self._mv
        return MOVE_REACH[0] * span + MOVE_REACH[1] * (p["u"] - low)

    def act(self, theta: Array, inputs: Array) -> Action:
        """The MV before its limits."""
        table, bias, out = self.weights(theta)
        matrix, offset = self._scaling
        f = inputs @ matrix + offset
        z, errors = f[:, :2], f[:, 2:]
        still = z @ table[:2] + bias
        h0, h1 = np.tanh(still), np.tanh(still + errors @ table[2:])
        move = (h1 - h0) @ out
        low, span = self._mv
        reach = MOVE_REACH[0] * span + MOVE_REACH[1] * (inputs[:, U] - low)
        slope = (1 - h1 * h1) * out
        both = slope - (1 - h0 * h0) * out
        by_table = np.concatenate([z[:, :, None] * both[:, None, :], errors[:, :, None] * slope[:, None, :]], axis=1)
        by_table[:, 2] *= table[2]
        by_theta = np.concatenate([by_table.reshape(len(inputs), -1), both, (h1 - h0) * out], axis=1)
        by_input = np.concatenate([both @ table[:2].T, slope @ table[2:].T], axis=1) @ matrix.T * reach[:, None]
        return Action(
            inputs[:, U] + reach * move,
            by_theta * reach[:, None],
            by_input[:, Y],
            1 + MOVE_REACH[1] * move + by_input[:, U],
            by_input[:, E_BEFORE],
        )


@dataclass(frozen=True)
class TwoErrorNetwork(Network):
    """Two errors and no memory, as printed: u = sum_j w_j tanh(e W1_j + (r - y) W2_j + b_j) + d in scaled units.

    Where it is at rest both errors are constant; a set point that is held without offset makes both zero,
    and then there is one MV for all set points. So it cannot be free of offset at more than one.
    """

    @property
    def size(self) -> int:
        """P."""
        return 4 * self.hidden + 1

    def drawn(self, rng: np.random.Generator) -> Array:
        """Weights of about a proportional controller around a third of the MV's range."""
        h = self.hidden
        table, bias = self.sign * rng.uniform(0.1, 0.5, (2, h)), rng.uniform(-0.5, 0.5, h)
        out = np.full(h, 1.0 / h) * rng.uniform(0.5, 1.5, h)
        return np.concatenate([table.ravel(), bias, out, [1 / 3]])

    def weights(self, theta: Array) -> tuple[Array, Array, Array, float]:
        """(W (2, H), b (H,), w (H,), d)."""
        h = self.hidden
        return theta[: 2 * h].reshape(2, h), theta[2 * h : 3 * h], theta[3 * h : 4 * h], float(theta[-1])

    def features(self, p: Named) -> torch.Tensor:
        """[e, r - y], shape (..., 2), in scaled units."""
        span = self._cv[1]
        return torch.cat([p["course"][..., :1] - p["y"], p["r"] - p["y"]], dim=-1) / (USUAL_ERROR * span)

    def act(self, theta: Array, inputs: Array) -> Action:
        """The MV before its limits."""
        table, bias, out, level = self.weights(theta)
        matrix, offset = self._scaling
        low, span = self._mv
        f = inputs @ matrix + offset
        h = np.tanh(f @ table + bias)
        slope = (1 - h * h) * out
        by_table = (f[:, :, None] * slope[:, None, :]).reshape(len(inputs), -1)
        by_theta = np.concatenate([by_table, slope, h, np.ones((len(inputs), 1))], axis=1)
        by_input = slope @ table.T @ matrix.T * span
        mv = low + span * (h @ out + level)
        return Action(mv, span * by_theta, by_input[:, Y], by_input[:, U], by_input[:, E_BEFORE])


@dataclass(frozen=True)
class TrainablePi(Trainable):
    """u = u(k-1) + Kc [e - e(k-1) + (h/Ti) e], trained by the logarithms of |Kc| and h/Ti."""

    @property
    def size(self) -> int:
        """P."""
        return 2

    def drawn(self, rng: np.random.Generator) -> Array:
        """A slow controller: a full-range error moves the MV over five of its ranges, in ten periods again."""
        (_, cv), (_, mv) = self._cv, self._mv
        return np.log([5 * mv / cv, 0.1]) + rng.uniform(-0.3, 0.3, 2)

    def settings(self, theta: Array) -> tuple[float, float]:
        """(Kc [mv/pv], Ti [s])."""
        kc, share = np.exp(np.clip(theta, -RANGE, RANGE))
        return self.sign * float(kc), self.signals.period_s / float(share)

    def act(self, theta: Array, inputs: Array) -> Action:
        """The MV before its limits."""
        kc, ti = self.settings(theta)
        share = self.signals.period_s / ti
        e = inputs[:, FIRST_COURSE] - inputs[:, Y]
        move = kc * (e - inputs[:, E_BEFORE] + share * e)
        by_theta = np.stack([move, kc * share * e], axis=1)
        ones = np.ones(len(inputs))
        return Action(inputs[:, U] + move, by_theta, -kc * (1 + share) * ones, ones, -kc * ones)
