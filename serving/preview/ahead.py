"""The input ``ahead`` of a law: by how much set points and measured disturbances will differ from their present values.

    ahead[(i - 1) n + s] = value of signal s at the sample k+i - its value at the sample k,   i = 1 .. N

with the n signals as the manifest lists them: set points, then measured disturbances. Zeros say that all stay as they
are. Standard library only, as the manifest.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, Self, TypeAlias, get_args

from loopwright.serving.errors import ArtifactError

if TYPE_CHECKING:
    from loopwright.serving.manifest import Signal

AheadGroup: TypeAlias = Literal["sp", "dv"]

LONGEST_AHEAD = 10_000  # samples of a horizon: far above those of any law, and below what fills a host's memory


@dataclass(frozen=True, slots=True)
class AheadSignal:
    """A signal whose future a law reads.

    ``group`` is sp for a set point and dv for a measured disturbance. ``signal`` is its name, ``unit`` its unit; all
    its values lie within ``low`` .. ``high``.
    """

    group: AheadGroup
    signal: str
    unit: str
    low: float
    high: float

    def __post_init__(self) -> None:
        if self.group not in get_args(AheadGroup):
            raise ArtifactError(f"ahead has the group {self.group!r}; allowed are {', '.join(get_args(AheadGroup))}")
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ArtifactError(
                f"ahead: {self.signal} has the range [{self.low}, {self.high}]; both ends must be finite and low < high"
            )


@dataclass(frozen=True, slots=True)
class AheadInput:
    """The future that a law reads: ``horizon`` N samples, ``period_s`` apart, of each of ``signals``.

    ArtifactError for a horizon that cannot be, or for signals that are missing, listed twice, or not the set points
    first.
    """

    horizon: int
    period_s: float
    signals: tuple[AheadSignal, ...]

    def __post_init__(self) -> None:
        if not 1 <= self.horizon <= LONGEST_AHEAD:
            raise ArtifactError(f"ahead has a horizon of {self.horizon} samples; it must be 1 to {LONGEST_AHEAD}")
        if not self.signals:
            raise ArtifactError("ahead has no signals; it must list those whose future the law reads")
        groups = [s.group for s in self.signals]
        if groups != sorted(groups, key=get_args(AheadGroup).index):
            raise ArtifactError("ahead lists a measured disturbance before a set point; set points stand first")
        named = [(s.group, s.signal) for s in self.signals]
        if len(set(named)) < len(named):
            raise ArtifactError(f"ahead has a signal twice: {', '.join(s.signal for s in self.signals)}")

    @property
    def size(self) -> int:
        """Numbers of the input."""
        return self.horizon * len(self.signals)

    def require_fits(self, period_s: float, sp: Sequence[str], dv: Sequence[str]) -> None:
        """ArtifactError unless period and signals are the law's: its set points, then its disturbances."""
        if self.period_s != period_s:
            raise ArtifactError(f"the manifest's ahead has the period {self.period_s} s, its law {period_s} s")
        if [(s.group, s.signal) for s in self.signals] != [*(("sp", n) for n in sp), *(("dv", n) for n in dv)]:
            listed = ", ".join([*sp, *dv])
            raise ArtifactError(
                f"the manifest's ahead must list all set points and then all measured disturbances: {listed}"
            )

    def with_disturbances(self, signals: Iterable[Signal]) -> AheadInput:
        """The same set points with these measured disturbances."""
        sp = [s for s in self.signals if s.group == "sp"]
        dv = [AheadSignal("dv", s.name, s.unit, s.low, s.high) for s in signals]
        return replace(self, signals=(*sp, *dv))

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON-ready values."""
        return asdict(self) | {"signals": [asdict(s) for s in self.signals]}

    @classmethod
    def from_dict(cls, row: Mapping[str, Any]) -> Self:
        """The future that ``to_dict`` wrote; TypeError or ValueError if it is none."""
        _require_keys(row, [f.name for f in fields(cls)], "ahead")
        if type(row["horizon"]) is not int:
            raise TypeError(f"ahead has the horizon {row['horizon']!r}; it must be an integer")
        if not isinstance(row["signals"], list):
            raise TypeError(f"ahead has the signals {row['signals']!r}; they must be a list")
        return cls(row["horizon"], _number(row["period_s"], "period_s"), tuple(map(_signal, row["signals"])))


def _signal(row: Any) -> AheadSignal:
    _require_keys(row, [f.name for f in fields(AheadSignal)], "a signal of ahead")
    for name in ("group", "signal", "unit"):
        if not isinstance(row[name], str):
            raise TypeError(f"a signal of ahead has the {name} {row[name]!r}; it must be a text")
    return AheadSignal(**{**row, **{end: _number(row[end], end) for end in ("low", "high")}})


def _require_keys(row: Any, names: list[str], what: str) -> None:
    if not isinstance(row, Mapping) or sorted(map(str, row)) != sorted(names):
        has = ", ".join(sorted(map(str, row))) if isinstance(row, Mapping) else repr(row)
        raise ValueError(f"{what} has {has}; it must have {names}")


def _number(value: object, name: str) -> float:
    if type(value) not in (int, float):
        raise TypeError(f"ahead has the {name} {value!r}; it must be a number")
    return float(value)  # type: ignore[arg-type]  # just checked
