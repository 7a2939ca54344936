"""Reasons not to act on a sample. A guard says why not, or None; it never changes a value."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import LoopError
from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.words import first_line

NUMBER = re.compile(r"(?<![\w.-])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")


class Fault(str):
    """Why a sample or an MV is not used: a line for a person, which is what it is as a text.

    Two faults of one ``kind`` and ``subject`` are the same fault, whatever numbers their lines hold. A plain text is a
    fault too, as the plants and guards of users give it.

    Parameters
    ----------
    words
        The line.
    kind
        What is wrong: "range", "age", "quality".
    subject
        What it is wrong with: "PV T"; empty where there is but one.
    lasting
        The line that stays true while the fault lasts; ``words`` unless given.
    """

    kind: str
    subject: str
    lasting: str

    def __new__(cls, words: str, kind: str, subject: str = "", lasting: str = "") -> Fault:
        """A line that knows which fault it tells."""
        found = super().__new__(cls, words)
        found.kind, found.subject, found.lasting = kind, subject, lasting or words
        return found

    def __getnewargs__(self) -> tuple[str, str, str, str]:  # type: ignore[override]  # copied and pickled as it is
        return str(self), self.kind, self.subject, self.lasting


def reworded(fault: str, words: str) -> str:
    """The same fault in other words, which are of now: they hold for as long as it lasts."""
    return Fault(words, fault.kind, fault.subject) if isinstance(fault, Fault) else words


def told_by(error: Exception, words: str) -> str:
    """The ``words`` of an error; a fault where the error carries one."""
    carried = error.args[0] if error.args else ""
    return reworded(carried, words) if isinstance(carried, str) else words


def kind_of(fault: str) -> tuple[str, ...]:
    """The key by which two faults are the same one.

    For a plain text it is the text without the numbers that stand alone: those of a name, as in T-101, belong to it.
    """
    return (fault.kind, fault.subject) if isinstance(fault, Fault) else (NUMBER.sub("#", fault),)


def lasting(fault: str) -> str:
    """A fault's words for as long as it lasts: an age grows meanwhile."""
    return fault.lasting if isinstance(fault, Fault) else fault


# -------------------------------------------------------------------------------------------------------------- guards
Array: TypeAlias = NDArray[np.float64]

READ_BACK_MARGIN = 0.02  # share of an MV's range by which scaling may carry a sound read-back off, also over its ends


@dataclass(frozen=True, slots=True)
class Sample:
    """Values of the plant's side at one scan, in engineering units.

    ``mv_applied`` is the MV that the plant really received over the last period, read back; None
    where it cannot be read now: a loop that lost its plant goes on from the next one. ``age_s`` is
    the time since the PVs were measured; ``late`` names those whose own age it is, where that is not all of them.
    ``fault`` says why the endpoint does not trust its own sample; empty: it does. ``quality`` is for the journal and
    the page: an OPC UA status for each PV, then each MV, then each measured disturbance that is read; empty: the
    endpoint has none. ``bad_pv`` says for each PV why its reading alone is not trusted, empty where it is; an empty
    tuple: all are. A law that reads ``fresh`` goes on without these, see ``loopwright.serving.bridging``.

    ``fresh`` is for such a law, too: 0 says that the number of a PV is no new reading, as of an analyser between two
    results. It is neither judged nor used, the law predicts the PV for as long as it takes, and nothing is wrong.
    Any other law takes the number that stands there.

    ``local`` says for each MV why the plant has it itself now, as in local, empty where the loop has it; an empty
    tuple: it has all. A law with ``use`` of the MV goes on with the others, see ``loopwright.serving.mvs``.

    ``last_pv`` and ``since`` are for guards, and none of the endpoint's: the loop of such a law shows by them the last
    good number of each PV, NaN where there is none, and how many periods ago it was read.
    """

    pv: Array  # shape: (n_pv,)
    mv_applied: Array | None = None  # shape: (n_mv,)
    dv: Array = field(default_factory=lambda: np.zeros(0))  # shape: (n_dv,)
    age_s: float = 0.0
    fault: str = ""
    quality: tuple[int, ...] = ()
    late: str = ""
    bad_pv: tuple[str, ...] = ()  # shape: (n_pv,), or empty
    fresh: Array | None = None  # shape: (n_pv,), 1 or 0; None: all are
    last_pv: Array | None = None  # shape: (n_pv,)
    since: Array | None = None  # shape: (n_pv,), in periods, 1 or more
    local: tuple[str, ...] = ()  # shape: (n_mv,), or empty

    def is_bad(self, i: int) -> bool:
        """Whether the reading of PV ``i`` is known to be bad, or none: no guard judges it again."""
        return bool(self.bad_pv and self.bad_pv[i]) or self.is_stale(i)

    def is_stale(self, i: int) -> bool:
        """Whether the number of PV ``i`` is no new reading, by the host's own word."""
        return self.fresh is not None and not self.fresh[i]


class Guard(Protocol):
    """One reason not to act: a text, or a ``loopwright.serving.guard.Fault``, which also says which reason it is.

    A fault with the subject "PV T" speaks against the reading of this PV alone; a law that reads ``fresh`` bridges it.
    A guard that speaks against a PV that is known to be bad is asked again with the last good number in its place.
    """

    @property
    def memory(self) -> int:
        """How many past samples the guard looks at."""

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not to act on ``sample``, or None; ``past`` ends with the sample before it."""


@dataclass(frozen=True, slots=True)
class Complete:
    """Every value that the law uses is there and finite. Only the applied MV may be None: it need not be read back."""

    manifest: Manifest
    memory: int = field(default=0, init=False)

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: a vector is no array of numbers or has the wrong length, or a value is NaN or infinite."""
        m = self.manifest
        for label, signals, values in (
            ("PV", m.pv, sample.pv),
            ("DV", m.dv, sample.dv),
            ("applied MV", m.mv, sample.mv_applied),
        ):
            if values is None and (signals is m.mv or not signals):
                continue
            if label == "DV" and "dv" not in m.inputs:
                continue  # a sensor that the law does not listen to stops no loop
            if not isinstance(values, np.ndarray):
                return f"{label} is of the type {type(values).__name__}; it needs an array of {len(signals)} numbers"
            if values.dtype.kind not in "fiu":
                return f"{label} is an array of the type {values.dtype}; it needs numbers"
            if values.shape != (len(signals),):
                return f"{label} has the shape {values.shape} instead of ({len(signals)},)"
            numbers = values.tolist()
            if isfinite(sum(numbers)):
                continue
            for i, (signal, value) in enumerate(zip(signals, numbers, strict=True)):  # a finite sum may overflow
                if not isfinite(value) and not (label == "PV" and sample.is_bad(i)):
                    return Fault(f"{label} {signal.name} is {value}", "number", f"{label} {signal.name}")
        return None


@dataclass(frozen=True, slots=True)
class InRange:
    """Every PV lies in its signal's range, widened by ``margin`` times the range on both sides."""

    signals: tuple[Signal, ...]
    margin: float = 0.05
    memory: int = field(default=0, init=False)

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: a sensor beyond its range is broken, or the plant is where the law was never tested."""
        for i, (s, value) in enumerate(zip(self.signals, sample.pv.tolist(), strict=True)):
            slack = self.margin * (s.high - s.low)
            if not s.low - slack <= value <= s.high + slack and not sample.is_bad(i):
                words = f"PV {s.name} is {value:.6g} {s.unit}, outside its range [{s.low:g}, {s.high:g}] {s.unit}"
                return Fault(words, "range", f"PV {s.name}")
        return None


@dataclass(frozen=True, slots=True)
class Allowed:
    """Every applied MV has a value that it may have.

    A continuous one lies in its signal's range, widened by ``READ_BACK_MARGIN`` times the range on
    both sides. A discrete one has one of its values: a valve that is read back half way between
    open and shut has done neither over the last period, so no law knows what the plant received.
    """

    signals: tuple[Signal, ...]
    memory: int = field(default=0, init=False)

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: the actuator is on its way, or it or its read-back is broken."""
        return None if sample.mv_applied is None else implausible(self.signals, sample.mv_applied.tolist())


@dataclass(frozen=True, slots=True)
class Frozen:
    """No PV repeats itself to the bit for ``samples`` samples: a live sensor has noise.

    Not among the default guards, because a simulated plant at rest has none.
    """

    signals: tuple[Signal, ...]
    samples: int = 20

    @property
    def memory(self) -> int:
        """All samples that must not be equal, less the present one."""
        return self.samples - 1

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: the transmitter or the gateway repeats an old value."""
        recent = list(past)[-self.memory :]
        if len(recent) < self.memory:
            return None
        for i, s in enumerate(self.signals):
            if all(old.pv[i] == sample.pv[i] and not old.is_stale(i) for old in recent) and not sample.is_bad(i):
                words = f"PV {s.name} is frozen at {sample.pv[i]:.6g} {s.unit} for {self.samples} samples"
                return Fault(words, "frozen", f"PV {s.name}")
        return None


@dataclass(frozen=True, slots=True)
class Fresh:
    """The sample is at most ``max_age_s`` [s] old, and not from the future.

    Raises LoopError if ``max_age_s`` is no finite number of seconds, 0 or more.
    """

    max_age_s: float
    memory: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        if not _is_age(self.max_age_s):
            raise LoopError(f"max_age_s is {self.max_age_s!r}; it must be a finite number of seconds, 0 or more")

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: the measurement belongs to another period, or its age is no age."""
        if not _is_age(sample.age_s):
            return f"the sample's age is {sample.age_s!r}; it must be a finite number of seconds, 0 or more"
        if sample.age_s > self.max_age_s:
            of = f" of {sample.late}" if sample.late else ""
            words = f"the sample{of} is {sample.age_s:.3g} s old; allowed are {self.max_age_s:.3g} s"
            return Fault(words, "age", sample.late, f"the sample{of} is older than {self.max_age_s:.3g} s")
        return None


@dataclass(frozen=True, slots=True)
class Rate:
    """No PV moves by more than ``largest`` [pv units] from one sample to the next.

    Where the sample has ``last_pv``, it is compared with that: ``largest`` is then allowed for each period since.
    """

    signals: tuple[Signal, ...]
    largest: tuple[float, ...]
    memory: int = field(default=1, init=False)

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: faster than the process can, so it is the sensor."""
        if sample.last_pv is not None and sample.since is not None:
            last, since = sample.last_pv, sample.since.tolist()
        elif past:
            last, since = list(past)[-1].pv, [1.0] * len(self.signals)
        else:
            return None
        moves = np.abs(sample.pv - last).tolist()
        for i, (s, move, largest) in enumerate(zip(self.signals, moves, self.largest, strict=True)):
            if not move <= largest * since[i] and not (sample.is_bad(i) or np.isnan(last[i])):
                over = "one sample" if since[i] == 1 else f"{since[i]:g} samples"
                most = f"{largest * since[i]:g} {s.unit}"
                words = f"PV {s.name} moved by {move:.6g} {s.unit} in {over}; allowed are {most}"
                lasts = f"PV {s.name} moved by more than {largest:g} {s.unit} a sample"
                return Fault(words, "rate", f"PV {s.name}", lasts if sample.last_pv is not None else "")
        return None


def default_guards(manifest: Manifest) -> tuple[Guard, ...]:
    """The guards that suit every plant: values there and allowed, PVs in range, no sample older than a period."""
    return (Complete(manifest), Allowed(manifest.mv), InRange(manifest.pv), Fresh(manifest.period_s))


def refused(guards: Sequence[Guard], sample: Sample, past: Collection[Sample]) -> str | None:
    """Why the first guard that refuses a sample does so; None where none does. A guard that fails refuses."""
    for guard in guards:
        try:
            reason = guard.check(sample, past)
            if reason:
                return reason if isinstance(reason, str) else str(reason)  # of another's guard it may be anything
        except Exception as error:
            return f"{type(guard).__name__} failed: {first_line(error)}"
    return None


def refused_apart(
    guards: Sequence[Guard], sample: Sample, past: Collection[Sample], signals: Sequence[Signal]
) -> tuple[str | None, Sample]:
    """Why a sample is refused, or None; and the sample, with what speaks against single PVs alone in ``bad_pv``.

    ``signals`` are the PVs. A guard whose fault has one of them for its subject is asked again without that PV. A guard
    of somebody's own may not know ``bad_pv``: it is asked with the last good numbers in the place of the bad ones, so
    that the first bad PV hides no second one, and the sample is refused where that does not help.
    """
    places = {f"PV {s.name}": i for i, s in enumerate(signals)}
    for guard in guards:
        shown = sample
        while reason := refused((guard,), shown, past):
            place = places.get(reason.subject) if isinstance(reason, Fault) else None
            if place is None:
                return reason, sample
            if not sample.is_bad(place):
                bad = list(sample.bad_pv or ("" for _ in signals))
                bad[place] = reason
                sample = replace(sample, bad_pv=tuple(bad))
                shown = replace(shown, bad_pv=sample.bad_pv)
            elif sample.last_pv is None or shown.pv[place] == sample.last_pv[place] or np.isnan(sample.last_pv[place]):
                return reason, sample
            else:
                known = [sample.is_bad(i) for i in range(len(signals))]
                shown = replace(shown, pv=np.where(known, sample.last_pv, sample.pv))
    return None, sample


def implausible(signals: Sequence[Signal], applied: Sequence[float]) -> str | None:
    """Why no actuator can hold ``applied`` (n_mv,), by the rule of ``Allowed``; None if one can."""
    for s, value in zip(signals, applied, strict=True):
        if s.values is not None:
            if value not in s.values:
                words = f"applied MV {s.name} is {value:.6g}, none of {', '.join(f'{v:g}' for v in s.values)}"
                return Fault(words, "range", f"MV {s.name}")
            continue
        slack = READ_BACK_MARGIN * (s.high - s.low)
        if not s.low - slack <= value <= s.high + slack:
            words = f"applied MV {s.name} is {value:.6g} {s.unit}, outside its range [{s.low:g}, {s.high:g}] {s.unit}"
            return Fault(words, "range", f"MV {s.name}")
    return None


def _is_age(seconds: object) -> bool:
    return isinstance(seconds, (int, float, np.integer, np.floating)) and bool(0 <= seconds < inf)
