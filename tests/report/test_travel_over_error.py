"""The picture of what a search tried, error over travel, and its place in the report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import made_up_case as made_up
import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgba

from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import FormAnalysis
from loopwright.pipeline.pictures.drawing import PALETTE, STYLE
from loopwright.pipeline.pictures.tuning_pictures import MOST_DRAWN_ERROR, TravelCurve, TriedPoint, travel_picture
from loopwright.pipeline.report.law_tables import MOST_TRIED, analyses
from loopwright.pipeline.tuning.calm_choice import CALM_COST, calmest

CASE = made_up.THIOSULFATE.case


def tried(n: int, seed: int, *, speed: bool = True) -> tuple[dict[str, float], ...]:
    """Rows of a table, of which one is taken by the rule; faster ones move more and err less, up to noise."""
    rng = np.random.default_rng(seed)
    pace = rng.uniform(0.3, 3.0, n)
    travel, error = pace * rng.uniform(0.8, 1.2, n), (1.0 + 0.3 / pace) * rng.uniform(1.0, 1.4, n)
    error[0] = 3.0 * error.min()  # far from all others
    points = [TriedPoint(float(t), float(e)) for t, e in zip(travel, error, strict=True)]
    taken = calmest(points)
    return tuple(
        {**({"speed": float(s)} if speed else {"kc": float(s)}), "travel": p.travel, "error": p.error, "cost": p.error}
        | {"taken": float(p is taken)}
        for s, p in zip(pace, points, strict=True)
    )


def curve_of(rows: tuple[dict[str, float], ...]) -> TravelCurve:
    return TravelCurve.of(FormAnalysis(table=rows))


def offsets(canvas: Any) -> np.ndarray:
    """All points of the scatters (n, 2), by their travel."""
    found = np.concatenate([np.asarray(c.get_offsets(), float) for c in canvas.axes[0].collections])
    return found[np.argsort(found[:, 0])]


def line(canvas: Any, marker: str) -> np.ndarray:
    (found,) = [row for row in canvas.axes[0].lines if row.get_marker() == marker]
    return np.column_stack([found.get_xdata(), found.get_ydata()])


@given(st.lists(st.tuples(st.floats(0.1, 9.0), st.floats(0.1, 9.0)), min_size=1, max_size=30))
def test_the_calmest_is_within_the_share_of_the_least_error_and_moves_least_there(
    given_points: list[tuple[float, float]],
) -> None:
    points = [TriedPoint(*point) for point in given_points]
    taken, least = calmest(points), min(p.error for p in points)
    assert taken.error <= (1 + CALM_COST) * least
    assert all(p.travel >= taken.travel for p in points if p.error <= (1 + CALM_COST) * least)


@given(st.lists(st.tuples(st.floats(0.1, 9.0), st.floats(0.1, 9.0)), min_size=1, max_size=30))
def test_no_point_betters_one_of_the_edge_and_one_of_the_edge_every_other(points: list[tuple[float, float]]) -> None:
    curve = TravelCurve([TriedPoint(*p) for p in points], 0, None)
    on = [points[i] for i in curve.edge]
    for t, e in points:
        assert not any(t <= a and e <= b and (t, e) != (a, b) for a, b in on)
        assert any(a <= t and b <= e for a, b in on)
    assert curve.least in curve.edge


@pytest.mark.parametrize("speed", [True, False], ids=["predictive", "pid"])
def test_the_picture_has_every_point_the_edge_the_limit_the_least_and_the_taken(speed: bool) -> None:
    rows = tried(30, 4, speed=speed)
    curve = curve_of(rows)
    with mpl.rc_context(STYLE):
        canvas = travel_picture(curve, "made")
    least = min(row["error"] for row in rows)
    wanted = sorted((row["travel"], min(row["error"] / least, MOST_DRAWN_ERROR)) for row in rows)
    np.testing.assert_allclose(offsets(canvas), wanted)
    (taken,) = line(canvas, "o")
    (own,) = [row for row in rows if row["taken"]]
    np.testing.assert_allclose(taken, [own["travel"], own["error"] / least])
    assert taken[1] <= 1 + CALM_COST
    assert line(canvas, "s")[0, 1] == 1.0
    axes = canvas.axes[0]
    (limit,) = [
        row for row in axes.lines if to_rgba(row.get_color()) == to_rgba(PALETTE[0]) and len(row.get_xdata()) == 2
    ]
    assert set(limit.get_ydata()) == {1 + CALM_COST}
    assert "[% of its range a period]" in axes.get_xlabel()
    assert axes.get_ylabel()
    assert len(canvas.axes) == 1 + speed  # the colours of a speed
    assert ("speed" in curve.words("Made")) == speed
    canvas.draw_without_rendering()
    (legend,) = canvas.legends
    assert not legend.get_window_extent().overlaps(axes.get_window_extent())


def test_the_limit_is_in_sight_where_all_numbers_err_alike() -> None:
    alike = TravelCurve([TriedPoint(1.0, 1.0), TriedPoint(2.0, 1.0)], 0, [1.0, 1.0])
    low, high = travel_picture(alike, "made").axes[0].get_ylim()
    assert low < 1 < 1 + CALM_COST < high


def test_a_table_without_travel_or_without_what_was_taken_has_no_picture() -> None:
    rows = tried(5, 1)
    for lacking in ("travel", "error", "taken"):
        with pytest.raises(NotMeasuredError):
            curve_of(tuple({k: v for k, v in row.items() if k != lacking} for row in rows))
    with pytest.raises(NotMeasuredError):
        curve_of(tuple(row | {"taken": 0.0} for row in rows))
    with pytest.raises(NotMeasuredError):
        TravelCurve.of(None)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A case whose law inc has a search of few numbers, and pid one of many."""
    folder = tmp_path_factory.mktemp("searched")
    made_up.write_case(folder)
    for law, rows in (("inc", tried(9, 7)), ("pid", tried(MOST_TRIED + 30, 8, speed=False))):
        path = folder / "work" / CASE / "validation" / law / "metrics.json"
        metrics = json.loads(path.read_text())
        cheapest_first = sorted(rows, key=lambda row: row["cost"])
        metrics["forms"]["base"]["analysis"] = {"figures": {}, "notes": [], "table": cheapest_first}
        path.write_text(json.dumps(metrics))
    return folder


@pytest.fixture(scope="module")
def evidence(root: Path) -> Evidence:
    mini = made_up.THIOSULFATE
    folders = (root / "work" / CASE, root / "timing" / CASE)
    return Evidence.load(mini.of, made_up.bounds(mini), *folders, tuple(mini.quality))


def test_both_pages_show_the_picture_of_each_searched_law_with_words_for_who_sees_none(
    evidence: Evidence, tmp_path: Path
) -> None:
    made_up.report(evidence, tmp_path)
    html, text = ((tmp_path / f"report.{kind}").read_text() for kind in ("html", "md"))
    searched = [law for law, found in evidence.laws.items() if found.analyses]
    assert set(searched) == {"inc", "pid"}
    for law in evidence.laws:
        name = f"figures/tuning_{law}.png"
        assert (tmp_path / name).exists() == (law in searched)
        assert (f'<img src="{name}" alt="' in html) == (law in searched)
        assert (f"]({name})" in text) == (law in searched)
    assert 'alt=""' not in html


def test_a_long_table_of_what_was_tried_keeps_the_cheapest_and_the_taken(evidence: Evidence) -> None:
    of = {table["law"]: table for table in analyses(evidence)}
    assert (len(of["inc"]["tried"]), of["inc"]["tried_count"]) == (9, 9)
    rows = of["pid"]["tried"]
    assert len(rows) in (MOST_TRIED, MOST_TRIED + 1)
    assert of["pid"]["tried_count"] == MOST_TRIED + 30
    for table in of.values():
        assert sum(row["taken"] for row in table["tried"]) == 1
        assert all(len(row["values"]) == len(table["columns"]) for row in table["tried"])
        assert "taken" not in table["columns"]
