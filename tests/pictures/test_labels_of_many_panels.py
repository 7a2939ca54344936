"""Pictures of own plants with many signals and long names: no label runs into another, and gains are the table's."""

from __future__ import annotations

from itertools import combinations
from types import SimpleNamespace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from identified_models import scaled_model
from matplotlib.figure import Figure as Canvas
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from own_cases import case_of

from loopwright.pipeline.cases.own_plant import OwnCase
from loopwright.pipeline.pictures.drawing import STYLE, symbol
from loopwright.pipeline.pictures.identified_pictures import (
    IN_TABLE,
    free_run_picture,
    gains_picture,
    step_responses_picture,
)
from loopwright.pipeline.pictures.loop_panels import LoopPanels

GAINS = np.array([[2.0, -0.8, 0.3, 0.01], [0.6, 1.5, -0.2, -0.03]])
N_Y, N_MV, N_DV = 2, 3, 1


def signal(name: str, unit: str) -> dict[str, Any]:
    return {"name": name, "unit": unit, "low": -3000.0, "high": 3000.0}


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> OwnCase:
    """Two lags that three MVs and a measured disturbance move, with the long names of a control system."""
    rng, poles = np.random.default_rng(0), np.array([0.9, 0.8])
    v = np.repeat(rng.uniform(-60.0, 60.0, (40, N_MV + N_DV)), 15, axis=0)
    y = np.zeros((len(v), N_Y))
    for k in range(len(v) - 1):
        y[k + 1] = y[k] + (1 - poles) * (GAINS @ v[k] - y[k])
    entry = {
        "period_s": 1.0,
        "pv": [signal(f"Unit3_Reactor_Temperature_{i}.PV", "degC") for i in range(N_Y)],
        "mv": [signal(f"Unit3_Reactor_CoolantFlow_{i}.OP", "%") for i in range(N_MV)],
        "dv": [signal("Unit3_Reactor_FeedRate_0.PV", "kg/h")],
        "data": "data/it/record.parquet",
        "source": [],
    }
    rest = np.eye(N_Y, N_Y + N_MV + N_DV + 1)
    models = [
        scaled_model(N_Y, N_MV, N_DV, N_Y, a=np.diag(poles), b=s * (1 - poles)[:, None] * GAINS, rest=rest)
        for s in (1.0, 0.9, 1.1)
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("own"))
        found = case_of(entry, models, y, v[:, :N_MV], v[:, N_MV:])
        assert (found.ready, len(found.members), len(found.record)) == (True, 2, 600)  # read while the files are there
        assert found.plant.n_mv == N_MV
    return found


@pytest.fixture(scope="module")
def evidence(case: OwnCase) -> Any:
    """What the pictures of an identified model show."""
    plant, periods = case.plant_class, np.arange(1, 61)
    inputs = (*plant.mv_signals, *plant.dv_signals)
    rise = 1 - 0.9**periods
    responses, gains = {}, {}
    for i, cv in enumerate(plant.sp_signals):
        curves = {s.name: GAINS[i, j] * rise for j, s in enumerate(inputs)}
        responses[cv.name] = {
            name: {"periods": periods.tolist(), "middle": c.tolist(), "low": 0.9 * c, "high": 1.1 * c}
            for name, c in curves.items()
        }
        gains[cv.name] = {
            s.name: {"gain": GAINS[i, j], "spread": 0.1, "rate": False, "sign": "-" if GAINS[i, j] < 0 else "+"}
            for j, s in enumerate(inputs)
        }
    answers = {cv: {s.name: 3 for s in inputs} for cv in gains}
    part = {"step_responses": responses, "first_answers": answers, "gains": gains}
    # Most residuals are tiny, some ten times as large: the ends of the histogram lie far out.
    residual = 1e-5 * np.random.default_rng(0).standard_t(2, (600, N_Y)).clip(-4.0, 14.0)
    arrays = {
        "time_s": np.arange(600.0),
        "measured": case.record.pv * 1e-3 + residual,
        "free run": case.record.pv * 1e-3,
    }
    return SimpleNamespace(
        case=case,
        models={"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": part}}}}},
        tests={"held_out": [SimpleNamespace(plant=member) for member in case.members]},
        predictions=lambda name: arrays,
    )


def moved_disturbance(evidence: Any) -> Canvas:
    """The test with steps of the measured disturbance."""
    n = 200
    loop = {"time_s": np.arange(float(n)), "sp": np.ones((n, N_Y)), "pv": np.ones((n, N_Y)), "mv": np.ones((n, N_MV))}
    panels = LoopPanels(evidence.case, "A step", {"PID": loop}, dv=np.linspace(500.0, 1500.0, n)[:, None])
    panels.add(loop, "PID", "black")
    return panels.finish(loop)


def boxes(canvas: Canvas) -> dict[str, Bbox]:
    """Where each visible word of the axes stands."""
    canvas.draw_without_rendering()
    found = {}
    for k, axes in enumerate(canvas.axes):
        ticks = [
            tick.label1
            for axis, ends in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim()))
            for tick in axis.get_major_ticks()
            if min(ends) <= tick.get_loc() <= max(ends)
        ]
        titles = [t for t in axes.get_children() if isinstance(t, Text)]
        for i, text in enumerate((*titles, axes.xaxis.label, axes.yaxis.label, *ticks)):
            if text.get_visible() and text.get_text():
                found[f"{k}.{i} {text.get_text()}"] = text.get_window_extent()
    return found


@pytest.mark.parametrize("draw", [gains_picture, step_responses_picture, free_run_picture, moved_disturbance])
def test_no_label_runs_into_another_or_leaves_the_picture(evidence: Any, draw: Any) -> None:
    with mpl.rc_context(STYLE):
        canvas = draw(evidence)
        found = boxes(canvas)
    assert len(found) > 10
    over = [
        (a, b) for (a, p), (b, q) in combinations(found.items(), 2) if p.shrunk(0.9, 0.9).overlaps(q.shrunk(0.9, 0.9))
    ]
    assert over == []
    whole = canvas.bbox.padded(2.0)
    assert [name for name, box in found.items() if not whole.contains(*box.min) or not whole.contains(*box.max)] == []


def test_the_picture_of_gains_marks_those_of_the_table(evidence: Any) -> None:
    canvas = gains_picture(evidence)
    middle = np.median(evidence.case.record.mv, axis=0)
    for k, axes in enumerate(canvas.axes):
        i, j = divmod(k, N_MV)
        (mark,) = axes.containers
        assert mark.get_label() == IN_TABLE
        assert mark.lines[0].get_xydata().tolist() == [[pytest.approx(middle[j]), pytest.approx(GAINS[i, j])]]
        (own,) = (line for line in axes.lines if line.get_label() == "law's model")
        np.testing.assert_allclose(own.get_ydata(), GAINS[i, j], rtol=1e-6)
        low, high = np.quantile(evidence.case.record.mv[:, j], [0.1, 0.9])
        assert own.get_xdata()[[0, -1]] == pytest.approx([low, high])
    assert "°C/%" in canvas.axes[1].get_ylabel()


def test_only_symbols_are_written_as_formulas() -> None:
    assert [symbol(name) for name in ("C_A", "T", "pH", "TIC-101.PV")] == ["$C_{A}$", "$T$", "pH", "TIC-101.PV"]
    assert [symbol(name) for name in ("reactor_temperature", "T_in", "a_b_c")] == [
        "reactor_temperature",
        "$T_{in}$",
        "a_b_c",
    ]
