"""The typed report of a screening: what was read, what was left out and why, what was seen, and the verdict."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from loopwright.pipeline.historian.cleaning.sampling import TagSampling
from loopwright.pipeline.records.old_loops import OldController, Operated


def counted(n: int, one: str, more: str = "") -> str:
    """A number and what is counted: ``counted(1, "row")`` is "1 row"; ``more`` is the plural where it is no s."""
    return f"{n} {one if n == 1 else more or f'{one}s'}"


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that a person should know; ``drops`` where readings or rows were left out for it."""

    kind: str
    tag: str
    words: str
    drops: bool = False


@dataclass(frozen=True, slots=True)
class TagReport:
    """One tag: its readings by reason (together they are all), and the rows that it has no value for, by reason."""

    tag: str
    name: str
    role: str
    unit: str
    low: float
    high: float
    readings: dict[str, int]
    texts: dict[str, int]
    rows_lost: dict[str, int]
    rows_bridged: int
    step: float  # of the converter or of the export's digits; 0 where there is none
    sampling: TagSampling


@dataclass(frozen=True, slots=True)
class InputReport:
    """How one MV or measured disturbance moved, and what answered."""

    name: str
    role: str
    unit: str
    low: float
    high: float
    moves: int
    median_move: float
    largest_move: float
    held_share: float  # of the rows
    answers: dict[str, float]  # PV -> strength of its answer; above 4 it is seen
    follows: dict[str, float]  # PV -> share of the moves that its past explains
    settling_s: float  # [s] of the slowest PV that answers; 0 where none does, or its settling time is not certain
    uncertain_s: float  # [s] of the slowest PV whose settling time is not certain: no more than a guess
    certain: tuple[str, ...]  # PVs whose settling time two models agree on
    first_answer_s: dict[str, float]  # PV -> [s] after a move, of an input that is held and where one is seen
    first_possible_s: dict[str, float]  # PV -> [s] from which on that answer may begin already, beneath the noise
    against: tuple[str, ...]  # PVs against whose past the input is moved, by hand or by a controller
    gain: dict[str, float]  # PV -> change at rest over the input's, by the quick model; 0 where none is seen
    rate: dict[str, float]  # PV that integrates -> change in a minute over the input's, after its answer has begun
    band_share: float  # of its power in the band of the plant; -1 where the record is too short to tell
    coherence: dict[str, float]  # PV -> median in that band; empty where it is too short
    load_move: float = 0.0  # change whose answer stands out of the loads within a step test; 0 where that is unknown


@dataclass(frozen=True, slots=True)
class RecordJudgement:
    """Whether the record can carry a model: yes, doubtful or no, and the reasons."""

    carries: str
    reasons: tuple[str, ...]
    inputs: tuple[InputReport, ...]
    correlation: dict[str, float]  # "A, B" -> correlation of two inputs
    rows: int
    parameters: int  # of a plain linear model, to compare the rows with
    rows_used: int  # by the quick models, in windows spread evenly
    unsure: tuple[str, ...] = ()  # PVs whose gain and settling time may come from a drift


@dataclass(frozen=True, slots=True)
class Screening:
    """The whole report of one `loopwright new`."""

    plant: str
    files: tuple[dict[str, str], ...]
    layout: str
    file_rows: int
    unreadable_rows: int
    timeless_rows: int
    period_s: float
    gaps: int  # stretches without any reading; runs end there
    gap_s: float  # [s] their length together
    grid_rows: int
    kept_rows: int
    dropped_rows: dict[str, int]  # by reason; with kept_rows they are grid_rows
    runs: int
    longest_run_rows: int
    tags: tuple[TagReport, ...]
    modes: dict[str, dict[str, int]]  # mode tag -> mode -> rows
    findings: tuple[Finding, ...]
    verdict: RecordJudgement
    zone: str = ""  # that dates are in, as in Export
    operated: tuple[Operated, ...] = ()  # how the loops were run whose set point is known
    old_controllers: tuple[OldController, ...] = ()  # the law of each of them, as the record shows it

    @property
    def summary(self) -> str:
        """Rows read, made and kept, in one line."""
        kept = 100 * self.kept_rows / self.grid_rows
        return (
            f"{self.file_rows} rows of {len(self.files)} file(s) -> {self.grid_rows} rows of {self.period_s:g} s, "
            f"{self.kept_rows} kept ({kept:.1f} %) in {self.runs} run(s)"
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)
