"""A simulator in a Python file: one class with ``start``, ``step``, ``measure`` and its signals."""

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
from loopwright.pipeline.plants.program import Interface
from loopwright.pipeline.plants.simulator import Array
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
