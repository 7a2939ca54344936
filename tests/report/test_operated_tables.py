"""Laws that operators steer: what is required of them, their tables and pictures, and reports without such a law."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from own_cases import controllers_of_a_lag

from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import BASE, Form, LawEvidence, LawMetrics, OverSeeds
from loopwright.pipeline.evaluation.leaderboard import CaseStanding
from loopwright.pipeline.evaluation.operated import (
    LEAST_BORNE,
    LEAST_GAIN,
    MOST_OUTSIDE,
    MOST_REST_MISS,
    ErrorResult,
    MvResult,
    OperatedLimits,
    OperatedLoop,
    OperatedResult,
    RangeResult,
    summary_of,
)
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.evaluation.verdicts import PLAIN
from loopwright.pipeline.pictures.operated_pictures import operated_picture
from loopwright.pipeline.report.operated_tables import HASTY_TRAVEL, operated_rows, operated_tables
from loopwright.pipeline.report.page import write_report
from loopwright.pipeline.report.verdicts import judge, validation
from loopwright.pipeline.tracking.card import version_description
from loopwright.pipeline.tracking.gate import Gate
from loopwright.pipeline.tracking.notes import headline

RANGE = RangeResult("y0", "m", -0.5, 0.5, 3.0, 0.1, 0.02, 0.01, 0.3, 0.01, 0.0)
MV = MvResult("u0", "V", 1.5, 0.75, 0.0)
N = 60


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def result(
    *ranges: RangeResult, mv: MvResult = MV, limits: OperatedLimits | None = None, **figures: object
) -> OperatedResult:
    loop = OperatedLoop(60.0, 42.0, ranges, (mv,), **figures)  # type: ignore[arg-type]
    return OperatedResult("A night", (loop,), limits or OperatedLimits())


def evidence(tests: dict[str, OperatedResult]) -> Evidence:
    rows = {test: {"mae": 0.1, "max_asse": 0.0} for test in ("held_out", "held_out_noise", "load", "spoilt")}
    form = Form({}, (), {test: OverSeeds(row, row, row, {"0": row}) for test, row in rows.items()})
    metrics = LawMetrics("predictive", "Predictive", "mae", (0,), 0, {BASE: form}, development={"0": 0.1},
                         development_travel={"0": 1.0}, operated=tests)  # fmt: skip
    bounds = {test: {"nmpc": {"mae": 0.08}} for test in rows}
    laws = {"predictive": LawEvidence(metrics, Path("trajectories.npz"))}
    return Evidence(controllers_of_a_lag({}), bounds, laws, {}, own_data=True)


def judged(tests: dict[str, OperatedResult]) -> dict[str, bool | None]:
    """Whether each row holds, by its limit."""
    rows = list(operated_rows(evidence(tests)))
    assert all(row.because for row in rows if not row.holds and "taken out" not in row.what)
    return {row.limit.removeprefix("≤ ").removeprefix("≥ "): row.holds for row in rows}


@pytest.mark.parametrize("over", [False, True])
def test_each_figure_is_judged_by_its_limit(over: bool) -> None:
    sign = 1 if over else -1
    mv = replace(MV, moved_out=1e-3 if over else 0.0, rest=0.0, miss=0.1, miss_share=MOST_REST_MISS * (1 + 0.1 * sign))
    tests = {
        "night": result(
            replace(RANGE, late=MOST_OUTSIDE * (1 + 0.1 * sign)),
            mv=mv,
            profit=LEAST_GAIN * (1 - 0.05 * sign),
            before=0.0,
            optimum=1.0,
            gain=LEAST_GAIN * (1 - 0.05 * sign),
            borne=LEAST_BORNE * (1 - 0.005 * sign),
            errors=(ErrorResult("y0", "m", 0.1, 0.03 if over else 0.01),),
        )
    }
    found = judged(tests)
    assert len(found) == 6
    assert set(found.values()) == {not over}


def test_a_range_that_no_steady_state_keeps_is_not_asked_for() -> None:
    lost = replace(RANGE, late=1.0, least=0.4)
    assert judged({"night": result(lost)}) == {}
    assert set(judged({"night": result(lost, RANGE)}).values()) == {True}


def test_a_test_with_limits_of_its_own_has_its_own_row() -> None:
    half = replace(RANGE, late=0.5)
    tests = {"night": result(half, limits=OperatedLimits(most_outside=0.6)), "narrowed": result(RANGE)}
    assert judged(tests) == {"5 % of the time": True, "60 % of the time": True}
    assert judged(tests | {"narrowed": result(half)}) == {"5 % of the time": False, "60 % of the time": True}


@pytest.mark.parametrize(
    ("mv", "named"),
    [
        (replace(MV, travel_share=HASTY_TRAVEL + 1), "speed"),
        (replace(MV, clamped=0.5), "u0 stood at an operator's limit for 50 %"),
        (MV, "0.3 m outside"),
    ],
)
def test_the_remedy_names_what_stands_in_the_way(mv: MvResult, named: str) -> None:
    (row,) = operated_rows(evidence({"night": result(replace(RANGE, late=0.5), mv=replace(mv, moved_out=None))}))
    assert row.holds is False
    assert named in row.because


def test_profits_of_several_loops_are_put_together_by_their_sums() -> None:
    """9 of 10, and 1 of 2: 10 of 12, not the mean of the shares."""
    loops = [result(profit=p, before=0.0, optimum=b, gain=p / b).loops[0] for p, b in ((9.0, 10.0), (1.0, 2.0))]
    both = OperatedResult("Costs", tuple(loops))
    assert both.gain == pytest.approx(10 / 12)
    assert both.mean("profit") == pytest.approx(5.0)
    assert summary_of({"costs": both, "night": result(replace(RANGE, late=0.3))}) == {
        "gain": pytest.approx(10 / 12),
        "outside_late": 0.3,
    }


def test_metrics_keep_what_was_measured_and_a_law_without_has_no_entry() -> None:
    tests = {"night": result(RANGE, profit=1.0, before=0.0, optimum=2.0, gain=0.5)}
    for given in (tests, {}):
        metrics = evidence(given).laws["predictive"].metrics
        metrics.write(Path("metrics.json"))
        assert ("operated" in Path("metrics.json").read_text()) == bool(given)
        assert LawMetrics.read(Path("metrics.json")) == metrics


def write_loop(test: str) -> None:
    """A loop of a test beside the law's trajectories: y0 leaves its range for ten samples."""
    one, y = np.ones((N, 1)), np.zeros((N, 1))
    y[20:30] = 0.8
    arrays = {
        "time_s": np.arange(N, dtype=float), "sp": 0 * one, "pv": y, "mv": 0.1 * one, "low": -0.5 * one,
        "high": 0.5 * one, "use": one, "track": 0 * one, "mv_low": -0.4 * one, "mv_high": one, "out": (y > 0) * one,
        "rest": 0.2 * one,
    }  # fmt: skip
    np.savez(Path("operated.npz"), **{f"{test}/{name}": values for name, values in arrays.items()})


def test_a_picture_has_the_range_as_a_band_and_the_time_outside_shaded() -> None:
    found = evidence({"night": result(RANGE)})
    write_loop("night")
    with mpl.rc_context():
        canvas, words = operated_picture(found, "predictive", "night")
    pv, mv = canvas.axes
    shaded = [patch for patch in pv.patches if patch.get_width() == pytest.approx(10.0)]
    assert len(shaded) == 1
    assert shaded[0].get_x() == pytest.approx(20.0)
    (band,) = pv.collections
    ends = band.get_paths()[0].vertices[:, 1]
    assert (ends.min(), ends.max()) == (-0.5, 0.5)
    assert len(mv.collections) == 2  # operators' limits, and the time out of use
    assert words == ""


def test_the_report_has_a_section_of_such_a_law_alone() -> None:
    write_loop("night")
    pages = []
    for tests in ({"night": result(RANGE, profit=-5.0, before=-9.0, optimum=-4.0, gain=0.8)}, {}):
        found, out = evidence(tests), Path("out") / str(bool(tests))
        write_report(found, PLAIN, (), out)
        pages.append({name: (out / name).read_text(encoding="utf-8") for name in ("report.html", "report.md")})
        assert (out / "figures" / "operated_predictive_night.png").exists() == bool(tests)
    for name in ("report.html", "report.md"):
        assert "A night" in pages[0][name]
        assert "operated_predictive_night.png" in pages[0][name]
        assert "Operators" in pages[0][name]
        assert "Operators" not in pages[1][name]
        assert "A night" not in pages[1][name]
    (section,) = operated_tables(evidence({"night": result(RANGE)}), {})
    assert section["tests"][0]["ranges"][0][2:4] == ("10", "2")


def test_leaderboard_and_tracking_have_the_same_figures() -> None:
    tests = {"night": result(RANGE, profit=-5.0, before=-9.0, optimum=-4.0, gain=0.8)}
    found = evidence(tests)
    written = validation(found, judge(found, PLAIN))
    Path("validation.json").write_text(written.to_json())
    again = Validation.read(Path("validation.json"))
    assert again.laws["predictive"].operated == tests
    (law,) = CaseStanding.of(again, Path()).laws
    assert "2 %" in law.operated
    assert "80 %" in law.operated
    metrics = found.laws["predictive"].metrics
    metrics.write(Path("metrics.json"))
    points = headline("validate", json.loads(Path("metrics.json").read_text()), again)
    assert points["operated/night/outside_late"] == pytest.approx(0.02)
    assert points["operated/night/gain"] == pytest.approx(0.8)


def test_the_registry_shows_the_picture_of_the_test_that_ends_outside_its_ranges_longest() -> None:
    tests = {
        "night": result(RANGE),
        "day": result(replace(RANGE, late=0.5)),
        "undrawn": result(replace(RANGE, late=0.9)),
    }
    found = evidence(tests)
    tree = validation(found, judge(found, PLAIN))
    drawn = {name: f"operated/operated_predictive_{name}.png" for name in ("night", "day")}
    gate = Gate.of(tree, "predictive")
    card = version_description(tree, gate, "run", "closed_loop.png", operated=drawn)
    assert re.findall(r"path=([\w/.]+)", card) == ["closed_loop.png", drawn["day"]]
    assert re.findall(r"path=([\w/.]+)", version_description(tree, gate, "run", "closed_loop.png")) == [
        "closed_loop.png"
    ]
