"""A plant from a person's own file, a Python class or an FMU: its period, loads and checks are those of any plant."""

from __future__ import annotations

import importlib.util
import inspect
import re
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, final

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.fmu.description import FmuTable, table_path
from loopwright.pipeline.plants.fmu.program import FmuFile
from loopwright.pipeline.plants.program import Interface, Program
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.manifest import Signal

NAME = re.compile(r"[A-Za-z0-9_.\-/:#]{1,64}")
METHODS = ("start", "step", "measure")
EXAMPLE = "examples/own_simulator/heater.py shows one"


@final
class PythonFile:
    """The class in a file.

    The class has ``period_s`` [s], ``pv`` and ``mv``, and may have ``dv`` and ``noise``: name -> (unit, low, high),
    of ``noise`` name of a PV -> standard deviation in its unit. Its methods, for states x (n_x,) of any meaning:

        start()        -> x, mv or x, mv, dv     a rest
        step(x, mv, dv) -> x                     one period later; nothing may be kept beside x
        measure(x)     -> pv

    Raises PlantError for a file without such a class, and for whatever its methods raise or return by mistake.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._own = _made(path)
        period = getattr(self._own, "period_s", None)
        if not isinstance(period, int | float):
            raise self.wrong(f"period_s is {period!r}; a positive number of seconds is wanted")
        noise = getattr(self._own, "noise", {})
        try:
            stated = {str(name): float(value) for name, value in noise.items()}
        except (AttributeError, TypeError, ValueError):
            raise self.wrong(f"noise is {noise!r}; a dict, name of a pv: standard deviation, is wanted") from None
        pv, mv, dv = (self._signals(role) for role in ("pv", "mv", "dv"))
        self.interface = Interface(float(period), pv, mv, dv, stated)

    def start(self) -> tuple[Array, Array, Array]:
        """The start by the class; without measured disturbances it may leave them out."""
        given = self._called("start")
        n = 3 if self.interface.dv else 2
        if not isinstance(given, tuple | list) or len(given) != n:
            raise self.wrong(f"start() must return {'x, mv, dv' if n == 3 else 'x, mv'}")
        x = self._array("start (x)", given[0], None)
        mv = self._array("start (mv)", given[1], (len(self.interface.mv),))
        return x, mv, self._array("start (dv)", given[2] if n == 3 else [], (len(self.interface.dv),))

    def step(self, x: Array, mv: Array, dv: Array, periods: int) -> Array:
        """So many steps of the class; PlantError names the line of the file where it fails."""
        for _ in range(periods):
            x = self._array("step", self._called("step", x.copy(), mv, np.array(dv, dtype=np.float64)), x.shape)
        return x

    def measure(self, x: Array) -> Array:
        """The PVs by the class."""
        return self._array("measure", self._called("measure", x.copy()), (len(self.interface.pv),))

    def compared(self, x: Array) -> Array:
        """All of the state."""
        return x

    def wrong(self, words: str) -> PlantError:
        """The words after the file's name, and the example that is right."""
        return PlantError(f"{self.path}: {words}; {EXAMPLE}")

    def _signals(self, role: str) -> tuple[Signal, ...]:
        stated = getattr(self._own, role, {})
        form = f"{role} must be a dict, name: (unit, low, high)"
        if not isinstance(stated, Mapping):
            raise self.wrong(f"{form}, not {stated!r}")
        found = []
        for name, row in stated.items():
            if not NAME.fullmatch(str(name)):
                raise self.wrong(f"{role} has the name {name!r}; letters, digits and _ . - / : # are allowed")
            try:
                unit, low, high = row
                found.append(Signal(str(name), str(unit), float(low), float(high)))
            except (TypeError, ValueError):
                raise self.wrong(f"{form}; {name!r} has {row!r}") from None
            except LoopwrightError as error:
                raise self.wrong(str(error)) from None
        return tuple(found)

    def _called(self, method: str, *arguments: Array) -> Any:
        try:
            return getattr(self._own, method)(*arguments)
        except Exception as error:
            rows = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == str(self.path)]
            where = f"line {rows[-1].lineno}, {method}()" if rows else f"{method}()"
            raise PlantError(f"{self.path}: {where}: {type(error).__name__}: {error}") from None

    def _array(self, what: str, given: Any, shape: tuple[int, ...] | None) -> Array:
        try:
            values = np.atleast_1d(np.array(given, dtype=np.float64))
        except (TypeError, ValueError):
            raise self.wrong(f"{what} gave {given!r}; numbers are wanted") from None
        if values.ndim != 1 or (shape is not None and values.shape != shape):
            raise self.wrong(f"{what} gave shape {values.shape}; {shape or '(n_x,)'} is wanted")
        return values


def _made(path: Path) -> Any:
    """An instance of the one class of the file that has METHODS."""
    spec = importlib.util.spec_from_file_location(f"own_simulator_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise PlantError(f"{path} is no Python file; give one with the class of your plant ({EXAMPLE}), or an FMU")
    module = importlib.util.module_from_spec(spec)
    makes: Callable[[], Any]
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise PlantError(f"{path} cannot be loaded: {type(error).__name__}: {error}") from None
    own = [c for _, c in inspect.getmembers(module, inspect.isclass) if c.__module__ == module.__name__]
    fit = [c for c in own if all(callable(getattr(c, m, None)) for m in METHODS)]
    if len(fit) != 1:
        has = f"it has {', '.join(c.__name__ for c in fit or own) or 'no class'}"
        raise PlantError(f"{path}: one class with {', '.join(METHODS)} is wanted; {has}; {EXAMPLE}")
    (makes,) = fit
    try:
        return makes()
    except Exception as error:
        raise PlantError(f"{path}: {fit[0].__name__}() failed: {type(error).__name__}: {error}") from None


# --------------------------------------------------------------------------------------------- a simulator in any file
FMU = ".fmu"
NOISE_SHARE = 0.002  # of a PV's range, where the file states no noise


@final
class FileSimulator(Simulator):
    """The program in a file as a plant: ``PythonFile``, or ``FmuFile`` with the table of its variables.

    Parameters, by name: ``load_MV`` (0, in the MV's unit) is added to each MV behind the controller's back, within
    the MV's range. It is the load that a test can put on any plant.

    ``every``: periods of the program in one of the plant, its MVs held. ``table``: None for the one beside the FMU.

    Raises PlantError for a file that holds no such program, and for whatever the program does by mistake.
    """

    def __init__(self, path: Path, name: str = "", every: int = 1, table: FmuTable | None = None) -> None:
        self.path, self.every = Path(path), every
        if not self.path.is_file():
            words = f"give a Python file with the class of your plant ({EXAMPLE}), or an FMU"
            raise PlantError(f"{self.path}: no such file; {words}")
        self.table = FmuTable.beside(self.path) if table is None and is_fmu(self.path) else table
        self._program: Program = PythonFile(self.path) if self.table is None else FmuFile(self.path, self.table)
        has = self._program.interface
        for role, signals in (("pv", has.pv), ("mv", has.mv)):
            if not signals:
                raise self._program.wrong(f"{role} is empty or missing; one signal or more is wanted")
        if not 0 < has.period_s < np.inf:
            raise self._program.wrong(f"period_s is {has.period_s!r}; a positive number of seconds is wanted")
        # The attributes that other plants have by their class, this one has by its file.
        vars(self).update(
            name=name or self.path.stem,
            title=(name or self.path.stem).replace("_", " ").capitalize(),
            period_s=every * has.period_s,
            sp_signals=has.pv,
            pv_signals=has.pv,
            mv_signals=has.mv,
            dv_signals=has.dv,
        )
        self._low, self._high = (np.array([getattr(s, end) for s in has.mv]) for end in ("low", "high"))
        self._x0, self._mv0, self._dv0 = self._started()
        self._noise = self._stated_noise()
        self._check()

    def __reduce__(self) -> tuple[Any, ...]:
        return FileSimulator, (self.path, self.name, self.every, self.table)

    @property
    def strides(self) -> bool:
        """Whether a step of many periods is as much work as a step of one."""
        return self._program.interface.strides

    # ------------------------------------------------------------------ what a closed loop needs
    @property
    def start(self) -> tuple[Array, Array]:
        """(x (n_x,), mv (n_mv,)) as the program says."""
        return self._x0.copy(), self._mv0.copy()

    @property
    def dv_nominal(self) -> Array:
        """Measured disturbances at the start, shape (n_dv,)."""
        return self._dv0.copy()

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measurement noise, shape (n_pv,): NOISE_SHARE of the range where none is stated."""
        return self._noise.copy()

    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        """The state (n_x,) one period later; PlantError where the program fails."""
        acting = np.minimum(np.maximum(mv + p, self._low), self._high)
        return self._program.step(x, acting, dv, self.every)

    def measure(self, x: Array) -> Array:
        """The process variables (n_pv,) of a state (n_x,)."""
        return self._program.measure(x)

    # ------------------------------------------------------------------ parameters
    def parameter_names(self) -> tuple[str, ...]:  # type: ignore[override]  # they follow the signals of the file
        """Names of the loads, one an MV."""
        return tuple(f"load_{s.name}" for s in self.mv_signals)

    def parameter_units(self) -> dict[str, str]:  # type: ignore[override]
        """Unit of each load: its MV's."""
        return {f"load_{s.name}": s.unit for s in self.mv_signals}

    def parameters(self, changed: Mapping[str, float] | None = None) -> Array:
        """The loads (n_mv,), zero but for those that are changed by name; PlantError for an unknown name."""
        values = dict.fromkeys(self.parameter_names(), 0.0)
        for key, value in (changed or {}).items():
            if key not in values:
                raise PlantError(f"plant {self.name!r} has no parameter {key!r}; it has {', '.join(values)}")
            values[key] = float(value)
        return np.array(list(values.values()))

    # ------------------------------------------------------------------ checks
    def _started(self) -> tuple[Array, Array, Array]:
        x, mv, dv = self._program.start()
        for signals, values in ((self.mv_signals, mv), (self.dv_signals, dv)):
            for s, v in zip(signals, values, strict=True):
                if not s.low <= v <= s.high:
                    words = f"it starts with {s.name} = {v:g}, outside its range {s.low:g} to {s.high:g}"
                    raise self._program.wrong(words)
        return x, mv, dv

    def _stated_noise(self) -> Array:
        stated = self._program.interface.noise or {}
        unknown = [n for n in stated if n not in {s.name for s in self.pv_signals}]
        if unknown:
            raise self._program.wrong(f"noise names {unknown[0]!r}, which is no pv")
        noise = np.array([stated.get(s.name, NOISE_SHARE * (s.high - s.low)) for s in self.pv_signals])
        if not np.all(np.isfinite(noise) & (noise >= 0)):
            raise self._program.wrong(f"noise is {stated!r}; standard deviations of 0 or more are wanted")
        return noise

    def _check(self) -> None:
        """Finite steps at the start and at the ends of the MVs; one twice: what differs is kept beside the state."""
        dv, p = self._dv0, self.parameters()
        self.measure(self._x0)
        first = self.step(self._x0, self._mv0, dv, p)
        self._check_finite(first, self._mv0)
        for mv in (self._low, self._high):
            self._check_finite(self.step(first, mv, dv, p), mv)
        again = self.step(self._x0, self._mv0, dv, p)
        if not np.array_equal(self._program.compared(first), self._program.compared(again)):
            raise self._program.wrong(
                "a step from the same state gives another result when it is done again: the simulator keeps something "
                "of its own; all that the plant remembers must stand in the state, and no random numbers be drawn"
            )

    def _check_finite(self, x: Array, mv: Array) -> None:
        if np.isfinite(self._program.compared(x)).all() and np.isfinite(self.measure(x)).all():
            return
        at = ", ".join(f"{s.name} = {v:g}" for s, v in zip(self.mv_signals, mv, strict=True))
        raise self._program.wrong(
            f"the first steps, with {at}, give a state or a measurement that is no finite number; check divisions, "
            "roots and logarithms in step() and measure()"
        )


def is_fmu(path: Path) -> bool:
    """Whether a simulator's file is an FMU, by its ending."""
    return path.suffix.lower() == FMU


def files_of(path: Path) -> tuple[Path, ...]:
    """All files that a simulator in a file consists of."""
    return (path, table_path(path)) if is_fmu(path) else (path,)
