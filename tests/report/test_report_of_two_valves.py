"""The report of a case with a discrete MV, a reference to follow, own figures, and laws that have an analysis."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import made_up_case as made_up
import numpy as np
import pytest
from made_up_case import Miniature
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.cases.jacketed_batch_reactor.plant import JacketedBatchReactor
from loopwright.pipeline.errors import ReportError
from loopwright.pipeline.evaluation.case import Array, Case, Requirement
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import FormAnalysis
from loopwright.pipeline.evaluation.metric import Metric
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.evaluation.verdicts import PLAIN
from loopwright.pipeline.pictures.drawing import CasePicture
from loopwright.pipeline.pictures.loop_pictures import overview_picture
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.report.figures import draw_all
from loopwright.pipeline.report.page import headline, write_report
from loopwright.pipeline.report.verdicts import requirement
from loopwright.pipeline.simulation.scenario import Scenario, held
from loopwright.pipeline.tracking.card import version_description
from loopwright.pipeline.tracking.gate import Gate

HOLD = 20
ANALYSIS = {
    "base": {"figures": {"radius": 0.91, "pairs_proved": 7.0}, "notes": ["Stable around each point.", "Not proved."]},
    "gain=2": {"figures": {"radius": 1.02}, "notes": ["Stable around each point."]},
}


@dataclass(frozen=True)
class TwoValves(Case):
    """Two levels of the core, and the same from other random numbers; only the first is bounded."""

    held_out_seeds: tuple[int, ...] = (9001,)
    name: ClassVar[str] = "two_valves"
    title: ClassVar[str] = "A reactor with two valves"
    plant_class: ClassVar[type[EquationPlant]] = JacketedBatchReactor
    development_seeds: ClassVar[tuple[int, ...]] = (1,)
    noise: ClassVar[Mapping[str, float]] = {"T": 0.05, "T_w": 0.1}
    gate: ClassVar[Mapping[str, float]] = {"levels": 1.0}
    metric: ClassVar[str] = "tracking"
    own_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("switches", "switches of the mode"),
        Metric("radius", "spectral radius"),
        Metric("colour", "nothing has this"),
    )

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        x0, mv0 = self.plant.start
        sp = held([60.0, 30.0], HOLD)
        first = Scenario("levels", "Two levels", sp, x0, mv0, hold=HOLD, reference=0.5 * (sp + 20.0))
        others = tuple(replace(first, name="other", title="Other plants", seed=seed) for seed in (1, 2, 3))
        return {"levels": (first,), "other": others}

    def development(self) -> tuple[Scenario, ...]:
        return self.scenarios()["levels"]


class TwoValvesMade(Miniature):
    """The miniature of a case that only this file knows."""

    @cached_property
    def of(self) -> Case:
        return TwoValves()


MINI = TwoValvesMade(
    "two_valves",
    {"pid": 2.0, "fuzzy": 1.2},
    {"levels": 0.5, "other": 0.7},
    {"fuzzy": {"gain": 1.0}},
    {"fuzzy": {"gain=2": {"gain": 2.0}}},
)


def load(root: Path) -> Evidence:
    bounds = {"levels": made_up.bounds(MINI)["levels"]}  # of the other plants nobody knows the bound
    return Evidence.load(MINI.of, bounds, root / "work" / MINI.case, root / "timing" / MINI.case, tuple(MINI.quality))


def tell(root: Path, law: str, **figures: float) -> None:
    """Let a law tell of its analysis, and its tests of more figures."""
    path = root / "work" / MINI.case / "validation" / law / "metrics.json"
    metrics = json.loads(path.read_text())
    for form, analysis in ANALYSIS.items():
        metrics["forms"][form]["analysis"] = analysis
    for block in metrics["forms"]["base"]["tests"].values():
        for how in ("median", "min", "max"):
            block[how] |= figures
    path.write_text(json.dumps(metrics))


def draw(evidence: Evidence) -> Canvas:
    canvas = Canvas()
    canvas.subplots().plot([0, len(evidence.laws)])
    return canvas


def draw_nothing(evidence: Evidence) -> Canvas:
    raise NotMeasuredError


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("two_valves")
    for law, quality in MINI.quality.items():
        made_up.write_validation(folder, law, quality, mini=MINI)
    tell(folder, "fuzzy", switches=4.0)
    return folder


@pytest.fixture(scope="module")
def out(root: Path) -> Path:
    folder = root / "artifacts" / MINI.case
    pictures = (CasePicture("basin", "Where every start ends", draw), CasePicture("none", "Nothing", draw_nothing))
    write_report(load(root), PLAIN, pictures, folder)
    return folder


def test_every_mv_has_its_panel_and_a_discrete_one_its_allowed_values(root: Path) -> None:
    evidence = load(root)
    canvas = overview_picture(evidence, "fuzzy")
    cv, throttle, mode = canvas.axes
    assert [axes.get_ylabel() for axes in canvas.axes] == ["$T$ [°C]", "$k_{M}$", "mode"]
    assert mode.get_yticks().tolist() == [1.0, 2.0]
    low, high = mode.get_ylim()
    assert low < 1.0 < 2.0 < high
    loop = evidence.laws["fuzzy"].loop("levels", {})
    assert loop is not None
    (mine,) = [line for line in mode.lines if line.get_zorder() == 4.0]
    assert np.array_equal(mine.get_ydata(), loop["mv"][:, 1])
    assert mine.get_drawstyle() == "steps-post"
    heights = throttle.get_gridspec().get_height_ratios()
    assert heights[2] < heights[1] / 2  # a narrow strip
    reference = next(line for line in cv.lines if line.get_label() == "reference")
    assert np.allclose(np.asarray(reference.get_ydata(), float), MINI.tests["levels"].reference[:, 0])


def test_pages_show_analysis_own_figures_and_own_pictures(out: Path) -> None:
    html, text = (out / "report.html").read_text(), (out / "report.md").read_text()
    for shown in (html, text):
        for words in (
            "RMS distance from the reference model",
            "Analysis of the laws",
            "spectral radius",
            "pairs proved",
            "0.91",
            "1.02",
            "switches of the mode",
            "Other plants, 3 draws",
            "MV travel, all MVs together",
            "Where every start ends",
            "figures/basin.png",
        ):
            assert words in shown, words
        assert shown.count("Stable around each point.") == 1  # both forms say it
        assert "None" not in shown
        assert "nothing has this" not in shown
        assert "figures/none.png" not in shown
    ids = set(re.findall(r'id="([^"]+)"', html))
    assert set(re.findall(r'href="#([^"]+)"', html)) <= ids  # no tables, no models: no links to them
    assert "<b>as shipped:</b> Not proved." in html
    assert "**as shipped:** Not proved." in text
    assert (out / "figures" / "basin.png").exists()
    for table in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE):
        assert len({row.count("|") - row.count("\\|") for row in table.splitlines()}) == 1, table


def test_where_some_tests_have_no_bound_the_others_keep_theirs(root: Path, out: Path) -> None:
    evidence = load(root)
    assert evidence.best == "fuzzy"
    assert evidence.ratio("fuzzy", "levels") == pytest.approx(1.2)
    assert evidence.ratio("fuzzy", "other") is None
    assert headline(evidence)[0] == ("1.20", "× tracking RMS of the perfect-model NMPC on levels")
    tree = json.loads((out / "validation.json").read_text())
    assert tree["gate"]["laws"]["fuzzy"]["score"] == pytest.approx(1.2)
    assert set(tree["bounds"]) == {"levels"}
    assert "This case has no bounds" not in (out / "report.html").read_text()
    unbounded = replace(evidence, bounds={})
    made_up.report(unbounded, root / "unbounded")
    assert "This case has no bounds" in (root / "unbounded" / "report.html").read_text()


def test_programs_get_the_analysis_and_the_verdicts(out: Path) -> None:
    tree = json.loads((out / "validation.json").read_text())
    assert tree["laws"]["fuzzy"]["analysis"] == ANALYSIS
    assert "analysis" not in tree["laws"]["pid"]
    assert tree["laws"]["pid"]["step_us"] == 25.0
    assert tree["main"] == "levels"
    assert tree["titles"]["metric_short"] == "tracking RMS"
    row = next(row for row in tree["requirements"] if row["what"].startswith("best controller, lock-ups"))
    assert (row["limit"], row["measured"], row["holds"]) == ("0", "0", True)
    assert tree["claims"] == tree["paper"] == []


def test_the_registry_tells_of_the_analysis(out: Path) -> None:
    tree = Validation.read(out / "validation.json")
    card = version_description(tree, Gate.of(tree, "fuzzy"), "run", None)
    for words in ("spectral radius", "0.91", "pairs proved", "<li>Not proved.</li>"):
        assert words in card, words
    assert "1.02" not in card  # of a variant, which is not in the registry
    assert "Analysis" not in version_description(tree, Gate.of(tree, "pid"), "run", None)


def test_a_case_names_its_figures(root: Path) -> None:
    assert TwoValves((9,)).label("switches") == "switches of the mode"
    assert TwoValves((9,)).label("tracking") == "tracking RMS [°C]"
    assert TwoValves((9,)).label("nrmse_free.run") == "nrmse free"
    evidence = load(root)
    row = requirement(Requirement("fuzzy", "levels", "switches", 3.0), evidence)
    assert (row.limit, row.measured, row.holds) == ("switches of the mode ≤ 3", "4", False)


def test_a_picture_does_not_overwrite_another(root: Path, tmp_path: Path) -> None:
    twice = CasePicture("closed_loop_pid", "x", draw)
    with pytest.raises(ReportError, match=r"'closed_loop_pid'.*give another name"):
        draw_all(load(root), tmp_path / "figures", (twice,))


def test_arrays_of_an_analysis_belong_to_a_form(root: Path) -> None:
    law = load(root).laws["fuzzy"]
    rows: dict[str, Array] = {"base/radius": np.ones(3), "gain=2/radius": np.zeros(2)}
    np.savez_compressed(law.trajectories.with_name("analysis.npz"), **rows)
    assert law.analysis_arrays({})["radius"].tolist() == [1.0, 1.0, 1.0]
    assert law.analysis_arrays({"gain": 2})["radius"].tolist() == [0.0, 0.0]
    assert law.analysis_arrays({"gain": 3}) == {}
    assert law.analyses["gain=2"] == FormAnalysis({"radius": 1.02}, ("Stable around each point.",))
    assert law.form({"gain": 3}) is None
