"""A law, its file and its closed loop for notebooks: designed, written and simulated over a plant."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from loopwright.pipeline.cases.own_model import LAW_PART
from loopwright.pipeline.config.params import choose, parse
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.evaluation.trials import close_loop
from loopwright.pipeline.export.explain_graph import export_explanation
from loopwright.pipeline.export.gate import export as write_controller
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.metrics import mae, mv_travel
from loopwright.pipeline.pictures.loop_picture import RUN_DPI, History, draw, fewer_colours
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import Trajectory
from loopwright.pipeline.simulation.timetable import TimedValue, timetable
from loopwright.pipeline.workbench.identification import Identification
from loopwright.pipeline.workbench.plant_data import NOTEBOOK
from loopwright.serving.controller import Controller

CELL_DPI = 80.0
"""Dots an inch of the picture of a run below a notebook's cells, which is part of its file."""


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

    Of a predictive law with ``operate`` the graph that explains it is written beside it. Raises ExportError where the
    graph differs from the law; nothing is written then.
    """
    write_controller(law, path, case=case, provenance={})
    export_explanation(law, path)
    return Controller(path)


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
