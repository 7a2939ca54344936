"""From readings to a controller file in Python, a call a step, as the stages do it; for notebooks.

    data = screen("export.csv", pv="TIC-101.PV[degC]=0..120", mv="TIC-101.OP[%]=0..100", sp="TIC-101.SP")
    found = identify(data)
    controller = export(design("predictive", found), "predictive.onnx")
    run = simulate(controller, found.plant, {0: 60.0, 600: 70.0}, duration_s=3600)
    run.draw("loop.png")

Nothing here needs params.yaml, DVC or MLflow. The tests of many closed loops, and their verdict, are those of
``loopwright run``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from loopwright.pipeline.cases.own_model import LAW_PART, MODEL_ARRAYS, OwnPlant
from loopwright.pipeline.config.exports import ExportParams
from loopwright.pipeline.config.known import Known
from loopwright.pipeline.config.params import choose, parse
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.evaluation.proof import fit_doubts, sign_doubts, wants_a_plainer_model
from loopwright.pipeline.evaluation.trials import close_loop
from loopwright.pipeline.excitation.planned import excited, first_test, planned
from loopwright.pipeline.export.gate import export as write_controller
from loopwright.pipeline.historian.cleaning.tags import Tag, check_tags, named, parse_tag, read_tags
from loopwright.pipeline.historian.export_params import exported, read_and_screen, with_units
from loopwright.pipeline.historian.files.file_reader import tags_in
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.guessing import controlled_first
from loopwright.pipeline.historian.screening import Screened, refusal
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.metrics import mae, mv_travel
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.identified.network_search import UNITS
from loopwright.pipeline.models.identified.structure_search import Searched
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.pictures.drawing import png
from loopwright.pipeline.pictures.loop_picture import RUN_DPI, History, draw, fewer_colours
from loopwright.pipeline.pictures.screening_pictures import trends
from loopwright.pipeline.plants.simulator import Signals, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.report.screening import sayings, write_page
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import Trajectory
from loopwright.pipeline.simulation.timetable import TimedValue, timetable
from loopwright.serving.controller import Controller

Words = str | Sequence[str]
"""A tag, or several: ``TAG``, ``TAG[UNIT]`` or ``TAG[UNIT]=LOW..HIGH``."""

NOTEBOOK = "notebook"
"""Name of the plant in files that are made here."""

CELL_DPI = 80.0
"""Dots an inch of the picture of a run below a notebook's cells, which is part of its file."""


# ----------------------------------------------------------------------------------------------------- 1. the readings
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
    signals = _signals_of(found.record)
    old = [law for law in found.report.old_controllers if law.believed]
    held = {law.pv: 1 if law.kc > 0 else -1 for law in old} if len(signals.sp) == 1 else {}
    return PlantData(found.record, signals, held, found, "" if why is None else why.why)


def experiment(plant: Simulator, rows: int = 4000, seed: int = 0) -> PlantData:
    """The record of an experiment on a simulated plant: holds that its own step test plans, within its safe range.

    Raises PlantError for a plant that does not rest, or whose MVs move nothing.
    """
    record = excited(plant, planned(plant, first_test(plant), rows), seed)
    return PlantData(record, plant.signals, {})


# -------------------------------------------------------------------------------------------------------- 2. the model
@dataclass(frozen=True, eq=False)
class Identification:
    """A model of the plant, what its fit found (``figures``), and what speaks against it (``doubts``, else empty)."""

    model: Identified
    data: PlantData
    figures: Mapping[str, Any]
    doubts: str

    @property
    def gains(self) -> pd.DataFrame:
        """A row each pair: gain [PV/input], its spread, sign, lowest and highest gain, dead time [s]."""
        dead = self.figures["dead_times"]
        rows = [
            {"pv": pv, "input": name, **{k: of[k] for k in ("gain", "spread", "sign", "low", "high")}}
            | {"dead_time_s": dead[name] * self.data.record.period_s}
            for pv, inputs in self.figures["gains"].items()
            for name, of in inputs.items()
        ]
        return pd.DataFrame(rows).set_index(["pv", "input"])

    @cached_property
    def plant(self) -> OwnPlant:
        """The model as a plant, with its noise, that begins at rest at the medians of the record's inputs."""
        return self.plant_later(0.0)

    def plant_later(self, periods: float) -> OwnPlant:
        """The same, whose parameter ``dead_time`` may be so many periods: in ``plant`` what the record leaves open."""
        arrays = {name: np.asarray(getattr(self.model, name)) for name in MODEL_ARRAYS}
        mv, dv = (np.median(values, axis=0) for values in (self.data.record.mv, self.data.record.dv))
        plant = OwnPlant.of_model(arrays, self.data.signals, name=NOTEBOOK, mv=mv, dv=dv, dead=periods)
        vars(plant).update(title="the model")  # its runs are told from those of the plant itself
        return plant


def identify(
    data: PlantData | Record,
    *,
    minutes: float | None = None,
    linear: bool = False,
    known: Sequence[Known] = (),
    seed: int = 0,
) -> Identification:
    """The model of a record, its structure searched as stage ``fit`` does.

    A network that the record does not prove gives way to the linear model where the record proves that one.

    Parameters
    ----------
    data
        Readings that were screened, or any record.
    minutes
        Budget of the search, in minutes of one core; None: 2 for each output.
    linear
        Linear models alone.
    known
        What an engineer knows of pairs of PV and input.
    seed
        Of the networks' starts.

    Raises
    ------
    ModelError
        The record cannot carry a model: too short, or an input that never moves.
    """
    if isinstance(data, Record):
        data = PlantData(data, _signals_of(data), {})
    part = IdentifiedPart(minutes=minutes, units=() if linear else UNITS)
    source = Source(data.record, data.signals, seed=seed, known=tuple(known), held=data.held)
    work = part.groundwork()
    searched = work.done(source, work.kind)
    model, figures = _learnt(part, source, searched)
    plain = work.plainer(searched)
    if plain is not None and wants_a_plainer_model(_as_set(figures)):
        other, found = _learnt(part, source, plain)
        if not (sign_doubts(_as_set(found)) or fit_doubts(_as_set(found))):
            model, figures = other, found
    return Identification(model, data, figures, sign_doubts(_as_set(figures)))


def _learnt(part: IdentifiedPart, source: Source, searched: Searched) -> tuple[Identified, dict[str, Any]]:
    learnt = part.learn(replace(source, groundwork={part.groundwork(): searched}))
    assert isinstance(learnt.model, Identified)
    return learnt.model, learnt.metrics


def _as_set(figures: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of a model as those who judge the proof read them, in a set of models."""
    return {"": {"parts": {LAW_PART: {"kind": "identified", "per_seed": {"0": figures}}}}}


# ------------------------------------------------------------------------------------------- 3. the law, 4. its file
def design(
    law: str, found: Identification | None = None, *, plant: Simulator | None = None, **settings: Any
) -> ControlLaw:
    """A control law, tuned on a model, or on a plant in equations.

    Parameters
    ----------
    law
        Its name; ``loopwright laws`` lists them.
    found
        The model that it rests on.
    plant
        The plant in its place, for laws that need no model.
    settings
        Its parameters, as in a section of ``controllers``; the predictive law is searched unless ``tuning`` says else.

    Raises
    ------
    LawError
        The law does not suit the plant.
    ParamsError
        There is no such law or setting, or neither a model nor a plant.
    """
    kind = choose(LAWS, law, "law", "design")
    if plant is None and found is None:
        raise ParamsError("give the model to design on: design(law, found), or a plant: design(law, plant=plant)")
    on = found.plant if plant is None and found is not None else plant
    assert on is not None
    chosen = {**({"tuning": "search"} if law == "predictive" else {}), **settings}
    parts = {} if found is None else {LAW_PART: found.model}
    return kind.design(parse(kind.Params, chosen, f"design({law!r})"), parts, on.signals, on).eval()


def export(law: ControlLaw, path: str | Path, *, case: str = NOTEBOOK) -> Controller:
    """The law as one ONNX file, checked step by step against the law, and loaded by the runtime that will run it.

    Raises ExportError where the graph differs from the law; nothing is written then.
    """
    write_controller(law, path, case=case, provenance={})
    return Controller(path)


# --------------------------------------------------------------------------------------------------- 5. the closed loop
@dataclass(frozen=True, eq=False)
class Run:
    """A closed loop of a controller file over a plant."""

    plant: Simulator
    loop: Trajectory
    title: str

    @property
    def mae(self) -> dict[str, float]:
        """Mean absolute error of each controlled variable, in its unit, by its name."""
        pairs = zip(self.plant.sp_signals, self.loop.sp.T, self.loop.pv.T, strict=False)
        return {s.name: mae(sp, pv) for s, sp, pv in pairs}

    @property
    def travel(self) -> dict[str, float]:
        """Sum of the moves of each MV, in its unit, by its name."""
        return {s.name: mv_travel(mv) for s, mv in zip(self.plant.mv_signals, self.loop.mv.T, strict=True)}

    def frame(self) -> pd.DataFrame:
        """A row a sample: set points, true and measured process variables, MVs; the index is the time [s]."""
        plant, loop = self.plant, self.loop
        columns = {f"SP {s.name}": v for s, v in zip(plant.sp_signals, loop.sp.T, strict=True)}
        columns |= {s.name: v for s, v in zip(plant.pv_signals, loop.pv.T, strict=True)}
        columns |= {f"measured {s.name}": v for s, v in zip(plant.pv_signals, loop.measured.T, strict=True)}
        columns |= {s.name: v for s, v in zip(plant.mv_signals, loop.mv.T, strict=True)}
        return pd.DataFrame(columns, index=pd.Index(loop.time_s, name="time_s"))

    def _repr_png_(self) -> bytes:
        """The picture, as a notebook shows it below a cell that ends with this run."""
        with tempfile.TemporaryDirectory() as folder:
            self.draw(path := Path(folder) / "run.png", CELL_DPI)
            return fewer_colours(path.read_bytes())

    def draw(self, path: str | Path, dpi: float = RUN_DPI) -> None:
        """Write a picture of the loop, of 9 inches by so many dots."""
        loop, n = self.loop, len(self.loop.time_s)
        sp, pv, measured, mv = ([*values] for values in (loop.sp, loop.pv, loop.measured, loop.mv))
        history = History(loop.time_s.tolist(), ["AUTO"] * n, sp, pv, measured, mv, [""] * n)
        draw(Path(path), self.plant, history, self.title, {}, dpi)


def simulate(
    controller: Controller | str | Path,
    plant: Simulator,
    set_points: Mapping[float, float] | Mapping[str, Mapping[float, float]],
    *,
    disturbances: Mapping[str, Mapping[float, float]] | None = None,
    duration_s: float | None = None,
    noise: bool = False,
    seed: int = 0,
) -> Run:
    """A controller file in closed loop over a plant, from a rest.

    A plant in equations begins in the middle of the set point's range, any other, as a model, at its ``start``.

    Parameters
    ----------
    controller
        The file, or where it lies: what runs on the plant is what is simulated.
    plant
        Where to close the loop, e.g. ``found.plant``, or the plant that a record was made on.
    set_points
        Time [s] -> value from then on; of several controlled variables their names first.
    disturbances
        Name of a measured disturbance or of a parameter of the plant, and the same.
    duration_s
        Length of the run [s]; None: 80 samples after the last move.
    noise, seed
        Whether the plant's own noise is added to all readings, and its seed.

    Raises
    ------
    ParamsError, PlantError
        A set point or a disturbance that the plant does not have, or that is out of range.
    """
    file = controller if isinstance(controller, Controller) else Controller(controller)
    course = timetable(
        plant,
        set_points=_events(set_points),
        disturbances=_events(disturbances or {}),
        duration_s=duration_s,
        seed=seed,
    )
    test = Scenario("run", "", course.sp, course.x0, course.mv0, course.changes, dv=course.dv)
    loop = close_loop(file, plant, test, np.asarray(plant.noise_std) if noise else None, seed)
    return Run(plant, loop, f"{file.manifest.law} on {plant.title}")


def _events(moves: Mapping[Any, Any]) -> list[TimedValue]:
    """A list of {time: value} or {name: {time: value}}."""
    named = moves if any(isinstance(of, Mapping) for of in moves.values()) else {"": moves}
    return [TimedValue(float(value), float(at), name) for name, of in named.items() for at, value in of.items()]


# --------------------------------------------------------------------------------------------------------------- parts
def _signals_of(record: Record) -> Signals:
    """The signals of a record: the first process variables have set points, as many as there are MVs for."""
    n = min(len(record.pv_signals), len(record.mv_signals))
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
