"""The variables of an FMU that are the plant's signals; an FMU itself does not say what is manipulated or measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.files import read_json, write_json
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.manifest import Signal

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
