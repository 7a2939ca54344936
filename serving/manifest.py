"""The manifest: what a controller file says of itself. Standard library only."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, fields
from itertools import pairwise
from typing import Any, Self

from serving.errors import ArtifactError

SCHEMA = 1
MANIFEST_KEY = "loopwright.manifest"
INPUTS = ("sp", "pv", "dv", "mv_applied", "state")


@dataclass(frozen=True, slots=True)
class Signal:
    """A named quantity in engineering units, with the range in which it is meaningful.

    ``values`` lists the allowed values of a discrete signal (a valve that is open or shut);
    None for a continuous one.
    """

    name: str
    unit: str
    low: float
    high: float
    values: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ArtifactError(
                f"signal {self.name!r} has the range [{self.low}, {self.high}]; "
                "low and high must be finite and low < high"
            )
        if self.values is not None and not (
            self.values and all(self.low <= v <= self.high for v in self.values) and _increasing(self.values)
        ):
            raise ArtifactError(
                f"signal {self.name!r} has the values {list(self.values)}; they must be one or more, each above the "
                f"one before and within the range [{self.low:g}, {self.high:g}]"
            )

    @property
    def middle(self) -> float:
        """A value in the middle of the range; of a discrete signal, the allowed one nearest to it."""
        middle = (self.low + self.high) / 2
        return middle if self.values is None else min(self.values, key=lambda v: abs(v - middle))

    def to_dict(self) -> dict[str, Any]:
        """The signal as JSON-ready values; ``values`` only where the signal is discrete."""
        row = asdict(self)
        if self.values is None:
            del row["values"]
        return row

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> Self:
        """The signal that ``to_dict`` wrote."""
        values = row.get("values")
        return cls(
            name=str(row["name"]),
            unit=str(row["unit"]),
            low=float(row["low"]),
            high=float(row["high"]),
            values=None if values is None else tuple(float(v) for v in values),
        )


@dataclass(frozen=True, slots=True)
class Manifest:
    """The contract of one controller.

    ``inputs`` names the graph's inputs, a subset of sp, pv, dv, mv_applied, state: a graph has
    only those that its law uses. ``info`` names the entries of the info vector.
    ``provenance`` says where the controller comes from, ``evidence`` how its validation went.
    """

    case: str
    law: str
    period_s: float
    sp: tuple[Signal, ...]
    pv: tuple[Signal, ...]
    dv: tuple[Signal, ...]
    mv: tuple[Signal, ...]
    n_state: int
    info: tuple[str, ...]
    inputs: tuple[str, ...]
    schema: int = SCHEMA
    provenance: dict[str, Any] = field(default_factory=dict)
    evidence: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("sp", "pv", "dv", "mv"):
            names = [s.name for s in self.signals(name)]
            if len(set(names)) < len(names):
                raise ArtifactError(f"the manifest's {name} has a name twice: {', '.join(names)}")
        if not self.mv:
            raise ArtifactError("the manifest has no manipulated variable")
        if not (math.isfinite(self.period_s) and self.period_s > 0):
            raise ArtifactError(f"the manifest has the period {self.period_s} s; it must be positive")
        if self.n_state < 0:
            raise ArtifactError(f"the manifest has n_state = {self.n_state}; it must not be negative")
        strange = [n for n in self.inputs if n not in INPUTS]
        if strange or len(set(self.inputs)) < len(self.inputs):
            raise ArtifactError(
                f"the manifest's inputs are {list(self.inputs)}; allowed are {', '.join(INPUTS)}, each once"
            )

    def signals(self, name: str) -> tuple[Signal, ...]:
        """The signals behind one of the graph's inputs; none for ``state``."""
        return {"sp": self.sp, "pv": self.pv, "dv": self.dv, "mv_applied": self.mv, "mv": self.mv}.get(name, ())

    def sizes(self) -> dict[str, int]:
        """Length of each input, whether the graph uses it or not."""
        return {n: self.n_state if n == "state" else len(self.signals(n)) for n in INPUTS}

    def to_json(self, *, indent: int | None = None) -> str:
        """The manifest as JSON, keys in the order of the fields."""
        row: dict[str, Any] = {"schema": self.schema}
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name in {"sp", "pv", "dv", "mv"}:
                value = [s.to_dict() for s in value]
            row[f.name] = value
        return json.dumps(row, indent=indent, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The manifest in ``text``; ArtifactError names what is missing or malformed."""
        try:
            row = json.loads(text, parse_constant=_not_finite)
        except (json.JSONDecodeError, RecursionError) as error:
            raise ArtifactError(f"the manifest is not JSON: {error}") from error
        if not isinstance(row, dict):
            raise ArtifactError("the manifest is not a JSON object")
        if row.get("schema") != SCHEMA:
            raise ArtifactError(
                f"the manifest has schema {row.get('schema')!r}; this runtime reads schema {SCHEMA}: "
                "export the controller again or use the matching release of loopwright"
            )
        missing = [f.name for f in fields(cls) if f.name not in row]
        if missing:
            raise ArtifactError(f"the manifest lacks {', '.join(missing)}")
        unknown = sorted(set(row) - {f.name for f in fields(cls)})
        if unknown:
            raise ArtifactError(f"the manifest has unknown entries: {', '.join(unknown)}")
        try:
            signals = {k: tuple(Signal.from_dict(s) for s in row[k]) for k in ("sp", "pv", "dv", "mv")}
            return cls(
                case=str(row["case"]),
                law=str(row["law"]),
                period_s=float(row["period_s"]),
                n_state=int(row["n_state"]),
                info=tuple(str(n) for n in row["info"]),
                inputs=tuple(str(n) for n in row["inputs"]),
                schema=SCHEMA,
                provenance=dict(row["provenance"]),
                evidence=dict(row["evidence"]),
                **signals,
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise ArtifactError(f"the manifest is malformed: {error!r}") from error


def _increasing(values: tuple[float, ...]) -> bool:
    return all(a < b for a, b in pairwise(values))


def _not_finite(text: str) -> float:
    raise ArtifactError(f"the manifest holds {text}, which is not a number")
