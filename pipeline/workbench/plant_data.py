"""A record of a plant for notebooks: screened from exports of its historian, or of an experiment on a simulated one."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from loopwright.pipeline.config.exports import ExportParams
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.excitation.planned import excited, first_test, planned
from loopwright.pipeline.historian.cleaning.tags import Tag, check_tags, named, parse_tag, read_tags
from loopwright.pipeline.historian.export_params import exported, read_and_screen, with_units
from loopwright.pipeline.historian.files.file_reader import tags_in
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.guessing import controlled_first
from loopwright.pipeline.historian.screening import Screened, refusal
from loopwright.pipeline.pictures.drawing import png
from loopwright.pipeline.pictures.loop_picture import fewer_colours
from loopwright.pipeline.pictures.screening_pictures import trends
from loopwright.pipeline.plants.simulator import Signals, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.report.screening import sayings, write_page

Words = str | Sequence[str]
"""A tag, or several: ``TAG``, ``TAG[UNIT]`` or ``TAG[UNIT]=LOW..HIGH``."""

NOTEBOOK = "notebook"
"""Name of the plant in files that are made here."""


@dataclass(frozen=True, eq=False)
class PlantData:
    """A record of a plant, and what its readings say.

    ``signals`` are the plant's, controlled variables first. ``held`` is the sign of each PV's answer to its MV by which
    the old loop held it. ``screened`` has every reading that was left out and why; None of a record that was simulated.
    """

    record: Record
    signals: Signals
    held: Mapping[str, int]
    screened: Screened | None = None
    refused: str = ""  # why `loopwright new` does not take this record; empty where it does

    def __str__(self) -> str:
        if self.screened is None:
            return f"{len(self.record)} rows of {self.record.period_s:g} s"
        report = self.screened.report
        findings = [f"{finding.tag}: {finding.words}" for finding in report.findings]
        said = sayings(report.verdict, {tag.name: tag.unit for tag in report.tags})
        old = [*(loop.words for loop in report.operated), *(law.words for law in report.old_controllers)]
        carries = f"can these data carry a model: {report.verdict.carries}"
        return "\n".join([report.summary, *findings, *said, *old, carries, *report.verdict.reasons])

    def _repr_png_(self) -> bytes | None:
        """The trends, as a notebook shows them below a cell that ends with this record."""
        return None if self.screened is None else fewer_colours(png(trends(self.screened)))

    @property
    def left_out(self) -> pd.DataFrame:
        """Readings of each tag, and rows of the record, that are not used: a row each reason; empty of a simulated one.

        A row of the record is left out where a tag has no value for it.
        """
        if self.screened is None:
            return pd.DataFrame()
        report = self.screened.report
        columns = {**{tag.tag: tag.readings for tag in report.tags}, "rows of the record": report.dropped_rows}
        table = pd.DataFrame(columns, index=[r.name.lower() for r in Reason if r]).fillna(0).astype(int)
        table = table[table.any(axis=1)]
        return table.set_axis([Reason[name.upper()].words for name in table.index], axis=0)

    def page(self, path: str | Path) -> None:
        """Write the page of the screening: trends with every reading that was left out, and why."""
        if self.screened is None:
            raise ParamsError("this record was simulated: nothing of it was screened")
        write_page(Path(path), self.screened, None)


def screen(
    *files: str | Path | pd.DataFrame,
    pv: Words = (),
    mv: Words = (),
    dv: Words = (),
    sp: Words = (),
    mode: Words = (),
    tags: str | Path | None = None,
    period_s: float | None = None,
    **how: Any,
) -> PlantData:
    """The record of a plant from exports of its historian, screened as ``loopwright new`` does.

    Parameters
    ----------
    files
        Exports (.csv, .parquet, .xlsx and what else ``loopwright new`` reads), or tables with a column of times.
    pv, mv, dv, sp, mode
        Controlled and further process variables, MVs, measured disturbances, set points, modes.
    tags
        A table of tags in place of these, as ``loopwright new`` proposes one.
    period_s
        Sampling period [s]; None: that of the export, longer for a slow plant.
    how
        Further settings of a section of ``exports``: ``hold_s``, ``without_mode``, ``leave_out``, ``time_zone``, ...

    Raises
    ------
    RecordError
        A file, a tag or the readings cannot be used at all. A record that carries no model says so in ``refused``.
    """
    if tags is None and not (pv and mv):
        raise ParamsError(
            "name at least one process variable and one MV: screen(file, pv=..., mv=...), or give tags=FILE"
        )
    roles: dict[str, Words] = {"pv": pv, "mv": mv, "dv": dv, "sp": sp, "mode": mode}
    with tempfile.TemporaryDirectory() as folder:
        paths = tuple(_on_disk(file, Path(folder) / f"table{i}.parquet") for i, file in enumerate(files))
        given = _tags_of(paths, roles) if tags is None else read_tags(Path(tags))
        check_tags(given, "the tags" if tags is None else str(tags))
        section = {"files": paths, "tags": tuple(map(exported, given)), "period_s": period_s, **how}
        export = ExportParams(case=NOTEBOOK, **section)
        listed = with_units(controlled_first(named(given)), export)
        found = read_and_screen(export, listed)
    why = refusal(found, listed, anyway=False)
    signals = signals_of(found.record, sum(t.constraint for t in listed))
    old = [law for law in found.report.old_controllers if law.believed]
    held = {law.pv: 1 if law.kc > 0 else -1 for law in old} if len(signals.sp) == 1 else {}
    return PlantData(found.record, signals, held, found, "" if why is None else why.why)


def experiment(plant: Simulator, rows: int = 4000, seed: int = 0) -> PlantData:
    """The record of an experiment on a simulated plant: holds that its own step test plans, within its safe range.

    Raises PlantError for a plant that does not rest, or whose MVs move nothing.
    """
    record = excited(plant, planned(plant, first_test(plant), rows), seed)
    return PlantData(record, plant.signals, {})


def signals_of(record: Record, constraints: int = 0) -> Signals:
    """The signals of a record: the first process variables have set points, as many as there are MVs for.

    The last ones, ``constraints`` of them, have none.
    """
    n = min(len(record.pv_signals) - constraints, len(record.mv_signals))
    return Signals(record.period_s, record.pv_signals[:n], record.pv_signals, record.dv_signals, record.mv_signals)


def _tags_of(paths: Sequence[Path], roles: Mapping[str, Words]) -> tuple[Tag, ...]:
    several = {role: [words] if isinstance(words, str) else words for role, words in roles.items()}
    return tuple(parse_tag(text, role, lambda: tags_in(paths)) for role, words in several.items() for text in words)


def _on_disk(file: str | Path | pd.DataFrame, path: Path) -> Path:
    """Where a file lies; a table is written first."""
    if not isinstance(file, pd.DataFrame):
        return Path(file)
    (file.reset_index(names="time") if isinstance(file.index, pd.DatetimeIndex) else file).to_parquet(path)
    return path
