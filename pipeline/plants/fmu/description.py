"""The modelDescription.xml of an FMU, and which of its variables are the plant's signals."""

from __future__ import annotations

import importlib
import math
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.files import read_json, write_json
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.manifest import Signal

REAL = {"Real", "Float64"}
INSTALL = "pip install 'loopwright[fmu]'"


@dataclass(frozen=True, slots=True)
class FmuVariable:
    """A real variable; None where the FMU states no value."""

    name: str
    reference: int
    causality: str  # input, output, local, parameter, ...
    unit: str
    low: float | None
    high: float | None
    start: float | None
    words: str


@dataclass(frozen=True, slots=True)
class Description:
    """An FMU for co-simulation that can run on this machine."""

    path: Path
    version: int  # of FMI: 2 or 3
    variables: dict[str, FmuVariable] = field(repr=False)  # scalar and real ones, by name
    others: dict[str, str] = field(repr=False)  # name -> type of those that are neither
    begins_s: float
    step_s: float | None  # proposed communication step
    any_step: bool  # takes a step of any length; otherwise all are to be as long as step_s
    keeps_states: bool
    writes_states: bool  # can turn them into bytes
    single: bool  # has no more than one instance in a process
    model: Any = field(repr=False)  # fmpy's, for the instance


def fmpy() -> Any:
    """The package fmpy; PlantError where it is not installed."""
    try:
        return importlib.import_module("fmpy")
    except ImportError:
        raise PlantError(f"an FMU needs the package fmpy: {INSTALL}") from None


def described(path: Path) -> Description:
    """The description of an FMU.

    Raises PlantError for a file that is no FMU, FMI 1.0, an FMU without co-simulation, one that needs its tool, and
    one without a library for this machine.
    """
    package = fmpy()
    if not path.is_file():
        raise PlantError(f"{path}: no such file; give an FMU, or a Python file with the class of your plant")
    if not zipfile.is_zipfile(path):
        raise PlantError(f"{path} is no FMU: it is no zip file")
    try:
        with path.open("rb") as file:  # fmpy leaves a path open where it fails
            model = package.read_model_description(file, validate=False)
        with zipfile.ZipFile(path) as content:
            names = content.namelist()
    except Exception as error:
        raise PlantError(f"{path} is no FMU that can be read: {_one_line(error)}") from None
    version = int(str(model.fmiVersion).partition(".")[0])
    if version not in {2, 3}:
        raise PlantError(f"{path} is an FMU of FMI {model.fmiVersion}; export it with FMI 2.0 or 3.0")
    can = model.coSimulation
    if can is None:
        raise PlantError(f"{path} is an FMU for model exchange only, which has no solver; export it for co-simulation")
    if can.needsExecutionTool:
        raise PlantError(f"{path} runs only beside the tool that made it; export it with its own solver")
    here = package.platform if version == 2 else package.platform_tuple
    if f"binaries/{here}/{can.modelIdentifier}{package.sharedLibraryExtension}" not in names:
        has = sorted({n.split("/")[1] for n in names if n.startswith("binaries/") and n.count("/") > 1})
        raise PlantError(
            f"{path} has no library for this machine, {here}; it has {', '.join(has) or 'none'}; export it for {here}"
        )
    scalar = {v.name: v for v in model.modelVariables if v.type in REAL and not v.dimensions}
    begins = _number(model.defaultExperiment and model.defaultExperiment.startTime)
    return Description(
        path=path,
        version=version,
        variables={name: _variable(v) for name, v in scalar.items()},
        others={v.name: str(v.type) for v in model.modelVariables if v.name not in scalar},
        begins_s=0.0 if begins is None else begins,
        step_s=_step(model),
        any_step=bool(can.canHandleVariableCommunicationStepSize),
        keeps_states=bool(can.canGetAndSetFMUstate),
        writes_states=bool(can.canGetAndSetFMUstate and can.canSerializeFMUstate),
        single=bool(can.canBeInstantiatedOnlyOncePerProcess),
        model=model,
    )


def _variable(v: Any) -> FmuVariable:
    kind = v.declaredType
    unit, low, high = (getattr(v, key) or (kind and getattr(kind, key)) for key in ("unit", "min", "max"))
    text = str(v.start).split()
    start = _number(text[0]) if v.start is not None and text else None
    return FmuVariable(
        v.name, v.valueReference, v.causality, unit or "", _number(low), _number(high), start, v.description or ""
    )


def _step(model: Any) -> float | None:
    proposed = _number(model.defaultExperiment and model.defaultExperiment.stepSize)
    fixed = _number(model.coSimulation.fixedInternalStepSize)
    step = proposed if proposed is not None else fixed
    return step if step is not None and step > 0 else None


def _number(text: Any) -> float | None:
    """A finite number of the XML file; None where there is none: tools write 1e300 or INF for no limit."""
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if math.isfinite(value) and abs(value) < 1e100 else None


def _one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


ROLES = ("pv", "mv", "dv")


@dataclass(frozen=True, slots=True)
class FmuRow:
    """A variable of the FMU, its role (pv, mv or dv), and the signal that it is of the plant."""

    variable: str
    role: str
    signal: Signal


@dataclass(frozen=True, slots=True)
class FmuTable:
    """The signals, controlled PVs first, and the communication step [s], which is the period of the simulator.

    ``rest_periods``: the inputs keep their start values for so long before an experiment starts.
    """

    step_s: float
    rows: tuple[FmuRow, ...]
    rest_periods: int = 0

    def of(self, role: str) -> tuple[FmuRow, ...]:
        """The rows of a role, in their order."""
        return tuple(r for r in self.rows if r.role == role)

    def write_beside(self, fmu: Path) -> Path:
        """Write the table beside an FMU, and its path."""
        rows = [{"variable": r.variable, "role": r.role, "signal": r.signal.to_dict()} for r in self.rows]
        path = table_path(fmu)
        write_json(path, {"step_s": self.step_s, "rest_periods": self.rest_periods, "variables": rows})
        return path

    @classmethod
    def beside(cls, fmu: Path) -> FmuTable:
        """The table beside an FMU; PlantError where there is none, or a mistake in it."""
        path = table_path(fmu)
        if not path.is_file():
            raise PlantError(
                f"{fmu}: an FMU does not say what is manipulated and measured, and {path} is not there; "
                f"`loopwright new NAME --simulator {fmu}` asks for it"
            )
        content = read_json(path)
        try:
            rows = tuple(_row(row) for row in content["variables"])
            return cls(float(content["step_s"]), rows, int(content["rest_periods"]))
        except (KeyError, TypeError, ValueError, LoopwrightError) as error:
            raise PlantError(f"{path}: {type(error).__name__}: {error}; `loopwright new` writes a right one") from None


def table_path(fmu: Path) -> Path:
    """Where the table of an FMU lies."""
    return fmu.with_suffix(".json")


def _row(given: dict[str, Any]) -> FmuRow:
    if given["role"] not in ROLES:
        raise ValueError(f"role {given['role']!r}; {', '.join(ROLES)} are known")
    return FmuRow(given["variable"], given["role"], Signal.from_dict(given["signal"]))
