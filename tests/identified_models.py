"""Identified models made by hand or by least squares. Not a test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from loopwright.pipeline.models import Model
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.simulation.simulate import simulate_open
from loopwright.serving.manifest import Signal

HIDDEN = 6
TOP = 3.0  # of the range of made-up outputs


def made_signals(n_y: int = 1, n_mv: int = 1, n_dv: int = 0) -> Signals:
    """Outputs within +-3, disturbances and MVs within +-1."""
    y = tuple(Signal(f"y{i}", "m", -TOP, TOP) for i in range(n_y))
    dv, mv = (tuple(Signal(f"{kind}{i}", "V", -1.0, 1.0) for i in range(n)) for kind, n in (("d", n_dv), ("u", n_mv)))
    return Signals(1.0, y, y, dv, mv)


def scaled_model(n_y: int, n_mv: int, n_dv: int, n_x: int, n_hidden: int = 0, **buffers: np.ndarray) -> Identified:
    """A model whose scaled numbers are the engineering ones, with these buffers."""
    model = Identified(n_y, n_mv, n_dv, n_x, n_hidden)
    given = {"y_scale": np.ones(n_y), "v_scale": np.ones(n_mv + n_dv), "noise": np.full(n_y, 0.01), **buffers}
    for name, values in given.items():
        getattr(model, name).copy_(torch.from_numpy(np.asarray(values, dtype=np.float64)))
    return model.eval()


def first_order(pole: float = 0.9, gain: float = 2.0, dead: int = 0, disturbance: float | None = None) -> Identified:
    """y+ = a y + (1 - a) gain u(k - dead), and of a measured disturbance; the past inputs are states."""
    n_dv, n_x = 0 if disturbance is None else 1, 1 + dead
    a, b, rest = np.zeros((n_x, n_x)), np.zeros((n_x, 1 + n_dv)), np.zeros((n_x, 3 + n_dv))
    a[0, 0], rest[0, 0] = pole, 1.0
    if dead:
        a[0, -1], b[1, 0] = (1 - pole) * gain, 1.0
        a[2:, 1:-1] = np.eye(dead - 1)
        rest[1:, 1] = 1.0
    else:
        b[0, 0] = (1 - pole) * gain
    if disturbance is not None:
        b[0, 1] = (1 - pole) * disturbance
    return scaled_model(1, 1, n_dv, n_x, a=a, b=b, rest=rest, dead=np.array([float(dead)]))


def random_model(seed: int, n_y: int = 1, n_mv: int = 1, n_dv: int = 0, n_x: int = 4, n_hidden: int = 5) -> Identified:
    """A stable model of random numbers."""
    rng, n_v = np.random.default_rng(seed), n_mv + n_dv
    a = rng.normal(size=(n_x, n_x))
    a *= 0.85 / np.abs(np.linalg.eigvals(a)).max()
    return scaled_model(
        n_y, n_mv, n_dv, n_x, n_hidden, a=a, b=0.3 * rng.normal(size=(n_x, n_v)), c=0.1 * rng.normal(size=n_x),
        w1=0.5 * rng.normal(size=(n_hidden, n_x + n_v)), b1=0.3 * rng.normal(size=n_hidden),
        w2=0.1 * rng.normal(size=(n_x, n_hidden)), rest=np.eye(n_x, n_y + n_v + 1), rest_cov=0.01 * np.eye(n_x),
    )  # fmt: skip


def parts(plant: EquationPlant) -> dict[str, Model]:
    """The quick model set of a plant with one MV: lags of its CV and MV, W1 random, A and W2 by least squares.

    Good enough to be smooth, finite and stable; nothing is asserted of its accuracy.
    """
    rng, mv, cv = np.random.default_rng(0), plant.mv_signals[0], plant.pv_signals[0]
    x0, _ = plant.start
    moves = np.repeat(rng.uniform(mv.low, mv.high, (80, 1)), 10, axis=0)
    y = plant.measured(simulate_open(plant, x0, moves))[:-1, 0]
    center, scale, half = y.mean(), y.std(), 0.5 * (mv.high - mv.low)
    y, u = (y - center) / scale, (moves[:, 0] - 0.5 * (mv.high + mv.low)) / half
    phi = np.stack([y[1:-1], y[:-2], u[:-2], u[1:-1]], axis=1)  # [x, v]
    w1, b1 = rng.normal(size=(HIDDEN, 4)), rng.normal(size=HIDDEN)
    columns = np.hstack([phi, np.ones((len(phi), 1)), np.tanh(phi @ w1.T + b1)])
    ridge = 1e-3 * len(phi) * np.eye(columns.shape[1])
    theta = np.linalg.solve(columns.T @ columns + ridge, columns.T @ y[2:])
    a, b, w2 = np.zeros((3, 3)), np.zeros((3, 1)), np.zeros((3, HIDDEN))
    a[0], b[0, 0], w2[0] = theta[:3], theta[3], theta[5:]
    a[1, 0], b[2, 0] = 1.0, 1.0
    model = scaled_model(
        1, 1, 0, 3, HIDDEN, a=a, b=b, c=np.array([theta[4], 0, 0]), w1=w1, b1=b1, w2=w2, noise=np.array([0.01]),
        y_center=np.array([center]), y_scale=np.array([scale]), v_center=np.array([0.5 * (mv.high + mv.low)]),
        v_scale=np.array([half]), rest=np.array([[1.0, 0, 0], [1, 0, 0], [0, 1, 0]]), rest_cov=1e-3 * np.eye(3),
    )  # fmt: skip
    assert cv.low < center < cv.high
    return {"identified": model}


@dataclass(frozen=True)
class AllRead:
    """As much of a scaled record as a search asks for, each row with a new reading."""

    y: np.ndarray
    v: np.ndarray

    @property
    def readings(self) -> int:
        return self.y.size

    def rows(self, rows: slice) -> AllRead:
        return AllRead(self.y[rows], self.v[rows])
