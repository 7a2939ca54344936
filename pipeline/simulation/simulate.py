"""A plant under given MVs, or under a controller; sampled, with the MV held over each period."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.noise import coloured
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.simulation.scenario import Scenario

DV_DRAW = 1  # beside the seed of a loop: the noise of its measured disturbances is drawn by itself

Step = Callable[[Array, Array, Array], tuple[ArrayLike, ArrayLike]]
"""One step of a controller: (sp (n_sp,), pv (n_pv,), mv_applied (n_mv,)) -> (mv, info); it may keep a state."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A closed loop; row k belongs to sample k, so ``sp - pv`` is the error before that row's move acts."""

    time_s: Array  # (n,) s
    sp: Array  # (n, n_sp)
    pv: Array  # (n, n_pv) true
    measured: Array  # (n, n_pv) pv plus noise, what the controller was given
    mv: Array  # (n, n_mv)
    x: Array  # (n, n_x)
    info: Array  # (n, n_info) of the controller's steps


def simulate_open(plant: Simulator, x0: Array, mv: Array) -> Array:
    """States under a sequence of MVs, shape (n + 1, n_x), the first of them ``x0``.

    x0 (n_x,) at sample 0; mv (n, n_mv), each row held over [k, k+1). Measured disturbances and parameters
    are the plant's own. Raises PlantError for a wrong shape or a state that is not finite (naming the sample).
    """
    mv = _checked("mv", mv, (len(mv), len(plant.mv_signals)))
    step, dv, p = plant.stepper(), plant.dv_nominal, plant.parameters()
    x = np.empty((len(mv) + 1, plant.n_x))
    x[0] = _checked("x0", x0, x[0].shape)
    for k in range(len(mv)):
        x[k + 1] = step(x[k], mv[k], dv, p)
    _check_finite(plant, x)
    return x


def simulate_batch(plant: Simulator, x0: Array, mv: Array) -> Array:
    """States of many short runs, shape (b, n + 1, n_x), from x0 (b, n_x) under mv (b, n, n_mv).

    Raises PlantError as ``simulate_open`` does.
    """
    b, n = mv.shape[:2]
    mv = _checked("mv", mv, (b, n, len(plant.mv_signals)))
    x = np.empty((b, n + 1, plant.n_x))
    x[:, 0] = _checked("x0", x0, (b, x.shape[2]))
    advance = plant.many(b)
    for k in range(n):
        x[:, k + 1] = advance(x[:, k], mv[:, k])
    for run in x:
        _check_finite(plant, run)
    return x


def simulate_closed(
    plant: Simulator,
    step: Step,
    test: Scenario,
    *,
    noise: Sequence[float] | Array | None = None,
    seed: int = 0,
    every: Sequence[int] = (),
) -> Trajectory:
    """Close the loop of a controller over a plant; its measured disturbances are those of the test.

    ``step(sp, pv, mv_applied) -> (mv, info)``; at sample 0 ``mv_applied`` is the test's ``mv0``. ``noise`` holds
    the standard deviation of the Gaussian measurement noise of each PV, in the PV's unit; ``seed`` is its seed.
    ``every`` (n_pv,): samples from one new reading of a PV to the next, see ``read_now``; between them the last one
    stands. Empty: each PV is read at each sample.

    Raises PlantError for an unknown parameter, a wrong shape, an MV or a state that is not finite (naming the sample).
    """
    n, n_mv = test.samples, len(plant.mv_signals)
    parameters = test.parameters(plant)
    deviation = noise_draws(plant, n, noise, np.random.default_rng(seed))
    advance, measure, dv = plant.stepper(), plant.meter(), test.disturbances(plant)
    x, pv, mv, info = np.empty((n + 1, plant.n_x)), np.empty(deviation.shape), np.empty((n, n_mv)), []
    x[0] = _checked("x0", test.x0, x.shape[1:])
    applied = _checked("mv0", test.mv0, (n_mv,))
    for k in range(n):
        pv[k] = measure(x[k])
        if k and every:  # what stands there is no new number
            stands = ~read_now(every, k)
            deviation[k, stands] = pv[k - 1, stands] + deviation[k - 1, stands] - pv[k, stands]
        move, row = step(test.sp[k], pv[k] + deviation[k], applied)
        applied = mv[k] = _checked("the controller's MV", move, (n_mv,))
        if not isfinite(sum(applied.tolist())) and not np.isfinite(applied).all():  # a finite sum is quick to see
            raise PlantError(f"plant {plant.name!r}: the controller's MV is {applied} at sample {k}; it must be finite")
        info.append(np.asarray(row, dtype=np.float64).ravel())
        x[k + 1] = advance(x[k], applied, dv[k], parameters[k])
        if not isfinite(sum(x[k + 1].tolist())):
            _check_finite(plant, x[: k + 2])
    time_s = np.arange(n, dtype=np.float64) * plant.period_s
    return Trajectory(time_s, test.sp.copy(), pv, pv + deviation, mv, x[:-1], np.array(info).reshape(n, -1))


def read_now(every: Sequence[int], k: int) -> NDArray[np.bool_]:
    """Whether each PV (n_pv,) has a new reading at sample k: every ``every`` samples, and all at first."""
    return np.array([k % n == 0 for n in every])


def noise_draws(plant: Simulator, n: int, noise: Sequence[float] | Array | None, rng: np.random.Generator) -> Array:
    """Measurement noise, shape (n, n_pv), Gaussian with one standard deviation a PV; zeros where there is none.

    Its colour is the plant's ``noise_colour``, which leaves the standard deviation as it is. Raises PlantError unless
    there is one finite standard deviation >= 0 a PV.
    """
    names = [s.name for s in plant.pv_signals]
    if noise is None or not len(noise):
        return np.zeros((n, len(names)))
    std = np.asarray(noise, dtype=np.float64)
    if std.shape != (len(names),) or not np.all(np.isfinite(std) & (std >= 0)):
        raise PlantError(
            f"plant {plant.name!r}: noise is {list(noise)}; give one standard deviation >= 0 for each of {names}"
        )
    return coloured(rng.standard_normal((n, len(names))), plant.noise_colour) * std


def noise_of_disturbances(plant: Simulator, n: int, rng: np.random.Generator, size: float = 1.0) -> Array:
    """Noise (n, n_dv) of the measured disturbances, ``size`` times the plant's ``dv_noise_std``, white."""
    return size * plant.dv_noise_std * rng.standard_normal((n, len(plant.dv_signals)))


def _checked(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != shape:
        raise PlantError(f"{name} has shape {array.shape}; {shape} is wanted")
    return array


def _check_finite(plant: Simulator, x: Array) -> None:
    broken = np.flatnonzero(~np.isfinite(x).all(axis=-1))
    if broken.size:
        steps = f", or its {plant.substeps} RK4 substeps are too few" if isinstance(plant, EquationPlant) else ""
        raise PlantError(
            f"plant {plant.name!r}: the state at sample {broken[0]} is {x[broken[0]]}; "
            f"start and MVs must be ones the plant can have{steps}"
        )
