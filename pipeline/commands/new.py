"""``loopwright new``: a historian's export -> a screened record, its report, and a section of params.yaml."""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from loopwright.pipeline.cases.own_entries import entries_of
from loopwright.pipeline.commands.arguments import positive, whole
from loopwright.pipeline.commands.own_plant.from_export import asked, given_tags, loop_lines, propose_tags
from loopwright.pipeline.commands.own_plant.from_simulator import (
    Simulated,
    copy_name,
    keep,
    simulated,
    table_from,
    write_table,
)
from loopwright.pipeline.commands.own_plant.knowledge import (
    check_commands,
    check_start,
    commanded,
    confirmed,
    signals_as_tags,
    signals_of_simulator,
    stated_of,
)
from loopwright.pipeline.commands.own_plant.number_options import NUMBER_OPTIONS, limited, numbers_given
from loopwright.pipeline.commands.own_plant.operator_ranges import OperatorDefaults
from loopwright.pipeline.commands.own_plant.replaced import (
    REFUSED,
    check_replaceable,
    known_kept,
    limits_kept,
    wishes_lost,
)
from loopwright.pipeline.config.exports import ExportParams
from loopwright.pipeline.config.known import Known
from loopwright.pipeline.config.params import add_entries, sections
from loopwright.pipeline.config.plants import check_name
from loopwright.pipeline.errors import PipelineError, RecordError
from loopwright.pipeline.files import draft_folder_of, write_json, write_text
from loopwright.pipeline.historian.cleaning.new_readings import rows_between
from loopwright.pipeline.historian.cleaning.record_rows import evenly
from loopwright.pipeline.historian.cleaning.tags import RANGES, ROLES, TableError, Tag, named
from loopwright.pipeline.historian.export_params import read_and_screen, with_units
from loopwright.pipeline.historian.guessing import controlled_first
from loopwright.pipeline.historian.screening import Refusal, Screened, refusal
from loopwright.pipeline.historian.stated_answers import Beside, beside_record
from loopwright.pipeline.historian.step_test import planned
from loopwright.pipeline.plants.simulator_file import FileSimulator, is_fmu
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.report.screening import known_lines, tell, write_page
from loopwright.pipeline.stages.paths import DATA, WORK
from loopwright.serving.words import plain

LEAST_EXPERIMENT, MOST_EXPERIMENT = 500, 200_000  # of the experiment on a simulator
WORDS = {"pv": "process variable, controlled ones first",
         "constraint": "process variable without a set point, which is kept in its range",
         "analyser": "process variable with a new reading now and then, late by what its analysis takes",
         "constraint-analyser": "both of these", "mv": "manipulated variable", "dv": "measured disturbance",
         "sp": "set point", "mode": "mode of a loop (auto, manual)"}  # fmt: skip


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add = parser.add_argument
    add("name", metavar="NAME", help="of the plant: small letters, digits and _")
    add("files", metavar="FILE", type=Path, nargs="*", help="exports: .csv, .txt, .gz, .parquet, .xlsx")
    add("--anyway", action="store_true", help="add the plant even where the data cannot carry a model")
    add("--replace", action="store_true", help="put the plant in place of an own plant of this name and its entries")
    add("--simulator", metavar="FILE", type=Path, help="a Python class or an FMU, instead of exports")
    add("--rows", metavar="N", type=whole(LEAST_EXPERIMENT, MOST_EXPERIMENT), default=8_000,
        help="of the experiment on a simulator (8000)")  # fmt: skip
    for role in ROLES:
        form = "TAG" if role in {"sp", "mode"} else "TAG[UNIT][=LOW..HIGH]"
        add(f"--{role}", metavar=form, action="append", default=[], help=f"{WORDS[role]}; may be given again")
    for option, of in NUMBER_OPTIONS.items():
        add(f"--{option}", metavar=f"TAG={of.form}", action="append", default=[], help=of.help)
    add("--known", metavar="PV/INPUT=WORDS", action="append", default=[],
        help="what you know of the answer to an MV or DV: +, -, none, gain LOW..HIGH, dead FROM..TO (s)")  # fmt: skip
    add("--tags", metavar="FILE", type=Path, help="the corrected table of roles, instead of these options")
    add("--period", metavar="S", type=positive("s"),
        help="sampling period of the record (default: the export's step, longer for a slow plant)")  # fmt: skip
    add("--hold", metavar="S", type=positive("s"), help="longest time that a reading is held or drawn on over")
    add("--without-mode", metavar="MODE", action="append", default=[], help="leave rows of this mode out")
    add("--leave-out", metavar="FROM..TO", action="append", default=[],
        help="leave rows of this time out: ISO dates or times, or seconds; may be given again")  # fmt: skip
    add("--time", metavar="COLUMN", default="", help="the column of times (default: found by name and content)")
    add("--time-format", metavar="FORM", default="",
        help="of times, as in '%%d/%%m/%%Y %%H:%%M:%%S', or a unit of numbers: ms, s, min, h, d, serial")  # fmt: skip
    add("--time-zone", metavar="ZONE", default="",
        help="of dates that state none, as in Europe/Berlin or +01:00")  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """0 where the plant was added or a table of tags written; 2 where the record cannot be used, after the report."""
    try:
        return _run(options)
    except TableError as error:
        for mistake in error.mistakes:
            print(f"loopwright new: {mistake}", file=sys.stderr)
        return 2


def _run(options: argparse.Namespace) -> int:
    name: str = options.name
    replace: bool = options.replace
    folder = DATA / name
    _check_files(name, options)
    if replace:
        check_replaceable(name, folder)
    check_name(name, replace=replace)
    if folder.exists() and not _refused(folder) and not replace:
        raise RecordError(f"{folder} is there already; choose another name, or give --replace")
    if options.simulator:
        return _simulated(name, folder, options)
    if not options.files:
        raise RecordError("no file is named; give one or more exports, or --simulator FILE")
    given, _ = given_tags(options)
    numbers = numbers_given(options)
    if not given and (any(numbers.values()) or options.known):
        several = ", ".join(f"--{option}" for option in numbers)
        raise RecordError(f"{several} or --known is given and no mv is; name it with --mv, or give --tags")
    if not given:
        propose_tags(name, options)
        return 0
    export = asked(options, given)
    tags = with_units(controlled_first(named(given)), export)
    stated_of(tags, options.known)  # a mistake is said before the minutes of a screening
    found = read_and_screen(export, tags)
    period_s = found.report.period_s
    # The record that stage `screen` makes has the same one; that of longer files may differ in its last digits.
    if period_s != found.step_s or period_s != float(f"{period_s:.3g}"):
        export = dataclasses.replace(export, period_s=period_s)
    return _write(name, folder, found, options, tags, export=export)


def _check_files(name: str, options: argparse.Namespace) -> None:
    """RecordError for a file that is not there: it may be the second word of an option that takes one."""
    absent = next((path for path in options.files if not path.exists()), None)
    if absent is not None and not absent.suffix and any(getattr(options, role.replace("-", "_")) for role in ROLES):
        raise RecordError(
            f"{absent}: no such file; NAME is {name!r}: --pv and its like take one TAG, give them again for another"
        )


def _simulated(name: str, folder: Path, options: argparse.Namespace) -> int:
    path: Path = options.simulator
    tags, where = given_tags(options)
    if options.files or (tags and not is_fmu(path)):
        raise RecordError("--simulator and an export or its tags are both given; give one of them")
    table = None
    if is_fmu(path):
        table = table_from(path, tags, where, options.period)
        if table is None:
            return _proposed(name, path)
    plant = FileSimulator(path, name, table=table)
    commands = named(tags) or limited(signals_of_simulator(plant), numbers_given(options))
    check_start(plant, commands)  # before the minutes of an experiment
    stated_of(signals_as_tags(plant, commands), options.known)
    made = simulated(plant, options.rows, options.period)
    return _write(name, folder, made.found, options, commands, made=made)


def _proposed(name: str, fmu: Path) -> int:
    path = Path(f"{name}-tags.csv")
    n = write_table(path, fmu)
    print(f"{path}: {n} inputs and outputs of {fmu}, inputs as mv, outputs as pv; nothing else was written\n"
          f"{RANGES}\n"
          f"correct role, unit, low and high there (an empty role leaves a variable out), then:\n"
          f"  loopwright new {name} --simulator {fmu} --tags {path}")  # fmt: skip
    return 0


def _write(
    name: str,
    folder: Path,
    found: Screened,
    options: argparse.Namespace,
    tags: Sequence[Tag],
    *,
    export: ExportParams | None = None,
    made: Simulated | None = None,
) -> int:
    """All files at once, then the section; neither without the other. Where both fail, a replaced plant stays.

    The record of ``export`` is left to stage `screen`; that of the experiment on a simulator is written here.
    """
    report, verdict, limits = found.report, found.report.verdict, list[str]()
    operated = OperatorDefaults.of(found.record, tags)
    if options.replace:
        tags, limits = limits_kept(name, tags)
    check_commands(found.record.mv_signals, tags)
    signals = signals_as_tags(found.record, tags)
    said = stated_of(signals, options.known)
    known, more = known_kept(name, said, signals) if options.replace else (said.known, [])
    beside = _beside(known, found.record)
    questions = [words for one in beside for words in one.questions]
    unusable, lost = refusal(found, tags, options.anyway), list[str]()
    if unusable and folder.exists() and (name in sections("plants") or not _refused(folder)):
        folder = folder.with_name(f"{name}-refused")  # the plant that was to be replaced stays
    earlier = folder.with_name(f".{name}-replaced")
    shutil.rmtree(earlier, ignore_errors=True)
    inputs = commanded(verdict.inputs, tags)
    fastest = {t.name: t.max_move_per_min for t in tags if t.max_move_per_min is not None}
    # The last row may stand in the middle of an excursion. Of an MV of few values the median is one of them.
    usual: list[float] = np.quantile(found.record.mv, 0.5, axis=0, method="nearest").tolist()
    test = planned(inputs, usual, report.period_s, fastest) if verdict.carries != "yes" else None
    with draft_folder_of(folder) as draft:
        if made and not unusable:
            found.record.write(draft / "record.parquet")
        plant = signals_of(found.record, tags)
        plant |= {} if operated.controlled is None else {"controlled": operated.controlled}
        plant |= {"known": [one.to_dict() for one in known]} if known else {}
        found.record = evenly(found.record)  # pages need no more, and a long record is large
        write_json(draft / "screening.json", report.to_dict())
        if made:
            keep(made, draft)
        if test:
            write_text(draft / "step_test.csv", test.table())
        write_page(draft / "screening.html", found, test, beside)
        if folder.exists():
            folder.rename(earlier)
    if not unusable:
        if made:
            record, simulator = folder / "record.parquet", folder / copy_name(made.plant.path)
            plant |= {"data": record.as_posix(), "source": [dict(f) for f in report.files]}
            plant |= {"simulator": simulator.as_posix()}
        entries = entries_of(name, plant, export, report.old_controllers, operated.defaults)
        try:
            lost = wishes_lost(name, entries, earlier / "screening.json")
            add_entries(entries, replace=options.replace, remove=[("exports", name)] if options.replace else ())
        except PipelineError:
            shutil.rmtree(folder)
            if earlier.exists():
                earlier.rename(folder)
            raise
    shutil.rmtree(earlier, ignore_errors=True)
    if not unusable:
        shutil.rmtree(WORK / name, ignore_errors=True)  # models of a plant that was replaced need not suit this one
    tell(name, folder, report, test, known, added=not unusable, asked=bool(questions))
    if not (made or report.old_controllers):
        print("the old controller is not known, as no set point is named: with --sp TAG, and --mode TAG, it stands in "
              "every table")  # fmt: skip
    if report.old_controllers:
        for line in loop_lines(tags):
            print(plain(f"{line}; is it so? Column loop of the table of tags corrects it"))
    for line in confirmed(found.record.mv_signals, tags, {old.mv for old in report.old_controllers}):
        print(line)
    for line in (*operated.lines, *known_lines(beside)):
        print(plain(line))
    if questions:
        print("no controller is shipped before that is answered: change the statement, or the tags")
    for limit in (*limits, *more):
        print(f"kept of the plant that was replaced: {limit}; give another, or edit params.yaml")
    for wish in lost:
        print(f"replaced, write it into params.yaml again if you want it: {wish}")
    if unusable:
        print(f"loopwright new: {name} was not added to params.yaml: {_words(unusable)}", file=sys.stderr)
    return 2 if unusable else 0


def _beside(known: Sequence[Known], record: Record) -> list[Beside]:
    """Each statement beside the record, as stage `fit` holds them against each other."""
    if not known:
        return []
    from loopwright.pipeline.models.identified.measured_disturbances import with_levels  # torch takes seconds to load

    return beside_record(known, with_levels(record, record.pv.shape[1]))


def _refused(folder: Path) -> bool:
    """Whether the folder holds nothing but the report of an export that was not added."""
    return {p.name for p in folder.iterdir()} <= REFUSED and (folder / "screening.json").exists()


def _words(refused: Refusal) -> str:
    helps = ["run the step test in step_test.csv"] * refused.step_test + ["give --anyway"] * refused.anyway
    return "; ".join(filter(None, (refused.why, ", or ".join(helps))))


def signals_of(record: Record, tags: Sequence[Tag] = ()) -> dict[str, Any]:
    """Period and signals as ``plants.<name>`` of params.yaml holds them; ``tags`` say what may be commanded."""
    groups = {"pv": record.pv_signals, "mv": record.mv_signals, "dv": record.dv_signals}
    own: dict[str, dict[str, Any]] = {t.name: dict(t.commands) for t in tags}
    for i, fresh in record.seldom.items():
        own.setdefault(record.pv_signals[i].name, {})["every"] = rows_between(fresh)
    return {
        "period_s": record.period_s,
        **{role: [s.to_dict() | own.get(s.name, {}) for s in signals] for role, signals in groups.items()},
    }
