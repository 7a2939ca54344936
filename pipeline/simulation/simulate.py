"""A plant under given MVs, or under a controller; sampled, with the MV held over each period."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from pipeline.errors import PlantError
from pipeline.plants.equations import EquationPlant
from pipeline.plants.simulator import Array, Simulator

Step = Callable[[Array, Array, Array], tuple[ArrayLike, ArrayLike]]
"""One step of a controller: (sp (n_sp,), pv (n_pv,), mv_applied (n_mv,)) -> (mv, info); it may keep a state."""


class LoopTest(Protocol):
    """What a closed-loop test says: set points, where it starts, and what changes in the plant."""

    @property
    def sp(self) -> Array:
        """Set point at every sample, shape (n, n_sp)."""

    @property
    def x0(self) -> Array:
        """State at sample 0, shape (n_x,)."""

    @property
    def mv0(self) -> Array:
        """MV applied before sample 0, shape (n_mv,)."""

    @property
    def changes(self) -> Mapping[str, Array]:
        """Plant parameters over every period, each of shape (n,), unknown to the controller."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """What happened in a closed loop; row k belongs to sample k.

    At sample k the PV is measured, then the controller steps, and its move acts over [k, k+1):
    ``sp - pv`` of a row is the error before that row's move has had any effect.
    """

    time_s: Array  # (n,) s
    sp: Array  # (n, n_sp)
    pv: Array  # (n, n_pv) true
    measured: Array  # (n, n_pv) what the controller saw: pv plus noise
    mv: Array  # (n, n_mv)
    x: Array  # (n, n_x)
    info: Array  # (n, n_info) what the controller told of its step


def simulate_open(
    plant: Simulator, x0: Array, mv: Array, parameters: Mapping[str, float | Array] | None = None
) -> Array:
    """States under a sequence of MVs, shape (n + 1, n_x), the first of them ``x0``.

    Parameters
    ----------
    plant : Simulator
        Measured disturbances stay nominal.
    x0 : array, shape (n_x,)
        State at sample 0.
    mv : array, shape (n, n_mv)
        MV held over [k, k+1).
    parameters : mapping, optional
        Plant parameters that differ from the plant's own: a number, or one a period, shape (n,).

    Raises
    ------
    PlantError
        For an unknown parameter, a wrong shape, or a state that is not finite (naming the sample).
    """
    mv = _checked("mv", mv, (len(mv), len(plant.mv_signals)))
    rows = parameter_rows(plant, len(mv), parameters)
    step, dv = plant.stepper(), plant.dv_nominal
    x = np.empty((len(mv) + 1, plant.n_x))
    x[0] = _checked("x0", x0, x[0].shape)
    for k in range(len(mv)):
        x[k + 1] = step(x[k], mv[k], dv, rows[k])
    _check_finite(plant, x)
    return x


def simulate_batch(plant: Simulator, x0: Array, mv: Array, parameters: Mapping[str, float] | None = None) -> Array:
    """States of many short runs, shape (b, n + 1, n_x), from x0 (b, n_x) under mv (b, n, n_mv).

    Raises PlantError as ``simulate_open`` does.
    """
    b, n = mv.shape[:2]
    mv = _checked("mv", mv, (b, n, len(plant.mv_signals)))
    x = np.empty((b, n + 1, plant.n_x))
    x[:, 0] = _checked("x0", x0, (b, x.shape[2]))
    advance = plant.many(b, parameters)
    for k in range(n):
        x[:, k + 1] = advance(x[:, k], mv[:, k])
    broken = np.flatnonzero(~np.isfinite(x).all(axis=(1, 2)))
    if broken.size:
        _check_finite(plant, x[broken[0]])
    return x


def simulate_closed(
    plant: Simulator, step: Step, test: LoopTest, *, noise: Sequence[float] | Array | None = None, seed: int = 0
) -> Trajectory:
    """Close the loop of a controller over a plant.

    Parameters
    ----------
    plant : Simulator
        Measured disturbances stay nominal.
    step : callable
        ``step(sp, pv, mv_applied) -> (mv, info)``; at sample 0 ``mv_applied`` is the test's ``mv0``.
    test : LoopTest
        A scenario of a case: set points, start, changes of plant parameters.
    noise : sequence of float, optional
        Standard deviation of the Gaussian measurement noise of each PV, in the PV's unit.
    seed : int
        Of the noise.

    Raises
    ------
    PlantError
        For an unknown parameter, a wrong shape, an MV or a state that is not finite (naming the sample).
    """
    n, n_pv, n_mv = len(test.sp), len(plant.pv_signals), len(plant.mv_signals)
    rows = parameter_rows(plant, n, test.changes)
    deviation = noise_draws(plant, n, noise, np.random.default_rng(seed))
    advance, dv = plant.stepper(), plant.dv_nominal
    x, pv = np.empty((n, plant.n_x)), np.empty((n, n_pv))
    seen, mv = np.empty((n, n_pv)), np.empty((n, n_mv))
    info: list[Array] = []
    state = _checked("x0", test.x0, x.shape[1:])
    applied = _checked("mv0", test.mv0, (n_mv,))
    for k in range(n):
        x[k] = state
        pv[k] = plant.measure(state)
        seen[k] = pv[k] + deviation[k]
        move, told = step(test.sp[k], seen[k], applied)
        applied = _checked("the controller's MV", move, (n_mv,))
        if not np.isfinite(applied).all():
            raise PlantError(f"plant {plant.name!r}: the controller's MV is {applied} at sample {k}; it must be finite")
        mv[k] = applied
        info.append(np.asarray(told, dtype=np.float64).ravel())
        state = advance(state, applied, dv, rows[k])
        if not np.isfinite(state).all():
            raise _not_finite(plant, k + 1, state)
    return Trajectory(
        np.arange(n, dtype=np.float64) * plant.period_s,
        np.array(test.sp),
        pv,
        seen,
        mv,
        x,
        np.array(info).reshape(n, -1),
    )


def noise_draws(plant: Simulator, n: int, noise: Sequence[float] | Array | None, rng: np.random.Generator) -> Array:
    """Measurement noise, shape (n, n_pv), Gaussian with one standard deviation a PV; zeros where there is none.

    Raises PlantError unless there is one finite standard deviation >= 0 a PV.
    """
    names = [s.name for s in plant.pv_signals]
    if noise is None or not len(noise):
        return np.zeros((n, len(names)))
    std = np.asarray(noise, dtype=np.float64)
    if std.shape != (len(names),) or not np.all(np.isfinite(std) & (std >= 0)):
        raise PlantError(
            f"plant {plant.name!r}: noise is {list(noise)}; give one standard deviation >= 0 for each of {names}"
        )
    return rng.standard_normal((n, len(names))) * std


def parameter_rows(plant: Simulator, n: int, changes: Mapping[str, float | Array] | None) -> Array:
    """The plant's parameter vector over every period, shape (n, n_p), with changed ones by name.

    Raises PlantError for an unknown name or a shape other than () or (n,).
    """
    changes = changes or {}
    plant.parameters(dict.fromkeys(changes, 0.0))
    rows = np.tile(plant.parameters(), (n, 1))
    for name, values in changes.items():
        if np.shape(values) not in {(), (n,)}:
            raise PlantError(
                f"plant {plant.name!r}: {name} has shape {np.shape(values)}; give one number or {n}, one a period"
            )
        rows[:, plant.parameter_names().index(name)] = values
    return rows


def _checked(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != shape:
        raise PlantError(f"{name} has shape {array.shape}; {shape} is wanted")
    return array


def _check_finite(plant: Simulator, x: Array) -> None:
    broken = np.flatnonzero(~np.isfinite(x).all(axis=-1))
    if broken.size:
        raise _not_finite(plant, int(broken[0]), x[broken[0]])


def _not_finite(plant: Simulator, sample: int, x: Array) -> PlantError:
    steps = f", or its {plant.substeps} RK4 substeps are too few" if isinstance(plant, EquationPlant) else ""
    return PlantError(
        f"plant {plant.name!r}: the state at sample {sample} is {x}; "
        f"start and MVs must be ones the plant can have{steps}"
    )
