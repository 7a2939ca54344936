"""From readings to a controller file in Python, as a notebook does it."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from PIL import Image, ImageChops

from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.errors import ParamsError, PlantError
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.pictures.drawing import png
from loopwright.pipeline.pictures.loop_picture import fewer_colours
from loopwright.pipeline.workbench import (
    Identification,
    PlantData,
    design,
    experiment,
    export,
    identify,
    screen,
    simulate,
)
from loopwright.pipeline.workbench.closed_loop import CELL_DPI
from loopwright.serving.controller import Controller

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_plant" / "make_export.py"
ROWS, PERIOD_S, DEAD = 1500, 10.0, 3
GAIN, FEED_GAIN = 0.8, -1.5
ROLES = {"pv": "TI.PV[degC]=0..100", "mv": "TI.OP[%]=0..100", "dv": "FI.PV[m3/h]=5..15"}


def table() -> pd.DataFrame:
    """A heater: a lag of 100 s with 30 s of dead time, and a feed that steps, read with noise."""
    rng = np.random.default_rng(0)
    op = np.repeat(rng.uniform(30, 70, ROWS // 25), 25)
    feed = np.repeat(rng.uniform(8, 12, ROWS // 100), 100)
    x = w = 0.0
    pv = np.empty(ROWS)
    for k in range(ROWS):
        pv[k] = 50 + x + w
        x += 0.1 * (GAIN * (op[max(k - DEAD, 0)] - 50) - x)
        w += 0.15 * (FEED_GAIN * (feed[k] - 10) - w)
    times = pd.date_range("2026-03-02 06:00", periods=ROWS, freq="10s")
    read = {"TI.PV": pv + 0.1 * rng.normal(size=ROWS), "TI.OP": op, "FI.PV": feed + 0.4 * rng.normal(size=ROWS)}
    return pd.DataFrame({"time": times, **read})


@pytest.fixture(scope="module")
def data() -> PlantData:
    return screen(table(), **ROLES)


@pytest.fixture(scope="module")
def found(data: PlantData) -> Identification:
    return identify(data, linear=True, minutes=0.3)


@pytest.fixture(scope="module")
def controller(found: Identification, tmp_path_factory: pytest.TempPathFactory) -> Controller:
    return export(design("predictive", found), tmp_path_factory.mktemp("files") / "predictive.onnx")


def test_readings_become_a_record(data: PlantData, tmp_path: Path) -> None:
    assert (len(data.record), data.record.period_s, data.refused) == (ROWS, PERIOD_S, "")
    assert [s.name for s in (*data.signals.pv, *data.signals.mv, *data.signals.dv)] == ["TI.PV", "TI.OP", "FI.PV"]
    assert f"{ROWS} rows" in str(data)
    assert (data._repr_png_() or b"").startswith(b"\x89PNG")
    data.page(tmp_path / "page.html")
    assert "<html" in (tmp_path / "page.html").read_text()


def test_what_is_left_out_has_its_reason() -> None:
    dirty = table()
    dirty.loc[[100, 200], "TI.PV"], dirty.loc[300, "FI.PV"] = 900.0, np.nan
    found = screen(dirty, **ROLES).left_out
    assert found.index.tolist() == ["empty cell", "outside the range that was given"]
    assert found[["TI.PV", "TI.OP", "FI.PV"]].to_numpy().tolist() == [[0, 0, 1], [2, 0, 0]]
    assert experiment(ThiosulfateCstr(), rows=50).left_out.empty


def test_a_file_and_a_table_are_the_same_readings(data: PlantData, tmp_path: Path) -> None:
    table().to_csv(tmp_path / "export.csv", index=False)
    by_file = screen(tmp_path / "export.csv", **ROLES)
    by_time = screen(table().set_index("time"), **ROLES)
    assert by_file.record.digest() == by_time.record.digest() == data.record.digest()


def test_the_model_has_the_gains_of_the_plant(found: Identification) -> None:
    gains = found.gains
    assert gains.loc[("TI.PV", "TI.OP"), "gain"] == pytest.approx(GAIN, rel=0.02)
    assert gains.loc[("TI.PV", "FI.PV"), "gain"] == pytest.approx(FEED_GAIN, rel=0.05)
    assert gains.loc[("TI.PV", "TI.OP"), "dead_time_s"] == DEAD * PERIOD_S
    assert found.doubts == ""
    assert found.plant.dv_noise_std == pytest.approx([0.4], rel=0.2)


def test_a_tank_that_settles_has_a_gain_at_a_longer_period_too(tmp_path: Path) -> None:
    """The example's export in rows of 30 s: one part alone shows a pole beyond 1; rows of 10 s give .870 degC/%."""
    file = tmp_path / "export.csv"
    subprocess.run([sys.executable, str(EXAMPLE), str(file)], check=True, timeout=60)
    data = screen(file, pv="TIC-101.PV", mv="TIC-101.OP=0..100", dv="FI-7", period_s=30)
    found = identify(data, linear=True, minutes=0.2)
    assert found.figures["stability"]["settles"] == 1.0
    heat = found.figures["gains"]["TIC-101.PV"]["TIC-101.OP"]
    assert (heat["rate"], heat["sign"]) == (False, "+")
    assert heat["gain"] == pytest.approx(0.87, rel=0.03)


def test_a_file_closes_the_loop_over_the_model(found: Identification, controller: Controller, tmp_path: Path) -> None:
    run = simulate(controller, found.plant, {0: 50.0, 600: 55.0}, disturbances={"FI.PV": {1800: 11.0}}, duration_s=3600)
    frame = run.frame()
    assert list(frame.columns) == ["SP TI.PV", "TI.PV", "measured TI.PV", "TI.OP"]
    assert frame["TI.PV"].iloc[-1] == pytest.approx(55.0, abs=0.02)
    assert run.mae["TI.PV"] < 0.5
    assert 0 < run.travel["TI.OP"] < 80
    run.draw(tmp_path / "loop.png", CELL_DPI)
    assert (tmp_path / "loop.png").read_bytes().startswith(b"\x89PNG")
    assert run._repr_png_().startswith(b"\x89PNG")
    assert len(run._repr_png_()) < 0.7 * (tmp_path / "loop.png").stat().st_size
    assert run.title == "predictive on the model"
    late = {"dead_time": {0: 4}}
    with pytest.raises(PlantError, match="must be 0 to 1"):
        simulate(controller, found.plant, {0: 50.0}, disturbances=late)
    assert simulate(controller, found.plant_later(4), {0: 50.0, 60: 55.0}, disturbances=late).mae["TI.PV"] > 0
    noisy = simulate(controller.path, found.plant, {0: 50.0}, noise=True, duration_s=600).frame()
    assert (noisy["measured TI.PV"] - noisy["TI.PV"]).std() == pytest.approx(0.1, rel=0.4)


def test_fewer_colours_are_the_same_colours() -> None:
    canvas = Figure(figsize=(6, 3))
    canvas.subplots().plot(range(9), color="#009e73")
    picture = png(canvas)
    before, after = (Image.open(io.BytesIO(b)).convert("RGB") for b in (picture, fewer_colours(picture)))
    assert max(hi for _, hi in ImageChops.difference(before, after).getextrema()) < 40
    assert (0, 158, 115) in {colour for _, colour in after.getcolors()}
    assert len(fewer_colours(picture)) < 0.7 * len(picture)


def test_a_plant_in_equations_needs_no_model(tmp_path: Path) -> None:
    plant = ThiosulfateCstr()
    controller = export(design("pid", plant=plant, tuning="imc"), tmp_path / "pid.onnx")
    run = simulate(controller, plant, {0: 0.5, 60: 0.6}, duration_s=400)
    assert run.frame().iloc[-1, 1] == pytest.approx(0.6, abs=0.01)
    data = experiment(plant, rows=300)
    assert len(data.record) == 300
    assert "300 rows" in str(data)
    with pytest.raises(ParamsError, match="simulated"):
        data.page(tmp_path / "page.html")


def test_what_cannot_be_is_said(data: PlantData, found: Identification, controller: Controller) -> None:
    for wrong, said in (
        (lambda: screen(table(), pv="TI.PV"), "one MV"),
        (lambda: design("predictive"), "give the model"),
        (lambda: design("predictve", found), "predictive"),
        (lambda: design("pid", found, kcc=1.0), "kcc"),
        (lambda: simulate(controller, found.plant, {0: 500.0}), "outside"),
        (lambda: simulate(controller, found.plant, {"TI": {0: 50.0}}), "TI"),
        (lambda: simulate(controller, found.plant, {0: 50.0}, disturbances={"FI": {0: 9.0}}), "FI"),
    ):
        with pytest.raises(ParamsError, match=said):
            wrong()


def test_every_law_is_one_that_design_knows() -> None:
    with pytest.raises(ParamsError) as error:
        design("")
    assert all(law in str(error.value) for law in LAWS)
