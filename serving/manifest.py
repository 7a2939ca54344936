"""The manifest: what a controller file says of itself. Standard library only."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from itertools import pairwise
from typing import Any, Literal, Self, TypeAlias, get_args

from loopwright.serving.errors import ArtifactError
from loopwright.serving.fields import MAX_DIGITS, refused, shown
from loopwright.serving.preview.ahead import AheadInput
from loopwright.serving.words import ACTS

MANIFEST_SCHEMA = 1  # of the manifest: a runtime refuses another
MANIFEST_KEY = "loopwright.manifest"
INPUTS = ("sp", "pv", "dv", "mv_applied", "state", "operate", "fresh", "ahead")
MAX_CHARACTERS = 2**20  # of a manifest
MAX_NAME = 200  # characters
MAX_MANIFEST_DEPTH = 20  # of lists and objects in each other
MAX_STATE = 1_000_000  # numbers of a law's memory
SHORTEST_S, LONGEST_S = 1e-6, 1e9  # a period
SENSITIVE = "sensitive_after_steps"  # in the provenance: steps after which loops on two machines part by rounding
MOVE_ROUNDING = 1e-9  # share of an MV's largest magnitude by which a sum of it and its max_move may be rounded


@dataclass(frozen=True, slots=True)
class Signal:
    """A named quantity in engineering units, with the range in which it is meaningful.

    ``values`` lists the allowed values of a discrete signal (a valve that is open or shut);
    None for a continuous one. ``max_move`` is the largest change of an MV a period; None: no limit. A discrete MV has
    no way between its values, so no such limit.
    """

    name: str
    unit: str
    low: float
    high: float
    values: tuple[float, ...] | None = None
    max_move: float | None = None

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
        if self.max_move is not None and not (math.isfinite(self.max_move) and self.max_move > 0):
            raise ArtifactError(
                f"signal {self.name!r} has the max_move {self.max_move}; it must be above 0 and finite, or left out"
            )

    @property
    def most(self) -> float:
        """Largest move a period that is let through: ``max_move`` and what rounding adds; infinite without a limit."""
        if self.max_move is None or self.values is not None:
            return math.inf
        return self.max_move + MOVE_ROUNDING * max(abs(self.low), abs(self.high))

    def moves(self, applied: float, value: float) -> bool:
        """Whether an MV may go from ``applied`` to ``value`` in a period.

        An applied MV outside the range counts as its end: scaling carries a sound read-back over it.
        """
        return abs(value - min(max(applied, self.low), self.high)) <= self.most

    def toward(self, mv: float, wanted: float) -> float:
        """An MV one period nearer to where it is wanted; there, where it moves that fast, or ``mv`` is not known."""
        if self.max_move is None or self.values is not None or not abs(wanted - mv) > self.max_move:
            return wanted
        ahead = mv + math.copysign(self.max_move, wanted - mv)
        return min(max(ahead, self.low), self.high)  # a sum is rounded

    @property
    def middle(self) -> float:
        """A value in the middle of the range; of a discrete signal, the allowed one nearest to it."""
        middle = (self.low + self.high) / 2
        return middle if self.values is None else min(self.values, key=lambda v: abs(v - middle))

    def to_dict(self) -> dict[str, Any]:
        """The signal as JSON-ready values; ``values`` and ``max_move`` only where the signal has them."""
        row = asdict(self)
        return {key: value for key, value in row.items() if value is not None}

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> Self:
        """The signal that ``to_dict`` wrote; TypeError or ValueError if it is none."""
        unknown = sorted(set(row) - {f.name for f in fields(cls)})
        if unknown:
            raise ValueError(f"a signal has unknown entries: {', '.join(unknown)}")
        values, max_move = row.get("values"), row.get("max_move")
        return cls(
            name=_name(row["name"]),
            unit=_name(row["unit"]),
            low=_number(row["low"]),
            high=_number(row["high"]),
            values=None if values is None else tuple(map(_number, _list(values))),
            max_move=None if max_move is None else _number(max_move),
        )


# ------------------------------------------------------------------------------- what operators change of a running law
Group: TypeAlias = Literal["cv", "mv", "law"]
What: TypeAlias = Literal[
    "use", "track", "weight", "low", "high", "rank", "max_move", "rest", "rest_use", "cost", "speed", "caution"
]
SWITCHES = frozenset({"use", "track", "rest_use"})
OF_GROUP: Mapping[str, frozenset[str]] = {
    "cv": frozenset({"use", "track", "weight", "low", "high", "rank", "cost"}),
    "mv": frozenset({"use", "low", "high", "max_move", "rest", "rest_use", "cost"}),
    "law": frozenset({"speed", "caution"}),
}


@dataclass(frozen=True, slots=True)
class OperateEntry:
    """One number of ``operate``: ``what`` of which signal, its ``default``, its ``unit`` and its engineered range.

    ``group`` says of what it is one: a controlled variable (cv), an MV, or the whole law.

    ``use`` 0 takes a signal out; ``track`` 0 leaves a controlled variable alone within ``low`` and ``high``; ``weight``
    multiplies that of its set point: the smaller one gives way; ``rank`` 1 keeps its range before 2; ``max_move`` is a
    period's; ``rest`` is where an MV goes that nothing asks for, where ``rest_use`` is 1; ``cost`` counts per unit of
    the signal and period, beside those of the other signals; ``speed`` and ``caution`` multiply those of the law.
    """

    group: Group
    signal: str  # empty for the whole law
    what: What
    unit: str
    default: float
    low: float
    high: float

    def __post_init__(self) -> None:
        if self.what not in OF_GROUP.get(self.group, ()) or bool(self.signal) != (self.group != "law"):
            raise ArtifactError(f"operate has {self.group!r} {self.signal!r} {self.what!r}, which no law has")
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.default <= self.high):
            raise ArtifactError(
                f"operate: {self.name} is {self.default} within [{self.low}, {self.high}]; both ends must be finite, "
                "and the default between them"
            )

    @property
    def name(self) -> str:
        """``TIC-1.low``; of the whole law ``speed``."""
        return f"{self.signal}.{self.what}" if self.signal else self.what

    def to_dict(self) -> dict[str, Any]:
        """The entry as JSON-ready values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, row: Mapping[str, Any]) -> Self:
        """The entry that ``to_dict`` wrote; TypeError or ValueError if it is none."""
        names = [f.name for f in fields(cls)]
        if sorted(row) != sorted(names):
            raise ValueError(f"an entry of operate has {', '.join(sorted(map(str, row)))}; it must have {names}")
        for name in ("group", "signal", "what", "unit"):
            if not isinstance(row[name], str):
                raise TypeError(f"an entry of operate has the {name} {row[name]!r}; it must be a text")
        for name in ("default", "low", "high"):
            if type(row[name]) not in (int, float):
                raise TypeError(f"an entry of operate has the {name} {row[name]!r}; it must be a number")
        if row["what"] not in get_args(What):
            raise ValueError(f"an entry of operate is {row['what']!r}; allowed are {', '.join(get_args(What))}")
        return cls(**{**row, **{name: float(row[name]) for name in ("default", "low", "high")}})


# --------------------------------------------------------------------------------------------------------- the manifest
@dataclass(frozen=True, slots=True)
class Manifest:
    """The contract of one controller.

    ``inputs`` names the graph's inputs, a subset of sp, pv, dv, mv_applied, state, operate, fresh, ahead: a graph has
    only those that its law uses. ``info`` names the entries of the info vector.
    ``provenance`` says where the controller comes from, ``evidence`` how its validation went. ``operate`` are the
    numbers that operators may change; ``fresh`` is 1 for each process variable with a new and good reading. ``ahead``
    is what the law reads of the future.
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
    schema: int = MANIFEST_SCHEMA
    provenance: dict[str, Any] = field(default_factory=dict)
    evidence: dict[str, Any] = field(default_factory=dict)
    operate: tuple[OperateEntry, ...] = ()
    ahead: AheadInput | None = None

    def __post_init__(self) -> None:
        for name in ("sp", "pv", "dv", "mv"):
            names = [s.name for s in self.signals(name)]
            if len(set(names)) < len(names):
                raise ArtifactError(f"the manifest's {name} has a name twice: {', '.join(names)}")
        if not self.mv:
            raise ArtifactError("the manifest has no manipulated variable")
        if not SHORTEST_S <= self.period_s <= LONGEST_S:
            raise ArtifactError(
                f"the manifest has the period {self.period_s} s; it must be positive, {SHORTEST_S:g} to {LONGEST_S:g} s"
            )
        if not 0 <= self.n_state <= MAX_STATE:
            raise ArtifactError(f"the manifest has n_state = {self.n_state}; it must be 0 to {MAX_STATE}")
        strange = [n for n in self.inputs if n not in INPUTS]
        if strange or len(set(self.inputs)) < len(self.inputs):
            raise ArtifactError(
                f"the manifest's inputs are {list(self.inputs)}; allowed are {', '.join(INPUTS)}, each once"
            )
        if ("operate" in self.inputs) > bool(self.operate):
            raise ArtifactError("the manifest's law reads operate, but the manifest has no entries of it")
        names = [entry.name for entry in self.operate]
        if len(set(names)) < len(names):
            raise ArtifactError(f"the manifest's operate has a name twice: {', '.join(names)}")
        for one, other in (("low", "high"), ("high", "low")):
            alone = [e.name for e in self.operate if e.what == one and f"{e.signal}.{other}" not in names]
            if alone:
                raise ArtifactError(f"the manifest's operate has {alone[0]}, but no {other} end of that signal")
        if ("ahead" in self.inputs) > (self.ahead is not None):
            raise ArtifactError("the manifest's law reads ahead, but the manifest does not say what it is")
        if self.ahead is not None:
            self.ahead.require_fits(self.period_s, [s.name for s in self.sp], [s.name for s in self.dv])
        limited = [s.name for s in self.mv if s.most < math.inf]
        if limited and "mv_applied" not in self.inputs:
            raise ArtifactError(
                f"the manifest limits the moves of {limited[0]!r}, which count from mv_applied, "
                "but its law does not read mv_applied"
            )

    def signals(self, name: str) -> tuple[Signal, ...]:
        """The signals behind one of the graph's inputs; none for ``state``."""
        return {"sp": self.sp, "pv": self.pv, "dv": self.dv, "mv_applied": self.mv, "mv": self.mv}.get(name, ())

    def sizes(self) -> dict[str, int]:
        """Length of each input, whether the graph uses it or not."""
        others = {"state": self.n_state, "operate": len(self.operate), "fresh": len(self.pv)}
        others["ahead"] = 0 if self.ahead is None else self.ahead.size
        return {n: others.get(n, len(self.signals(n))) for n in INPUTS}

    def usual(self, name: str) -> list[float]:
        """A value of each number of an input that any law takes: the middle of each range, no past, the defaults."""
        if name == "operate":
            return [entry.default for entry in self.operate]
        if name == "fresh":
            return [1.0 for _ in self.pv]
        return [s.middle for s in self.signals(name)] or [0.0] * self.sizes()[name]

    def to_json(self, *, indent: int | None = None) -> str:
        """The manifest as JSON, keys in the order of the fields."""
        row: dict[str, Any] = {"schema": self.schema}
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name in {"sp", "pv", "dv", "mv"}:
                value = [s.to_dict() for s in value]
            if f.name in {"operate", "ahead"} and not value:  # a runtime of before reads files without them
                continue
            if f.name == "operate":
                value = [e.to_dict() for e in value]
            if f.name == "ahead":
                value = value.to_dict()
            row[f.name] = value
        return json.dumps(row, indent=indent, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The manifest in ``text``; ArtifactError names what is missing or malformed."""
        row = strictly(text)
        if not isinstance(row, dict):
            raise ArtifactError("the manifest is not a JSON object")
        schema = row.get("schema")
        if type(schema) is not int or schema != MANIFEST_SCHEMA:
            raise ArtifactError(
                f"the manifest has schema {str(schema)[:MAX_NAME]}; this runtime reads schema {MANIFEST_SCHEMA}: "
                "export the controller again or use the matching release of loopwright"
            )
        missing = [f.name for f in fields(cls) if f.name not in row and f.name not in {"operate", "ahead"}]
        if missing:
            raise ArtifactError(f"the manifest lacks {', '.join(missing)}")
        unknown = sorted(set(row) - {f.name for f in fields(cls)})
        if unknown:
            raise ArtifactError(f"the manifest has unknown entries: {', '.join(unknown)[:MAX_NAME]}")
        try:
            signals = {k: tuple(Signal.from_dict(_dict(s)) for s in _list(row[k])) for k in ("sp", "pv", "dv", "mv")}
            if type(row["n_state"]) is not int:
                raise TypeError(f"n_state is {shown(row['n_state'])}; it must be an integer")
            return cls(
                case=_name(row["case"]),
                law=_name(row["law"]),
                period_s=_number(row["period_s"]),
                n_state=row["n_state"],
                info=tuple(map(_name, _list(row["info"]))),
                inputs=tuple(map(_name, _list(row["inputs"]))),
                schema=MANIFEST_SCHEMA,
                provenance=_dict(row["provenance"]),
                evidence=_dict(row["evidence"]),
                operate=tuple(OperateEntry.from_dict(_dict(e)) for e in _list(row.get("operate", []))),
                ahead=AheadInput.from_dict(_dict(row["ahead"])) if "ahead" in row else None,
                **signals,
            )
        except KeyError as error:
            raise ArtifactError(f"the manifest is malformed: a signal lacks {error}") from error
        except (TypeError, ValueError, OverflowError) as error:
            raise ArtifactError(f"the manifest is malformed: {error}") from error


def _increasing(values: tuple[float, ...]) -> bool:
    return all(a < b for a, b in pairwise(values))


# ------------------------------------------------------------------------------------------------------- JSON, strictly
def strictly(text: str, most: int = MAX_CHARACTERS) -> Any:
    """JSON in which readers may not differ: no entry twice, no number that is none, nothing too deep.

    Raises ArtifactError, also for more than ``most`` characters.
    """
    if len(text) > most:
        raise ArtifactError(f"the manifest has {len(text)} characters; it may have {most}")
    try:
        row = json.loads(
            text, parse_constant=_finite, parse_float=_finite, parse_int=_integer, object_pairs_hook=_object
        )
    except (ValueError, RecursionError) as error:
        raise ArtifactError(f"the manifest is not JSON: {error}") from error
    # Whoever walks or writes it again would fail where it is too deep.
    if why := refused(row, MAX_MANIFEST_DEPTH):
        raise ArtifactError(f"the manifest has {why}")
    return row


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ArtifactError(f"the manifest holds {text[:MAX_NAME]}, which is not a finite number")
    return value


def _integer(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise ArtifactError(f"the manifest holds an integer of {len(text)} digits; it may have {MAX_DIGITS}")
    return int(text)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    row = dict(pairs)
    if len(row) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ArtifactError(f"the manifest has the entry {twice[:MAX_NAME]!r} twice in one object")
    return row


def _name(value: object) -> str:
    if not isinstance(value, str) or len(value) > MAX_NAME:
        raise TypeError(f"a name is {shown(value)}; it must be a text of at most {MAX_NAME} characters")
    value.encode()  # half a surrogate pair cannot be printed
    if ACTS.search(value):
        raise ValueError(
            f"a name is {ascii(value)[:MAX_NAME]}; it may hold no line break, control or direction character"
        )
    return value


def _number(value: object) -> float:
    if type(value) not in (int, float):
        raise TypeError(f"{shown(value)} stands where a number belongs")
    return float(value)  # type: ignore[arg-type]  # just checked


def _list(value: object) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError(f"{shown(value)} stands where a list belongs")
    return value


def _dict(value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError(f"{shown(value)} stands where an object belongs")
    return value
