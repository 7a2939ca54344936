"""A station and the page's server on a law that operators steer: inputs, history, refusals, Prometheus text."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_loop import Browser, FakeLoop, opened
from operated_page import ModelPlant, served
from plant_servers import RunningLoop
from processes import within

from loopwright.serving import Controller, ControlLoop, LoopError, Mode, Sample
from loopwright.serving.errors import ContractError
from loopwright.serving.in_charge.adapted import AdaptedController
from loopwright.serving.monitor import Monitor
from loopwright.serving.page.foresight import LawForesight
from loopwright.serving.page.prometheus import metrics_text
from loopwright.serving.station.control import ask
from loopwright.serving.station.views import VIEWS, Snapshot, inputs

pytest_plugins = ["small_laws", "operated_files", "operated_laws"]
PLANT = Sample(np.array([300.0, 5.0, 0.5]), np.array([40.0, 0.5]))


@pytest.fixture(scope="module")
def running(operated_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLoop]:
    made = served(operated_file, tmp_path_factory.mktemp("loop"))
    yield made
    made.end()


def loop_of(controller: Controller, **how: Any) -> ControlLoop:
    return ControlLoop(controller, sp=[300.0, 5.0], mv=[40.0, 0.5], mode=Mode.AUTO, **how)


# --------------------------------------------------------------------------------------------------- the last step
def test_the_inputs_of_the_last_step_give_its_mv_again_to_the_bit(operated: Controller) -> None:
    loop = loop_of(operated)
    assert loop.stepped is None
    loop.set_operate({"valve.high": 60.0})
    loop.scan(PLANT)
    command = loop.scan(Sample(np.array([299.0, 5.1, 0.5]), loop.mv, bad_pv=("", "", "bad")))
    assert loop.stepped is not None
    values = loop.stepped.values
    assert set(values) == set(operated.manifest.inputs)
    assert values["fresh"].tolist() == [1.0, 1.0, 0.0]
    again = operated.step(**values)
    assert command.law_mv is not None
    assert again.mv.tolist() == command.law_mv.tolist()


def test_a_host_that_reuses_its_arrays_changes_no_inputs_that_were_kept(operated: Controller) -> None:
    loop, pv = loop_of(operated), np.array([299.0, 5.0, 0.5])
    loop.scan(Sample(pv, np.array([40.0, 0.5])))
    pv[:] = 0.0
    assert loop.stepped is not None
    assert loop.stepped.values["pv"].tolist() == [299.0, 5.0, 0.5]


def test_a_bad_pv_counts_the_time_since_it_was_read(operated: Controller) -> None:
    loop = loop_of(operated, bridge_s=5.0)
    loop.scan(PLANT)
    for _ in range(3):
        loop.scan(Sample(PLANT.pv, np.array([40.0, 0.5]), bad_pv=("bad", "", "")))
    assert loop.stepped is not None
    assert loop.stepped.unread_s.tolist() == [3.0, 0.0, 0.0]
    assert loop.stepped.values["fresh"].tolist() == [0.0, 1.0, 1.0]


def test_another_controller_has_no_inputs_before_its_first_step(
    operated: Controller, otherwise_operated: Controller
) -> None:
    loop = loop_of(operated)
    loop.swap(otherwise_operated, 1)
    while loop.controller is operated:
        loop.scan(PLANT)
    assert loop.stepped is None
    loop.scan(PLANT)
    assert loop.stepped is not None
    assert len(loop.stepped.values["operate"]) == len(otherwise_operated.manifest.operate)


def test_the_history_of_operate_has_each_change_once_and_begins_anew_with_a_controller(
    operated: Controller, otherwise_operated: Controller
) -> None:
    loop = loop_of(operated)
    week = SimpleNamespace(week="2026-W48", counts={})
    watching: Any = SimpleNamespace(monitor=Monitor(operated.manifest, started_s=0.0), weekly=week)
    before: Snapshot | None = None
    for k in range(8):
        if k in {3, 5}:
            loop.set_operate({"valve.high": 90.0 - k})
        stepped = loop.controller
        command = loop.scan(PLANT)
        before = Snapshot.of(loop, watching, (PLANT, command, float(k)), stepped, (0, 0), before)
    assert [at for at, _ in before.operated] == [0.0, 3.0, 5.0]
    assert [of[6] for _, of in before.operated] == [100.0, 87.0, 85.0]
    assert before.stepped_s == 7.0
    refused = loop.miss("no sample")
    before = Snapshot.of(loop, watching, (None, refused, 8.0), loop.controller, (0, 1), before)
    assert before.stepped_s == 7.0  # the law was not stepped


# --------------------------------------------------------------------------------------------------------- requests
def test_the_request_inputs_is_answered_at_the_door(running: RunningLoop) -> None:
    found = ask(running.settings.journal.file, {"do": "inputs"})
    m = running.station.manifest
    assert {name: len(value) for name, value in found["inputs"].items()} == {n: m.sizes()[n] for n in m.inputs}
    assert found["sha256"] == running.station.controller.sha256
    assert found["signals"]["pv"] == [s.name for s in m.pv]
    assert found["time"] <= ask(running.settings.journal.file, {"do": "state"})["time"]
    about = ask(running.settings.journal.file, {"do": "about"})
    assert len(about["operated"][-1][1]) == len(m.operate)


def test_before_the_first_step_there_are_no_inputs() -> None:
    with pytest.raises(LoopError):
        inputs(SimpleNamespace(snapshot=None))  # type: ignore[arg-type]
    assert set(VIEWS) == {"about", "state", "inputs", "future", "courses", "picture"}


@pytest.mark.parametrize(
    ("value", "entry"),
    [
        ({"y0.low": 7.0}, "y0.low"),
        ({"y0.low": 1.0, "y0.high": -1.0}, "y0.low"),
        ({"u0.use": 0.5}, "u0.use"),
        ({"u0.hihg": 0.5}, "u0.hihg"),
        ({"u0.high": "much"}, "u0.high"),
    ],
    ids=str,
)
def test_a_refusal_names_its_entry_apart_from_its_words(running: RunningLoop, value: Any, entry: str) -> None:
    assert running.station.page is not None
    browser = Browser(int(running.station.page.url.rpartition(":")[2]), "a token that is long enough")
    status, said = browser.change({"do": "operate", "value": value, "who": "anna"})
    assert (status, said["entry"]) == (409, entry)
    assert entry in said["error"]
    status, said = browser.change({"do": "mode", "value": "FAST", "who": "anna"})
    assert (status, said.get("entry")) == (409, None)


# ------------------------------------------------------------------------------------------------------- Prometheus
def test_metrics_have_values_uses_and_what_is_bridged(running: RunningLoop) -> None:
    running.does("operate", {"y0.high": 2.5, "u1.use": 0.0})
    ModelPlant.made.bad = ("BadSensorFailure", "")
    try:
        door = running.settings.journal.file
        assert within(20, lambda: list(ask(door, {"do": "state"})["shed"]) == ["y0"])
        about, state = (ask(door, {"do": name}) for name in ("about", "state"))
    finally:
        ModelPlant.made.bad = ()
        running.does("operate", {"y0.high": 3.0, "u1.use": 1.0})
    lines = metrics_text(about, state).splitlines()
    for line in (
        'loopwright_operate{name="y0.high",signal="y0",what="high",unit="m"} 2.5',
        'loopwright_in_use{signal="y0"} 0.0',  # left out
        'loopwright_in_use{signal="y1"} 1.0',
        'loopwright_in_use{signal="u1"} 0.0',  # by an operator
        'loopwright_shed{signal="y0"} 1.0',
        'loopwright_shed{signal="y1"} 0.0',
        'loopwright_bridged{signal="y0"} 0.0',
    ):
        assert line in lines
    families = [line.split()[2] for line in lines if line.startswith("# TYPE")]
    assert len(families) == len(set(families))


def test_metrics_of_a_law_without_operate_have_none_of_it(not_operated: Controller, tmp_path: Path) -> None:
    made = FakeLoop(tmp_path, not_operated)
    try:
        text = metrics_text(made.about, made.state)
    finally:
        made.close()
    assert "operate" not in text
    assert "in_use" not in text
    assert "shed" not in text


# -------------------------------------------------------------------------------------------------------- foresight
def test_without_an_explain_graph_the_page_says_so_and_goes_on(operated: Controller, tmp_path: Path) -> None:
    made = FakeLoop(tmp_path, operated)
    page, browser = opened(made, [])
    try:
        answer = made.answer
        given = {"file": str(tmp_path / "law.onnx"), "sha256": "0", "time": 1.0, "inputs": {}, "signals": {}}
        made.control._server.answer = lambda r: given if r.get("do") == "inputs" else answer(r)
        status, _, body = browser.get("/api/explain")
        assert status == 404
        assert b"law.explain.onnx" in body
        assert browser.get("/api/state")[0] == 200
        made.control._server.answer = lambda r: {"error": "not yet"} if r.get("do") == "inputs" else answer(r)
        assert browser.get("/api/explain")[0] == 404
    finally:
        page.close()
        made.close()


@pytest.mark.parametrize("value", [True, "1", None, float("nan"), [1.0]], ids=str)
def test_a_what_if_of_no_number_is_refused_by_its_name(value: Any) -> None:
    with pytest.raises(ContractError) as refused:
        LawForesight(dict).what_if({"y0.low": value})
    assert refused.value.entry == "y0.low"


def test_an_adapted_controller_keeps_the_inputs_of_the_loop(
    operated: Controller, make_formula: Callable[..., Any]
) -> None:
    """The loop's signals: who computes the step again picks its own by name."""
    adapted = AdaptedController(operated, operated.manifest)
    loop = loop_of(adapted)
    loop.scan(PLANT)
    assert loop.stepped is not None
    assert len(loop.stepped.values["pv"]) == 3
