"""``loopwright new``: a historian's export -> a screened record, its report, and a section of params.yaml."""

from __future__ import annotations

import argparse
import math
import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.cases.own_entries import entries_of
from pipeline.commands.new_commands import check_commands, check_start, commanded, confirmed, mvs_of
from pipeline.commands.new_fmu import table_from, write_table
from pipeline.commands.new_printed import tell
from pipeline.commands.new_refusal import refusal
from pipeline.commands.new_replaced import REFUSED, check_replaceable, limits_kept, wishes_lost
from pipeline.commands.new_simulated import Simulated, copy_name, keep, simulated
from pipeline.config.entries import add_entries
from pipeline.config.plants import check_name
from pipeline.errors import PipelineError, RecordError
from pipeline.files import draft_folder_of, write_json, write_text
from pipeline.historian.excerpt import evenly
from pipeline.historian.findings import Screening
from pipeline.historian.guessing import controlled_first, guesses
from pipeline.historian.reading import read_export, units_of
from pipeline.historian.screening import Screened, screened
from pipeline.historian.step_test import planned
from pipeline.historian.tags import (
    EXPLAINED,
    RANGES,
    ROLES,
    TableError,
    Tag,
    check_tags,
    limited,
    named,
    parse_tag,
    read_tags,
    write_tags,
)
from pipeline.plants.simulator_file import is_fmu
from pipeline.records.record import Record
from pipeline.report.screening import write_page

DATA = Path("data")
LEAST_ROWS, MOST_ROWS = 500, 200_000  # of the experiment on a simulator
WORDS = {"pv": "process variable, controlled ones first", "mv": "manipulated variable", "dv": "measured disturbance",
         "sp": "set point", "mode": "mode of a loop (auto, manual)"}  # fmt: skip


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add = parser.add_argument
    add("name", metavar="NAME", help="of the plant: small letters, digits and _")
    add("files", metavar="FILE", type=Path, nargs="*", help="exports: .csv, .txt, .gz, .parquet")
    add("--anyway", action="store_true", help="add the plant even where the data cannot carry a model")
    add("--replace", action="store_true", help="put the plant in place of an own plant of this name and its entries")
    add("--simulator", metavar="FILE", type=Path, help="a Python class or an FMU, instead of exports")
    add("--rows", metavar="N", type=_rows, default=8_000, help="of the experiment on a simulator (8000)")
    for role in ROLES:
        form = "TAG" if role in {"sp", "mode"} else "TAG[UNIT][=LOW..HIGH]"
        add(f"--{role}", metavar=form, action="append", default=[], help=f"{WORDS[role]}; may be given again")
    add("--command", metavar="TAG=LOW..HIGH", action="append", default=[],
        help="range that the controller may command an MV over, within the range of its readings")  # fmt: skip
    add("--max-move", metavar="TAG=CHANGE", action="append", default=[],
        help="largest change of an MV in a minute that the controller may make, in the MV's unit")  # fmt: skip
    add("--tags", metavar="FILE", type=Path, help="the corrected table of roles, instead of these options")
    add("--period", metavar="S", type=_positive, help="sampling period of the record (default: from the data)")
    add("--hold", metavar="S", type=_positive, help="longest time that a reading is held or drawn on over")
    add("--without-mode", metavar="MODE", action="append", default=[], help="leave rows of this mode out")
    add("--time", metavar="COLUMN", default="", help="the column of times (default: found by name and content)")
    add("--time-format", metavar="FORM", default="", help="of the times, as in '%%d/%%m/%%Y %%H:%%M:%%S'")


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
    if replace:
        check_replaceable(name, folder)
    check_name(name, replace=replace)
    if folder.exists() and not _refused(folder) and not replace:
        raise RecordError(f"{folder} is there already; choose another name, or give --replace")
    if options.simulator:
        return _simulated(name, folder, options)
    if not options.files:
        raise RecordError("no file is named; give one or more exports, or --simulator FILE")
    tags, _ = _tags(options)
    if not tags and (options.command or options.max_move):
        raise RecordError("--command and --max-move are given and no mv is; name it with --mv, or give --tags")
    if not tags:
        return _table(name, options)
    units = units_of(options.files)
    tags = named([t if t.unit or t.role == "mode" else _with_unit(t, units) for t in tags])
    tags = controlled_first(tags)
    values, modes = ([t.tag for t in tags if (t.role == "mode") is mode] for mode in (False, True))
    export = read_export(options.files, values, modes, options.time, options.time_format)
    found = screened(name, export, tags, options.period, options.hold, options.without_mode)
    return _write(name, folder, found, options, tags)


def _tags(options: argparse.Namespace) -> tuple[tuple[Tag, ...], str]:
    """The tags that a person gave, and where they stand."""
    given = tuple(parse_tag(text, role) for role in ROLES for text in getattr(options, role))
    if given and options.tags:
        raise RecordError("--tags and options of roles are both given; give one of them")
    found, where = (read_tags(options.tags), str(options.tags)) if options.tags else (given, "the options")
    if found or options.tags:
        check_tags(found, where)
    return limited(found, options.command, options.max_move) if found else found, where


def _simulated(name: str, folder: Path, options: argparse.Namespace) -> int:
    path: Path = options.simulator
    tags, where = _tags(options)
    if options.files or (tags and not is_fmu(path)):
        raise RecordError("--simulator and an export or its tags are both given; give one of them")
    table = None
    if is_fmu(path):
        table = table_from(path, tags, where, options.period)
        if table is None:
            return _proposed(name, path)
    made = simulated(name, path, options.rows, options.period, table)
    commands = named(tags) or limited(mvs_of(made.plant), options.command, options.max_move)
    check_start(made.plant, commands)
    return _write(name, folder, made.found, options, commands, made)


def _proposed(name: str, fmu: Path) -> int:
    path = Path(f"{name}-tags.csv")
    n = write_table(path, fmu)
    print(f"{path}: {n} inputs and outputs of {fmu}, inputs as mv, outputs as pv; nothing else was written\n"
          f"{RANGES}\n"
          f"correct role, unit, low and high there (an empty role leaves a variable out), then:\n"
          f"  loopwright new {name} --simulator {fmu} --tags {path}")  # fmt: skip
    return 0


def _table(name: str, options: argparse.Namespace) -> int:
    path = Path(f"{name}-tags.csv")
    export = read_export(options.files, (), (), options.time, options.time_format)
    rows = guesses(export, units_of(options.files))
    write_tags(path, rows)
    roles = {r: [g.tag.tag for g in rows if g.tag.role == r] for r in ROLES}
    print(f"{path}: {len(rows)} tags with guessed roles; nothing else was written")
    for role, tags in roles.items():
        print(f"  {role:5} {', '.join(tags) or '-'}")
    files = " ".join(map(str, options.files))
    print(f"{EXPLAINED}\ncorrect the table, then:\n  loopwright new {name} {files} --tags {path}")
    return 0


def _write(
    name: str,
    folder: Path,
    found: Screened,
    options: argparse.Namespace,
    tags: Sequence[Tag],
    made: Simulated | None = None,
) -> int:
    """All files at once, then the section; neither without the other. Where both fail, a replaced plant stays."""
    report, verdict, limits = found.report, found.report.verdict, list[str]()
    if options.replace:
        tags, limits = limits_kept(name, tags)
    check_commands(found.record.mv_signals, tags)
    unusable, lost = refusal(found, tags, options.anyway), list[str]()
    if unusable and folder.exists() and not _refused(folder):
        folder = folder.with_name(f"{name}-refused")  # the plant that was to be replaced stays
    earlier = folder.with_name(f".{name}-replaced")
    shutil.rmtree(earlier, ignore_errors=True)
    inputs = commanded(verdict.inputs, tags)
    test = planned(inputs, found.record.mv[-1], report.period_s) if verdict.carries != "yes" else None
    with draft_folder_of(folder) as draft:
        if not unusable:
            found.record.write(draft / "record.parquet")
        plant = entry(found.record, report, folder, tags)
        found.record = evenly(found.record)  # pages need no more, and a long record is large
        write_json(draft / "screening.json", report.to_dict())
        if made:
            keep(made, draft)
        if test:
            write_text(draft / "step_test.csv", test.table())
        write_page(draft / "screening.html", found, test)
        if folder.exists():
            folder.rename(earlier)
    if not unusable:
        simulator = {"simulator": (folder / copy_name(made.plant.path)).as_posix()} if made else {}
        entries = entries_of(name, plant | simulator)
        try:
            lost = wishes_lost(name, entries)
            add_entries(entries, replace=options.replace)
        except PipelineError:
            shutil.rmtree(folder)
            if earlier.exists():
                earlier.rename(folder)
            raise
    shutil.rmtree(earlier, ignore_errors=True)
    tell(name, folder, report, test, not unusable)
    for line in confirmed(found.record.mv_signals, tags):
        print(line)
    for limit in limits:
        print(f"kept of the plant that was replaced: {limit}; give another, or edit params.yaml")
    for wish in lost:
        print(f"replaced, write it into params.yaml again if you want it: controllers.{wish}")
    if unusable:
        print(f"loopwright new: {name} was not added to params.yaml: {unusable}", file=sys.stderr)
    return 2 if unusable else 0


def _refused(folder: Path) -> bool:
    """Whether the folder holds nothing but the report of an export that was not added."""
    return {p.name for p in folder.iterdir()} <= REFUSED and (folder / "screening.json").exists()


def entry(record: Record, report: Screening, folder: Path, tags: Sequence[Tag] = ()) -> dict[str, Any]:
    """``plants.<name>`` as params.yaml holds it; ``tags`` say what the controller may command."""
    groups = {"pv": record.pv_signals, "mv": record.mv_signals, "dv": record.dv_signals}
    commands = {t.name: t.commands for t in tags}
    return {
        "period_s": record.period_s,
        **{role: [s.to_dict() | commands.get(s.name, {}) for s in signals] for role, signals in groups.items()},
        "data": (folder / "record.parquet").as_posix(),
        "source": [dict(f) for f in report.files],
    }


def _with_unit(tag: Tag, units: dict[str, str]) -> Tag:
    return replace(tag, unit=units.get(tag.tag, ""))


def _rows(text: str) -> int:
    if not text.isdigit() or not LEAST_ROWS <= int(text) <= MOST_ROWS:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of rows from {LEAST_ROWS} to {MOST_ROWS}")
    return int(text)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (value > 0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"{text!r} is no positive number of seconds")
    return value
