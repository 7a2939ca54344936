"""The identified model, a linear state space with tanh units, and how it is assembled from fitted arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from loopwright.pipeline.dynamics.step_response import ANSWER_PERIODS, answers_after
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.fresh_errors import changes_of, deviation_of
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales
from loopwright.pipeline.models.identified.steady_states import central_map, rest_map
from loopwright.pipeline.plants.simulator import Array


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
    ``load_moves`` are changes of the loads from row to row over ``recorded`` rows, 0 of a model without loads:
    x(k+1) has the sum of them added to its first ``n_y`` states. ``dv_noise`` and ``dv_change`` are standard
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


def remembering(model: Dynamics, delays: Sequence[int]) -> Dynamics:
    """The model whose input j acts ``delays[j]`` periods later: x = [x of the model, past inputs, newest first]."""
    n, n_v, total = model.n_x, model.n_v, int(sum(delays))
    a, b, c = np.zeros((n + total, n + total)), np.zeros((n + total, n_v)), np.zeros(n + total)
    w1, w2 = np.zeros((model.n_hidden, n + total + n_v)), np.zeros((n + total, model.n_hidden))
    a[:n, :n], c[:n], w1[:, :n], w2[:n] = model.a, model.c, model.w1[:, :n], model.w2
    at = n
    for j, d in enumerate(delays):
        if not d:
            b[:n, j], w1[:, n + total + j] = model.b[:, j], model.w1[:, n + j]
            continue
        b[at, j] = 1.0
        a[at + 1 : at + d, at : at + d - 1] = np.eye(d - 1)
        a[:n, at + d - 1], w1[:, at + d - 1] = model.b[:, j], model.w1[:, n + j]
        at += d
    return Dynamics(a, b, c, w1, model.b1, w2)


def handed_over(model: Dynamics, late: Sequence[int]) -> Dynamics:
    """The model whose output i comes ``late[i]`` periods later, as an analyser's numbers do.

    x = [outputs as they come, other states of the model, late outputs as they are, past ones, newest first]
    """
    order, total = handing_order(model.n_x, late), int(sum(late))
    n, n_v = model.n_x, model.n_v
    a, b, c = np.zeros((n + total, n + total)), np.zeros((n + total, n_v)), np.zeros(n + total)
    w1, w2 = np.zeros((model.n_hidden, n + total + n_v)), np.zeros((n + total, model.n_hidden))
    a[:n, :n], b[:n], c[:n], w2[:n] = model.a, model.b, model.c, model.w2
    at = n
    for i, d in enumerate(late):
        if d:
            a[at, i] = 1.0
            a[at + 1 : at + d, at : at + d - 1] = np.eye(d - 1)
            at += d
    w1[:, :n], w1[:, n + total :] = model.w1[:, :n], model.w1[:, n:]
    w1 = np.hstack([w1[:, order], w1[:, n + total :]])
    return Dynamics(a[np.ix_(order, order)], b[order], c[order], w1, model.b1, w2[order])


def handing_order(n_x: int, late: Sequence[int]) -> list[int]:
    """Places of the states of ``handed_over`` in [x of the model, past values of each late output, newest first]."""
    firsts = [n_x + sum(late[:i]) for i in range(len(late))]
    ends = [first + d - 1 if d else i for i, (first, d) in enumerate(zip(firsts, late, strict=True))]
    others = [k for k in range(n_x + sum(late)) if k not in ends]
    return [*ends, *others]


def noise_of(residuals: Sequence[Array]) -> Array:
    """Standard deviation (n_y,) of the measurement noise from free-run residuals (n, n_y) of each stretch.

    min(sd of the differenced residual / sqrt 2, sd of the residual): what the model misses is mostly slow.
    """
    return np.asarray(np.minimum(deviation_of(changes_of(residuals)) / np.sqrt(2), deviation_of(residuals)))


def assemble_model(
    model: Dynamics,
    delays: Sequence[int],
    scales: Scales,
    data: ScaledRecord,
    known: Mapping[str, Array],
    n_mv: int,
    seed: int,
    late: Sequence[int] = (),
) -> Identified:
    """The finished model of fitted ``model`` under inputs late by ``delays`` (n_v,), outputs by ``late`` (n_y,).

    ``known`` are its scaled ``noise`` (n_y,), the noise's ``colour``, the ``load_moves`` (n, n_y) of the record, the
    ``dv_noise`` and ``dv_change`` of its measured disturbances, and what the record leaves open: ``gain_sd``,
    ``pace_sd``, ``dead_sd``.
    """
    whole, n_y, n_v = remembering(model, delays), data.y.shape[1], data.v.shape[1]
    table, covariance = rest_map(model, data.y, data.v, seed)
    n, total = model.n_x, whole.n_x
    rest, rest_cov = np.zeros((total, n_y + n_v + 1)), np.zeros((total, total))
    rest[:n], rest_cov[:n, :n] = table, covariance
    rest[n:, n_y : n_y + n_v] = np.repeat(np.eye(n_v), delays, axis=0)
    late = tuple(late) or (0,) * n_y
    if any(late):
        order = handing_order(total, late)
        past = np.repeat(np.eye(n_y, n_y + n_v + 1), late, axis=0)
        rest = np.vstack([rest, past])[order]
        rest_cov = np.pad(rest_cov, (0, sum(late)))[np.ix_(order, order)]
        whole = handed_over(whole, late)
        total = whole.n_x
    config = {"n_y": n_y, "n_mv": n_mv, "n_dv": n_v - n_mv, "n_x": total, "n_hidden": model.n_hidden}
    config["recorded"] = len(known["load_moves"])
    arrays = {
        **{name: getattr(whole, name) for name in ("a", "b", "c", "w1", "b1", "w2")},
        **{name: getattr(scales, name) for name in ("y_center", "y_scale", "v_center", "v_scale")},
        **known,
        "rest": rest,
        "rest_cov": rest_cov,
        "dead": dead_periods(pair_answers(model, data) + np.asarray(late))[:n_mv]
        + np.asarray(delays[:n_mv], dtype=np.float64),
    }
    return Identified.from_arrays(config, arrays)


def pair_answers(model: Dynamics, data: ScaledRecord) -> NDArray[np.int64]:
    """Periods (n_v, n_y) from a small step of each input to the first answer of each output, at the centre of the data.

    See ``answers_after``, over ANSWER_PERIODS. It is 1 without a dead time, ANSWER_PERIODS + 1 where nothing moves.
    Delays of the inputs before the model are not in it.
    """
    middle = np.median(data.v, axis=0)
    start = central_map(model, data) @ np.concatenate([np.zeros(data.y.shape[1]), middle, [1.0]])
    size = 0.5 * data.v.std(axis=0)
    response = step_responses(model, start, middle, size, ANSWER_PERIODS)[..., : data.y.shape[1]]
    return answers_after(np.moveaxis(response, 1, -1))


def dead_periods(answers: NDArray[np.int64]) -> Array:
    """Fewest whole periods (n_v,) without an answer at any output, of ``pair_answers`` (n_v, n_y); 0 without answers.

    theta_j = min_i k_ij - 1
    """
    silent = answers.min(axis=1) - 1
    return np.where(silent < ANSWER_PERIODS, silent, 0).astype(np.float64)


def step_responses(model: Dynamics, x: Array, v: Array, size: Array, length: int) -> Array:
    """Changes (n_v, length, n_x) of the free run from x (n_x,) under v (n_v,) by steps of ``size`` (n_v,)."""
    n_v = len(v)
    inputs = np.concatenate([v + np.diag(size), v[None]])
    states = np.tile(x, (n_v + 1, 1))
    found = np.empty((n_v, length, len(x)))
    for k in range(length):
        states = model.advance(states, inputs)
        found[:, k] = states[:-1] - states[-1]
    return found
