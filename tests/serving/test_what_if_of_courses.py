"""What a law would do with known set points and forecasts, before they are given: the figure, refusals, the page."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_loop import Browser
from identified_models import random_model
from operated_page import TOKEN, served
from plant_servers import RunningLoop
from predictive_loops import law_of
from processes import within

from loopwright.pipeline.export.explain_graph import export_explanation
from loopwright.pipeline.export.gate import export
from loopwright.serving import ContractError, Controller, ControlLoop, LoopError, Mode, Sample
from loopwright.serving.explain import Explainer
from loopwright.serving.explain import explainer as explained
from loopwright.serving.explain.explain_file import explain_path
from loopwright.serving.explain.explainer import MOST_SAMPLES
from loopwright.serving.station.control import ask

MODEL = random_model(3, n_y=2, n_mv=2, n_dv=1)
N = 20  # samples of the horizon, a second each
SLACK = 0.05  # of what moves, by which what-if may be off
RECIPE = {"y0": [(4, 0.3), (30, -0.1)], "d0": [(0, 0.0), (10, 0.0), (14, 0.3), (60, 0.3)]}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A law that operators steer and that reads what is to come, with its explain graph."""
    path = tmp_path_factory.mktemp("recipe") / "law.onnx"
    law = law_of(MODEL, horizon=N, operate={}, preview="course")
    export(law, path, case="made", provenance={})
    export_explanation(law, path)
    return path


@pytest.fixture(scope="module")
def explainer(file: Path) -> Explainer:
    return Explainer(explain_path(file))


@pytest.fixture(scope="module")
def running(file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLoop]:
    made = served(file, tmp_path_factory.mktemp("loop"))
    yield made
    made.end()


@pytest.fixture
def browser(running: RunningLoop) -> Browser:
    assert running.station.page is not None
    made = Browser(int(running.station.page.url.rpartition(":")[2]), TOKEN)
    assert within(20, lambda: made.json("/api/state").get("mode") == "AUTO")
    assert within(20, lambda: made.get("/api/explain")[0] == 200)
    return made


class OnModel:
    """A loop on the law's own model, which begins at rest; the disturbance does what is forecast."""

    def __init__(self, controller: Controller, scans: int = 0) -> None:
        self.x, self.dv, mv = torch.zeros(MODEL.n_x).double(), np.zeros(1), np.array([0.1, -0.1])
        for _ in range(300):
            self.x = MODEL(torch.cat([self.x, torch.from_numpy(mv), torch.from_numpy(self.dv)])).detach()
        self.sp = MODEL.measured(self.x).detach().numpy().copy()
        self.loop = ControlLoop(controller, sp=self.sp, mv=mv, mode=Mode.AUTO)
        for _ in range(scans):
            self.scan()

    def scan(self) -> tuple[np.ndarray, dict[str, Any]]:
        """The readings and MVs after a scan (4,), and the inputs of its step."""
        command = self.loop.scan(Sample(MODEL.measured(self.x).detach().numpy(), self.loop.mv, self.dv.copy()))
        assert not command.fault
        self.x = MODEL(torch.cat([self.x, torch.from_numpy(command.mv), torch.from_numpy(self.dv)])).detach()
        assert self.loop.stepped is not None
        known = self.loop.stepped.values.get("ahead")
        self.dv = self.dv + (0.0 if known is None else known.reshape(N, 3)[0, 2])
        return np.concatenate([MODEL.measured(self.x).detach().numpy(), command.mv]), dict(self.loop.stepped.values)


@pytest.mark.parametrize("straight", [(), ("y0",)])
@pytest.mark.parametrize("standing", [{}, {"y1": [(3, 0.2), (25, -0.2)], "y0": [(2, 0.1)]}], ids=["none", "stands"])
def test_what_if_of_a_course_is_what_then_happens_on_the_model(
    explainer: Explainer, straight: tuple[str, ...], standing: dict[str, Any]
) -> None:
    """Both the loop that is given the course and the one that is not, over twice the law's horizon and more."""
    as_it_is, given = (OnModel(explainer.controller, scans=60) for _ in range(2))
    for plant in (as_it_is, given):
        if standing:
            plant.loop.set_course(standing)
    given.loop.set_course(RECIPE, straight)
    courses = as_it_is.loop.courses
    ahead = courses.ahead(explainer.manifest, as_it_is.loop.sp, as_it_is.dv, 120)
    rest = np.concatenate([as_it_is.sp, as_it_is.loop.mv])
    begin, inputs = as_it_is.scan()
    happened = [[begin, *(as_it_is.scan()[0] for _ in range(79))], [given.scan()[0] for _ in range(80)]]
    found = explainer.what_if({}, **{**inputs, "ahead": ahead}, course=RECIPE, straight=straight)
    assert len(found.after.course("y0").values) == 80  # until the last point, and a horizon more
    for of, rows in zip((found.before, found.after), happened, strict=True):
        real = np.array(rows).T
        span = np.abs(np.array(happened) - rest).max()
        for course, values in zip(of.courses, real, strict=True):
            assert np.abs(np.array(course.values) - values).max() <= SLACK * span
    apart = np.abs(np.array(happened[1]) - np.array(happened[0])).max(axis=0)
    assert apart.min() > 0.03  # the course moves each of them


def test_a_course_to_come_moves_the_mvs_before_it_comes(explainer: Explainer) -> None:
    _, inputs = OnModel(explainer.controller, scans=60).scan()
    found = explainer.what_if({}, **inputs, course={"y0": [(6, 0.4)]})
    before, after = (np.array(of.course("y0").values) for of in (found.before, found.after))
    assert np.abs(after - before)[:4].max() > 0.01
    assert after[-1] == pytest.approx(0.4, abs=0.02)


def test_the_end_of_a_course_is_looked_at_too(explainer: Explainer) -> None:
    plant = OnModel(explainer.controller, scans=60)
    plant.loop.set_course({"y0": [(6, 0.4)]})
    _, inputs = plant.scan()
    found = explainer.what_if({}, **inputs, ended=["y0"])
    assert found.before.course("y0").values[-1] == pytest.approx(0.4, abs=0.02)
    assert np.abs(found.after.course("y0").values - plant.sp[0]).max() < 1e-3
    assert found.after == explainer.what_if({"y0": plant.sp[0]}, **inputs).after  # a set point ends it


def test_the_samples_of_a_far_course_are_bounded(explainer: Explainer, monkeypatch: pytest.MonkeyPatch) -> None:
    _, inputs = OnModel(explainer.controller).scan()
    monkeypatch.setattr(explained, "MOST_SAMPLES", 30)
    found = explainer.what_if({}, **inputs, course={"y0": [(1e6, 0.4)]})
    assert len(found.after.course("y0").values) == 30 < MOST_SAMPLES


@pytest.mark.parametrize(
    ("how", "entry"),
    [
        ({"course": {"y0": [(5, 99.0)]}}, "y0.1"),
        ({"course": {"y0": [(5, 0.1), (4, 0.1)]}}, "y0.2"),
        ({"course": {"y9": [(5, 0.1)]}}, ""),
        ({"course": {"y0": [(5, 0.1)]}, "straight": ["y1"]}, ""),
        ({"straight": ["y1"]}, ""),
    ],
)
def test_a_wrong_course_is_refused_as_the_loop_refuses_it(
    explainer: Explainer, how: dict[str, Any], entry: str
) -> None:
    _, inputs = OnModel(explainer.controller).scan()
    with pytest.raises(LoopError) as refused:
        explainer.what_if({}, **inputs, **how)
    assert refused.value.entry == entry


@pytest.mark.parametrize("ahead", [[0.0] * 61, [0.0] * 57, [[0.0, 0.0, 0.0]] * 20, "soon"], ids=str)
def test_what_is_known_must_be_of_whole_samples(explainer: Explainer, ahead: Any) -> None:
    _, inputs = OnModel(explainer.controller).scan()
    with pytest.raises(ContractError, match="ahead"):
        explainer.what_if({}, **{**inputs, "ahead": ahead})


def test_wrong_inputs_are_refused_before_a_course_is_made_of_them(explainer: Explainer) -> None:
    _, inputs = OnModel(explainer.controller).scan()
    with pytest.raises(ContractError, match="dv"):
        explainer.what_if({}, **{**inputs, "dv": [0.0, 0.0]}, course={"d0": [(5, 0.1)]})


# ------------------------------------------------------------------------------------------------------------ the page
def looked(browser: Browser, **body: Any) -> tuple[int, Any]:
    """The answer to a what-if, which needs no token."""
    own = {"Content-Type": "application/json", "Origin": f"http://127.0.0.1:{browser.port}"}
    status, _, answer = browser.send("POST", "/api/what-if", json.dumps(body).encode(), own)
    return status, json.loads(answer)


def values(found: Any, when: str, signal: str) -> np.ndarray:
    return np.array(next(c["values"] for c in found[when]["courses"] if c["signal"] == signal))


def test_the_page_looks_at_a_course_beside_those_that_stand(browser: Browser, running: RunningLoop) -> None:
    status, found = looked(browser, course={"points": {"y0": [[6, 0.4]]}, "straight": ["y0"]})
    assert status == 200
    assert abs(values(found, "after", "y0")[-1] - 0.4) < abs(values(found, "before", "y0")[-1] - 0.4) / 4
    assert found["after"]["moves"]
    _, filed = looked(browser, course={"csv": "time,y0\n6,0.4\n", "straight": ["y0"]})
    np.testing.assert_allclose(values(filed, "after", "y0")[-1], values(found, "after", "y0")[-1], atol=0.02)
    assert running.station.loop is not None
    assert not running.station.loop.courses.standing  # nothing is given
    running.does("course", {"points": {"y1": [[0, 0.0], [300, 0.3]]}, "straight": ["y1"]})
    assert within(20, lambda: "y1" in browser.json("/api/state")["courses"])
    _, beside = looked(browser, course={"points": {"y0": [[60, 0.4]]}})
    rising = [values(beside, when, "y1") for when in ("before", "after")]
    assert len(rising[0]) == 60 + N
    for of in rising:
        assert 0.02 < of[-1] - of[0] < 0.3  # the ramp that stands goes on beyond the law's horizon, in both
    _, ended = looked(browser, course={"end": ["y1"]})
    assert abs(values(ended, "after", "y1")[-1] - values(ended, "before", "y1")[-1]) > 0.005
    assert "y1" in running.station.loop.courses.standing
    running.does("course", None)


@pytest.mark.parametrize(
    ("body", "status", "entry"),
    [
        ({"course": {"points": {"y0": [[6, 99.0]]}}}, 409, "y0.1"),
        ({"course": {"csv": "time,y0\nsoon,0.4\n"}}, 409, "csv"),
        ({"course": {"csv": "time,y0\n6,99\n"}}, 409, "csv"),
        ({"course": {"points": {"y9": [[6, 0.4]]}}}, 409, None),
        ({"course": 5}, 409, None),
        ({"course": None}, 400, None),
        ({"changes": {}}, 400, None),
        ({"changes": {}, "cuorse": {}}, 400, None),
    ],
    ids=str,
)
def test_the_page_refuses_what_the_loop_would_refuse(
    browser: Browser, body: dict[str, Any], status: int, entry: str | None
) -> None:
    got, said = looked(browser, **body)
    assert (got, said.get("entry")) == (status, entry)
    assert "\n" not in said["error"]


def test_the_loop_tells_the_courses_that_stand_in_seconds_from_its_last_step(
    browser: Browser, running: RunningLoop
) -> None:
    running.does("course", {"points": {"y0": [[100, 0.1], [500, 0.2]]}})
    assert within(20, lambda: "y0" in browser.json("/api/state")["courses"])
    door = running.settings.journal.file
    found = ask(door, {"do": "future"})
    assert set(found) == {*ask(door, {"do": "inputs"}), "courses"}
    (course,) = found["courses"]
    (first, _), (last, at) = course["points"]
    assert 0 < first <= 100
    assert (last - first, at) == (400.0, 0.2)
    running.does("course", None)
