"""``loopwright new NAME --simulator FILE``: a first step test, an experiment that it plans, and the record of it."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.excitation.planned import ExperimentPlan, FirstTest, excited, first_test, planned
from loopwright.pipeline.files import sha256, write_json
from loopwright.pipeline.historian.cleaning.findings import Finding, Screening, TagReport
from loopwright.pipeline.historian.cleaning.record_rows import evenly
from loopwright.pipeline.historian.cleaning.row_grid import Grid
from loopwright.pipeline.historian.cleaning.sampling import TagSampling
from loopwright.pipeline.historian.cleaning.tags import SIGNAL_ROLES, Guess, Tag, named, write_tags
from loopwright.pipeline.historian.excitation import judged
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.screening import Screened, models_of
from loopwright.pipeline.plants.fmu.description import Description, FmuRow, FmuTable, FmuVariable, described
from loopwright.pipeline.plants.fmu.program import variable_of
from loopwright.pipeline.plants.simulator_file import FileSimulator
from loopwright.pipeline.records.record import Record


def judged_record(
    plant: str, record: Record, files: Sequence[Mapping[str, str]], findings: Sequence[Finding], layout: str
) -> Screened:
    """Every row of one run kept, the report beside it, and the verdict; ``layout`` says where the rows come from."""
    h, n = record.period_s, len(record)
    groups = {"pv": record.pv_signals, "mv": record.mv_signals, "dv": record.dv_signals}
    columns = {s.name: getattr(record, r)[:, i] for r, group in groups.items() for i, s in enumerate(group)}
    good = np.zeros(n, np.uint8)
    excerpt = evenly(record)
    models = models_of(excerpt)
    grid = Grid(h, record.time_s, record.run, columns, dict.fromkeys(columns, good), dict.fromkeys(columns, 0))
    tags = tuple(
        TagReport(
            s.name, s.name, role, s.unit, s.low, s.high, {"good": n}, {}, {}, 0, 0.0,
            TagSampling(s.name, h, irregular=False, dead_band=False, hold_s=h),
        )
        for role, group in groups.items() for s in group
    )  # fmt: skip
    report = Screening(
        plant=plant,
        files=tuple(dict(f) for f in files),
        layout=layout,
        file_rows=n,
        unreadable_rows=0,
        timeless_rows=0,
        period_s=h,
        gaps=0,
        gap_s=0.0,
        grid_rows=n,
        kept_rows=n,
        dropped_rows={},
        runs=1,
        longest_run_rows=n,
        tags=tags,
        modes={},
        findings=tuple(findings),
        verdict=judged(excerpt, models, 0, n),
    )
    series = {name: Series(name, record.time_s, values, good, Counter()) for name, values in columns.items()}
    return Screened(record, grid, good, series, report, models=models)


# ------------------------------------------------------------------------------------------------------ the experiment

# periods of the settling time: above the first, the period becomes long enough for the second
SLOW_SETTLING, WANTED_SETTLING = 120, 60
LONGER = (10, 100, 1000)  # steps of a simulator in a period, tried where it does not settle
RESTS_AFTER = (2, 8)  # settling times at an FMU's start values, tried where its start is no rest
EXPERIMENT_SEED = 0  # of the experiment
SIMULATOR = "simulator"  # its copy beside the record, with the ending of the file


@dataclass(frozen=True, slots=True)
class Simulated:
    """The experiment on a simulator: what the first test showed, what was planned, and the record as if screened."""

    plant: FileSimulator
    test: FirstTest
    plan: ExperimentPlan
    found: Screened


def simulated(plant: FileSimulator, rows: int, period_s: float | None) -> Simulated:
    """The whole experiment.

    Raises PlantError where the simulator fails, and RecordError for a period that it cannot have.
    """
    test = first_test(plant)
    if period_s is None and plant.strides and not test.settles:
        plant, test = _longer(plant, test)
    every = plant.every * _every(plant, test, period_s)
    if every > plant.every:
        plant = FileSimulator(plant.path, plant.name, every, plant.table)
        test = first_test(plant)
    if plant.table and not test.at_rest:
        plant, test = _rested(plant, plant.table, test)
    plan = planned(plant, test, rows)
    record = excited(plant, plan, EXPERIMENT_SEED)
    files = [{"file": str(plant.path), "sha256": sha256(plant.path)}]
    found = judged_record(plant.name, record, files, _findings(plant, test, plan), "simulated")
    return Simulated(plant, test, plan, found)


def keep(made: Simulated, folder: Path) -> None:
    """Copy the simulator beside its record, for the validation, and write what the first test showed."""
    copy = folder / copy_name(made.plant.path)
    shutil.copyfile(made.plant.path, copy)
    if made.plant.table:
        made.plant.table.write_beside(copy)
    write_json(folder / "first_test.json", made.test.to_dict())


def _longer(plant: FileSimulator, test: FirstTest) -> tuple[FileSimulator, FirstTest]:
    """The plant and its test with a longer period, if it settles then: many FMUs propose steps for a fast solver."""
    for every in LONGER:
        longer = FileSimulator(plant.path, plant.name, every, plant.table)
        again = first_test(longer)
        if again.settles:
            return longer, again
    return plant, test


def _rested(plant: FileSimulator, table: FmuTable, test: FirstTest) -> tuple[FileSimulator, FirstTest]:
    """The plant and its test after a time at its start values, if it rests then: many FMUs begin with a transient."""
    for times in RESTS_AFTER:
        rest = replace(table, rest_periods=times * test.settling_periods * plant.every)
        later = FileSimulator(plant.path, plant.name, plant.every, rest)
        again = first_test(later)
        if again.at_rest:
            return later, again
    return plant, test


def copy_name(simulator: Path) -> str:
    """The name of a simulator's copy beside its record."""
    return SIMULATOR + simulator.suffix.lower()


def _every(plant: FileSimulator, test: FirstTest, period_s: float | None) -> int:
    if period_s is None:
        slow = test.settles and test.settling_periods > SLOW_SETTLING
        return round(test.settling_periods / WANTED_SETTLING) if slow else 1
    every = round(period_s / plant.period_s)
    if every < 1 or abs(every * plant.period_s - period_s) > 1e-6 * period_s:
        raise RecordError(f"--period {period_s:g}: give a multiple of the simulator's period, {plant.period_s:g} s")
    return every


def _findings(plant: FileSimulator, test: FirstTest, plan: ExperimentPlan) -> list[Finding]:
    h, k = plant.period_s, test.settling_periods
    words = (
        f"settles within {k} periods of {h:g} s" if test.settles else f"does not settle; {k} periods to move a tenth"
    )
    if plant.every > 1:
        words += (
            f"; the period is {plant.every} steps of the simulator, so that an answer takes {WANTED_SETTLING} or so"
        )
    found = [Finding("first_test", plant.name, words)]
    if plant.table and plant.table.rest_periods:
        rest_s = plant.table.rest_periods * plant.table.step_s
        words = (
            f"the FMU does not start at rest; the experiment and the tests begin after {rest_s:g} s at its start values"
        )
        found.append(Finding("first_test", plant.name, words))
    if not test.at_rest:
        words = "the start is no rest: the process variables move without a step, so settling and gains are rough"
        found.append(Finding("first_test", plant.name, words))
    for j, s in enumerate(plant.mv_signals):
        kind = "gain in the first step test" if test.settles else "slope a period in the first step test"
        gains = ", ".join(f"{pv.name} {g[j]:.3g}" for pv, g in zip(plant.pv_signals, test.gain, strict=True))
        words = f"{kind}: {gains}; moved from {plan.low[j]:.4g} to {plan.high[j]:.4g} {s.unit}, held for "
        found.append(Finding("first_test", s.name, f"{words}{plan.mv_hold[0]} to {plan.mv_hold[1]} periods"))
    return found


PROPOSED = {"input": "mv", "output": "pv"}
MISSING = "give its range"


def table_from(path: Path, tags: Sequence[Tag], where: str, period_s: float | None) -> FmuTable | None:
    """The table of the signals; None where no tag is given and the FMU leaves something to a person.

    Unit and range are the tag's, else the FMU's. PlantError as ``described`` and ``variable_of``; RecordError for a
    role that an FMU has no use for, a range that nobody states, and a period that the FMU cannot have.
    """
    of = described(path)
    if not tags:
        tags = [g.tag for g in proposals(of)]
        if not _clear(tags):
            return None
    other = [t for t in tags if t.role not in SIGNAL_ROLES]
    if other:
        raise RecordError(f"{where}: {other[0].tag} has the role {other[0].role}; of an FMU only pv, mv and dv count")
    found = [_with_range(t, variable_of(of, t.tag, t.role)) for t in named(tags)]
    without = [t for t in found if t.low is None or t.high is None]
    if without:
        raise RecordError(
            f"{where}: {', '.join(t.tag for t in without)}: neither the FMU nor you state a range; give one, as in "
            f'--{without[0].role} "{without[0].tag}=LOW..HIGH" or in the table of --tags'
        )
    return FmuTable(_step(of, period_s), tuple(FmuRow(t.tag, t.role, t.signal(0.0, 0.0)) for t in found))


def proposals(of: Description) -> list[Guess]:
    """Inputs as MVs, outputs as PVs, and the other variables without a role, as far as they could be a PV."""
    found = [v for v in of.variables.values() if v.causality in PROPOSED]
    return [Guess(_tag(v), 0.0, 1.0, notes=(_remark(v),)) for v in sorted(found, key=lambda v: v.causality)]


def write_table(path: Path, fmu: Path) -> int:
    """Write the proposals for a person to correct, and their number; RecordError where the file is there."""
    rows = proposals(described(fmu))
    write_tags(path, rows)
    return len(rows)


def _clear(tags: Sequence[Tag]) -> bool:
    """Whether nothing is left to a person: one input, which can only be an MV, and all ranges."""
    return [t.role for t in tags].count("mv") == 1 and all(t.low is not None and t.high is not None for t in tags)


def _tag(v: FmuVariable) -> Tag:
    return Tag(v.name, PROPOSED[v.causality], v.unit, v.low, v.high)


def _remark(v: FmuVariable) -> str:
    start = "" if v.start is None else f"starts at {v.start:g}"
    role = "an input: mv or dv" if v.causality == "input" else ""
    missing = MISSING if v.low is None or v.high is None else ""
    return "; ".join(filter(None, (role, start, missing, v.words)))


def _with_range(tag: Tag, v: FmuVariable) -> Tag:
    low, high = (v.low if tag.low is None else tag.low), (v.high if tag.high is None else tag.high)
    return replace(tag, unit=tag.unit or v.unit, low=low, high=high)


def _step(of: Description, period_s: float | None) -> float:
    """The communication step [s]: the period itself where the FMU allows it, else what the FMU proposes."""
    step = period_s if of.step_s is None or (of.any_step and period_s is not None) else of.step_s
    if step is None:
        raise RecordError(f"{of.path} proposes no step size; give the sampling period, as in --period 10")
    return step
