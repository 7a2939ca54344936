"""Identification on public records and on made ones, by the path of a user: free-run errors over test rows.

``python benchmarks/identification.py [--data FOLDER] [--only NAME ...] [--seeds 0 1 2]``; some minutes a record and
seed. An export of the rows to learn goes through `loopwright new`, and through the stages `screen` and `fit` of
`loopwright run`, all with their defaults. The product never sees the test rows. The model that controllers would be
designed on runs free over these; the rows that its initial state is fitted to do not count.

The public records are not part of this repository; nonlinearbenchmark.org and its mirrors hold them. --data names the
folder of their files, which ``_public_records.py`` lists. The made records are like these
(``_made_records.py``): their truth is known, so that the error of the true model, which is the noise, stands beside. A
linear output-error model of all rows to learn is the linear baseline.

Where `new` refuses a record, the table says so, and the model is that of `--anyway`. Where a plant is known to overflow
a second row has the table of tags say `keep`, as `new` asks for. Published figures are RMSE over the same rows.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from _free_run import Predictor, Task, error_of, linear_model
from _made_records import MADE
from _public_records import PUBLIC, Published, public_task
from _users_path import Project

from loopwright.pipeline.errors import PipelineError

HEAD = (
    "record",
    "unit",
    "noise",
    "linear",
    "model",
    "minutes",
    "`new` says",
    "published: linear",
    "black box",
    "grey box",
)


@dataclass(frozen=True, slots=True)
class Entry:
    """A record to be identified, and how its figures are written."""

    name: str
    task: Task
    unit: str
    published: Mapping[str, Published]
    keep: bool = False  # the table of tags says that y ends where the plant does


@dataclass(slots=True)
class Found:
    """Of one record: what `new` says, errors by test and seed (none without a model), and the minutes of each seed."""

    says: str
    errors: dict[str, list[float | None]] = field(default_factory=dict)
    minutes: list[float] = field(default_factory=list)


def entries_of(data: Path | None, only: Sequence[str]) -> list[Entry]:
    """The records that are at hand, public ones first; one that overflows comes twice."""
    found = []
    for name in only or [*PUBLIC, *MADE]:
        if name in MADE:
            make, unit, _ = MADE[name]
            found.append(Entry(name, make(), unit, {}))
            continue
        task = None if data is None else public_task(data, name)
        if task is None:
            where = "no --data" if data is None else f"not under {data}"
            print(f"{name}: {', '.join(PUBLIC[name].files)} (.csv or .mat): {where}", flush=True)
            continue
        found.append(Entry(name, task, PUBLIC[name].unit, PUBLIC[name].published))
    kept = [Entry(f"{e.name}_kept", e.task, e.unit, e.published, keep=True) for e in found if e.task.overflows]
    return sorted([*found, *kept], key=lambda e: [f.name for f in found].index(e.name.removesuffix("_kept")))


def found_of(entry: Entry, project: Project, seeds: Sequence[int]) -> Found:
    """The product's models of one record; a line a seed as it comes."""
    task, began = entry.task, time.perf_counter()
    answer = project.new(entry.name, task.learn, task.period_s, keep=entry.keep)
    found = Found(f"refused: {answer.refused}" if answer.refused else answer.verdict)
    if answer.refused:
        print(f"{entry.name}: `new` refuses: {answer.refused}", flush=True)
        answer = project.new(entry.name, task.learn, task.period_s, keep=entry.keep, anyway=True)
    asked = (time.perf_counter() - began) / 60
    for seed in seeds if not answer.refused else ():
        began = time.perf_counter()
        model, why = project.model(entry.name, seed)
        found.minutes.append(asked + (time.perf_counter() - began) / 60)
        for test, error in errors_of(model, task).items():
            found.errors.setdefault(test, []).append(error)
        figures = ", ".join(f"{test} {_number(errors[-1])}" for test, errors in found.errors.items())
        words = model.words if model else why
        print(f"{entry.name}: seed {seed}: {figures} {entry.unit} ({words}; {found.minutes[-1]:.1f} min)", flush=True)
    return found


def errors_of(model: Predictor | None, task: Task) -> dict[str, float | None]:
    """Error of a free run over each test, in the unit of the figures."""
    return {
        test: None if model is None else error_of(model.free_run(part, task.begin, task.learn), part, task)
        for test, part in task.tests.items()
    }


def linear_errors(task: Task) -> dict[str, float | None]:
    """The same of the linear baseline; none where no linear model can be fitted."""
    try:
        return errors_of(linear_model(task.learn, task.period_s), task)
    except PipelineError as error:
        print(f"  no linear baseline: {error}", flush=True)
        return errors_of(None, task)


def rows_of(entry: Entry, found: Found) -> list[str]:
    """Rows of the closing table, one a test."""
    linear = linear_errors(entry.task)
    minutes = f"{sum(found.minutes) / len(found.minutes):.1f}" if found.minutes else "-"
    rows = []
    for test, part in entry.task.tests.items():
        name = entry.name if test == "test" else f"{entry.name}, {test}"
        noise = "-" if part.true is None else _number(error_of(part.true, part, entry.task))
        models = " / ".join(map(_number, found.errors.get(test, []))) or "-"
        others = entry.published.get(test, Published())
        published = (others.linear or "-", others.black_box or "-", others.grey_box or "-")
        cells = (name, entry.unit, noise, _number(linear[test]), models, minutes, found.says, *published)
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def _number(value: float | None) -> str:
    return "no model" if value is None else "explodes" if value != value else f"{value:.3g}"


def main(argv: Sequence[str]) -> int:
    """Print lines as they come, and the table; 1 where no record is at hand."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    add = parser.add_argument
    add("--data", type=Path, metavar="FOLDER", help="of the public records' files (default: the made records alone)")
    add(
        "--only", nargs="+", choices=[*PUBLIC, *MADE], default=[], metavar="NAME", help=f"{', '.join([*PUBLIC, *MADE])}"
    )
    add("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of the search for the model (0 1 2)")
    add("--project", type=Path, metavar="FOLDER", help="a new folder that keeps what the product made (default: none)")
    options = parser.parse_args(argv)
    if options.data is not None and not options.data.is_dir():
        parser.error(f"{options.data} is no folder; give the one that holds the records")
    if options.project is not None and options.project.exists():
        parser.error(f"{options.project} is there already; give a new folder")
    torch.set_num_threads(1)
    entries, rows = entries_of(options.data, options.only), list[str]()
    if not entries:
        return 1
    with tempfile.TemporaryDirectory() as folder:
        project = Project(options.project or Path(folder) / "project")
        for entry in entries:
            rows += rows_of(entry, found_of(entry, project, options.seeds))
    heads = [f"seeds {' / '.join(map(str, options.seeds))}" if head == "model" else head for head in HEAD]
    print("\n".join(["", f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}", *rows]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
