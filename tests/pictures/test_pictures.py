"""What a person must be able to read in every picture: units, ticks, curves that hide no other, legends beside them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import made_up_case as made_up
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.text import Text

from loopwright.pipeline.cases import CASES, PLANTS
from loopwright.pipeline.cases.jacketed_batch_reactor.pictures import recipe_picture, switches_picture
from loopwright.pipeline.evaluation.case import Curve
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.pictures import loop_picture
from loopwright.pipeline.pictures.drawing import STYLE, clear_legend, layer, legend_below, scale
from loopwright.pipeline.pictures.loop_panels import LoopPanels, rings, too_fast
from loopwright.pipeline.pictures.loop_pictures import info_label
from loopwright.pipeline.pictures.model_pictures import candidates_picture
from loopwright.pipeline.report import figures
from loopwright.serving.manifest import Signal

FLOW = Signal("q", "l/s", 0.0, 10.0)
MINIS = (made_up.THIOSULFATE, made_up.PH, made_up.BATCH)


@pytest.fixture(scope="module", params=MINIS, ids=lambda mini: mini.case)
def drawn(request: Any, tmp_path_factory: Any) -> tuple[Evidence, dict[str, Canvas]]:
    """All pictures of a made-up case, as canvases by their file names."""
    root, mini = tmp_path_factory.mktemp("pictures"), request.param
    made_up.write_case(root, mini=mini)
    work = root / "work" / mini.case
    evidence = Evidence.load(mini.of, made_up.bounds(mini), work, root / "timing" / mini.case, tuple(mini.quality))
    kept: dict[str, Canvas] = {}

    def keep(canvas: Canvas, path: Path) -> None:
        canvas.draw_without_rendering()
        path.touch()  # the best law's picture is copied
        kept[path.name] = canvas

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "save", keep)
        figures.draw_all(evidence, root / "figures")
    return evidence, kept


def visible(axes: Axes) -> bool:
    return bool(axes.axison and axes.get_visible())


def test_every_axis_has_a_label_and_the_unit_of_what_it_shows(drawn: tuple[Evidence, dict[str, Canvas]]) -> None:
    evidence, canvases = drawn
    plant = evidence.case.plant_class
    plain = {s.name for s in (*plant.pv_signals, *plant.mv_signals) if s.unit == "-"}
    plain |= {f"${name}$" for name in plain} | {"$y$", r"penalty $\mu$", "linearization error"}
    assert canvases
    for name, canvas in canvases.items():
        for axes in filter(visible, canvas.axes):
            label = axes.get_ylabel()
            assert label.endswith("]") or label.removeprefix("validation RMSE") in plain | {""}, (name, label)
            assert label, name
        assert canvas.axes[-1].get_xlabel(), name


def test_no_legend_covers_a_curve_or_leaves_the_picture(drawn: tuple[Evidence, dict[str, Canvas]]) -> None:
    for name, canvas in drawn[1].items():
        for legend in canvas.legends:
            box = legend.get_window_extent()
            assert box.x0 >= 0.0, name
            assert box.x1 <= canvas.bbox.width, name
        for axes in canvas.axes:
            legend_here = axes.get_legend()
            assert legend_here is None or not points_inside(axes, legend_here.get_window_extent()), name


def test_no_title_leaves_the_picture(drawn: tuple[Evidence, dict[str, Canvas]]) -> None:
    for name, canvas in drawn[1].items():
        assert titles_end(canvas) <= canvas.bbox.width, name


def titles_end(canvas: Canvas) -> float:
    """Where the rightmost title ends [dots]."""
    found = [text for axes in canvas.axes for text in axes.findobj(Text) if text.get_text() == axes.get_title("left")]
    return max((text.get_window_extent().x1 for text in found), default=0.0)


def points_inside(axes: Axes, box: Any) -> int:
    """Points of the curves, 50 between each two of the data, that lie in ``box``."""
    count = 0
    for line in axes.lines:
        data = np.column_stack([line.get_xdata(), line.get_ydata()]).astype(float)
        at = line.get_transform().transform(data)
        if line.get_linestyle() != "None":
            at = np.concatenate([at, *(np.linspace(a, b, 50) for a, b in pairwise(at))])
        count += sum(bool(box.contains(x, y) and axes.bbox.contains(x, y)) for x, y in at)
    return count


def test_the_papers_curves_lie_in_front_of_ours(drawn: tuple[Evidence, dict[str, Canvas]]) -> None:
    ours = 0
    for canvas in drawn[1].values():
        lines = {str(line.get_label()): line for line in canvas.axes[0].lines}
        best = [line for label, line in lines.items() if label.endswith("(ours, best)")]
        papers = [v for k, v in lines.items() if not k.startswith("_") and k not in {"set point", "reference"}]
        for line in best:
            ours += 1
            assert all(line.get_zorder() < other.get_zorder() for other in papers if other is not line)
            assert all(line.get_linewidth() > other.get_linewidth() for other in papers if other is not line)
    assert ours


@pytest.mark.parametrize("span", [(1.0006, 1.0098), (0.0012, 0.0045), (3.0, 210.0), (2e-6, 4e-5), (1e-6, 1e-1)])
def test_ticks_are_numbers_that_can_be_read(span: tuple[float, float]) -> None:
    canvas = Canvas(layout="constrained")
    axes = canvas.subplots()
    values = np.geomspace(*span, 7)
    axes.plot(values, "o")
    scale(axes.yaxis, values)
    canvas.draw_without_rendering()
    low, high = axes.get_ylim()
    at = axes.yaxis.get_majorticklocs()
    shown = [label.get_text() for label, y in zip(axes.yaxis.get_ticklabels(), at, strict=True) if low <= y <= high]
    assert len([text for text in shown if text]) >= 3
    assert not any(r"10^{0}" in text or r"\times" in text for text in shown)
    assert not any(label.get_text() for label in axes.yaxis.get_ticklabels(minor=True))
    assert axes.yaxis.get_offset_text().get_text() == ""
    for text, y in zip(shown, at[(low <= at) & (at <= high)], strict=True):
        if "10^" not in text:
            assert float(text.replace("−", "-")) == pytest.approx(y)


def test_the_candidates_of_a_search_have_their_unit_and_plain_ticks() -> None:
    rows = [
        {"lags": "2, 2", "hidden": "6", "parameters": n, "rmse": 1 + n / 1e4, "free_run_rmse": 1 + n / 9e3, "chosen": n}
        for n in (6, 30, 99)
    ]
    part = "a part whose name is longer than a picture of that size is wide, as names of tests are, and goes on and on"
    canvas = candidates_picture({"model": "nnarx", "part": part, "rows": rows, "seeds": 5}, "degC")
    canvas.draw_without_rendering()
    (axes,) = canvas.axes
    assert titles_end(canvas) <= canvas.bbox.width
    assert axes.get_ylabel() == "validation RMSE [°C]"
    assert not any("10^" in label.get_text() for label in axes.yaxis.get_ticklabels(which="both"))
    for words in axes.texts:
        box = words.get_window_extent()
        assert axes.bbox.x0 <= box.x0
        assert box.x1 <= canvas.bbox.width


@pytest.mark.parametrize("log", [False, True])
def test_a_legend_makes_itself_room(log: bool) -> None:
    with mpl.rc_context(STYLE):
        canvas = Canvas(figsize=(4.0, 2.4), layout="constrained")
        axes = canvas.subplots()
        for k in range(4):  # curves in every corner
            axes.plot(np.arange(40), 10.0 ** (2 * np.sin(np.arange(40) + k)), label=f"a controller's long name {k}")
        if log:
            axes.set_yscale("log")
        low = axes.get_ylim()[0]
        legend = clear_legend(axes)
        canvas.draw_without_rendering()
    assert points_inside(axes, legend.get_window_extent()) == 0
    assert axes.get_ylim()[0] == pytest.approx(low)
    assert all(np.max(line.get_ydata()) <= axes.get_ylim()[1] for line in axes.lines)


def test_a_legend_below_takes_as_many_columns_as_fit() -> None:
    canvas = Canvas(figsize=(5.0, 3.0), layout="constrained")
    axes = canvas.subplots()
    for k in range(6):
        axes.plot([0, k], label="a name of thirty letters or so " + str(k))
    legend = legend_below(canvas)
    canvas.draw_without_rendering()
    box = legend.get_window_extent()
    assert 0.0 <= box.x0 < box.x1 <= canvas.bbox.width
    assert [text.get_text()[-1] for text in legend.get_texts()] == list("012345")
    assert legend in canvas.legends
    assert len(canvas.legends) == 1


def test_only_swings_too_fast_to_draw_are_ringing() -> None:
    k = np.arange(1000)
    fast, slow = np.where(k % 2, 9.0, 1.0), np.where(k % 100 < 50, 9.0, 1.0)
    rested = np.where(k % 4 < 2, 9.0, 1.0)  # a pulse that rests a sample at either end
    assert rings(fast, FLOW)
    assert rings(rested, FLOW)
    assert not rings(slow, FLOW)
    assert not rings(5.0 + 0.01 * fast, FLOW)  # 0.8 % of the range
    assert not rings(fast, Signal("mode", "-", 1.0, 9.0, values=(1.0, 9.0)))
    half = np.where(k < 500, slow, fast)
    found = too_fast(half, FLOW)
    assert not found[:470].any()
    assert found[530:].all()


def test_a_law_that_rings_hides_no_other_laws_mv() -> None:
    case = CASES["thiosulfate_cstr"]
    k = np.arange(600)
    calm = np.where(k < 300, 200.0, 260.0)
    mvs = {"calm": calm, "ringing": np.where(k % 2, 450.0, 50.0), "beside": calm + 10.0}
    loops = {
        label: {"time_s": 0.5 * k, "sp": np.ones((600, 1)), "pv": np.ones((600, 2)), "mv": mv[:, None]}
        for label, mv in mvs.items()
    }
    panels = LoopPanels(case, "x", loops)
    for label, loop in loops.items():
        panels.add(loop, label, "black")
    canvas = panels.finish(loops["calm"])
    _, shared, own = canvas.axes
    assert own.get_title(loc="right") == "ringing"
    for line, name in zip(shared.lines, ("calm", "beside"), strict=True):
        assert np.array_equal(line.get_ydata(), mvs[name])
    assert np.ptp(np.asarray(own.lines[0].get_ydata(), float)) < 50.0  # the mean of the swings
    (band,) = own.collections
    low, high = band.get_paths()[0].get_extents().intervaly
    assert (low, high) == (50.0, 450.0)
    assert "swings too fast to draw" in canvas.legends[0].get_texts()[-1].get_text()


def test_a_curve_behind_another_one_is_wider() -> None:
    looks = [layer(rank) for rank in range(6)]
    assert all(a["zorder"] > b["zorder"] > 2.0 and a["linewidth"] < b["linewidth"] for a, b in pairwise(looks))


def test_info_of_the_controlled_variable_has_its_unit() -> None:
    case = CASES["jacketed_batch_reactor"]
    assert info_label(case, "wanted_jacket") == "wanted jacket [°C]"
    assert info_label(case, "reached_jacket") == "reached jacket [°C]"
    assert info_label(CASES["thiosulfate_cstr"], "mv_requested") == "requested MV [K]"


def recipe() -> Any:
    n = 200
    told = ("adjusted_reference", "wanted_jacket")
    mode = np.where(np.arange(n) < 90, 1.0, 2.0)
    loop = {
        "time_s": 10.0 * np.arange(n),
        "sp": np.repeat([[60.0], [30.0]], n // 2, axis=0),
        "pv": np.full((n, 2), 45.0),
        "mv": np.column_stack([np.linspace(0, 1, n), mode]),
        "info": np.column_stack([np.full(n, 44.0), np.full(n, 50.0)]),
    }
    info = {name: loop["info"][:, i] for i, name in enumerate(told)}
    return SimpleNamespace(info=lambda curve, scenario, *names: (loop, {name: info[name] for name in names}))


def test_two_references_of_a_recipe_do_not_look_alike() -> None:
    canvas = recipe_picture(Curve("law"), "profile")(recipe())
    core, jacket, *_ = canvas.axes
    lines = {line.get_label(): line for axes in (core, jacket) for line in axes.lines}
    looks = {name: (lines[name].get_color(), lines[name].get_linestyle()) for name in lines}
    assert {"set point", "core", "adjusted reference", "jacket", "wanted jacket"} == set(looks)
    assert len({colour for colour, _ in looks.values()}) == len(looks)
    assert all(axes.get_ylabel() for axes in canvas.axes)


def test_numbers_of_switches_stay_inside_their_panel() -> None:
    def measured(curve: Curve, scenario: str, metric: str) -> float:
        count = 200.0 / (1.0 + 40.0 * float(curve.setting["switch_penalty"]))
        count += 10.0 if scenario == "same_model_noise" else 0.0
        return count if metric == "switches" else 0.006

    evidence: Any = SimpleNamespace(measured=measured)
    canvas = switches_picture(evidence)
    canvas.draw_without_rendering()
    left, right = canvas.axes
    for words in left.texts:
        box = words.get_window_extent()
        assert left.bbox.x0 <= box.x0 < box.x1 <= left.bbox.x1
        assert box.y1 <= left.bbox.y1
    assert right.get_ylim()[1] > 0.006


def test_the_picture_of_a_simulated_run_keeps_words_off_the_curves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = PLANTS["thiosulfate_cstr"]()
    n = 60
    history = loop_picture.History(
        time_s=[0.5 * k for k in range(n)],
        mode=["MANUAL"] * 10 + ["AUTO"] * (n - 10),
        sp=[np.array([0.6])] * n,
        pv=[np.array([0.9 * np.sin(k), 300.0]) for k in range(n)],
        measured=[np.array([0.6, 300.0])] * n,
        mv=[np.array([250.0])] * n,
        reason=[""] * n,
    )
    saved: list[Canvas] = []

    def savefig(canvas: Canvas, *_: Any, **__: Any) -> None:
        canvas.draw_without_rendering()
        saved.append(canvas)

    monkeypatch.setattr(Canvas, "savefig", savefig)
    loop_picture.draw(tmp_path / "x.png", plant, history, "title", {5.0: "AUTO", 5.5: "set point 0.6"})
    (canvas,) = saved
    assert all(axes.get_legend() is None for axes in canvas.axes)
    assert [t.get_text() for t in canvas.legends[0].get_texts()] == ["set point", "controlled variable", "MANUAL"]
    top = canvas.axes[0]
    boxes = [words.get_window_extent() for words in top.texts]
    assert len(boxes) == 2
    assert not boxes[0].overlaps(boxes[1])
    assert all(box.y0 >= top.bbox.y1 for box in boxes)
