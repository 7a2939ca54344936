"""A loop on a real OPC UA server goes on without one sensor, and its plant's own operator moves limits by nodes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from asyncua import ua
from operated_law import Given
from plant_servers import RunningLoop
from processes import within
from written_nodes import SPACE, WrittenNodes, loop_settings, written_nodes

from loopwright.pipeline.__main__ import main
from loopwright.serving import Controller, Mode
from loopwright.serving.journal import JournalReader
from loopwright.serving.opcua.inspection import inspected
from loopwright.serving.opcua.settings import AnalyserNode
from loopwright.serving.station.settings import Bridge, Settings

pytest_plugins = ["small_laws", "operated_files"]


@pytest.fixture
def nodes(request: pytest.FixtureRequest) -> Iterator[WrittenNodes]:
    with written_nodes(getattr(request, "param", None)) as made:
        yield made


def settings_of(
    nodes: WrittenNodes, controller: Controller, folder: Path, analysers: Any = None, **changed: Any
) -> Settings:
    known = {e.name for e in controller.manifest.operate}
    operate = {n: SPACE + n.split(".")[1] for n in ("valve.high", "valve.use") if n in known}
    return loop_settings(nodes, controller, folder, {"operate": operate, "analysers": analysers or {}}, **changed)


def test_one_sensor_stops_no_loop_and_nodes_move_limits(
    nodes: WrittenNodes, operated: Controller, tmp_path: Path
) -> None:
    running = RunningLoop(settings_of(nodes, operated, tmp_path, fresh=Bridge(2.0)))
    running.becomes(Mode.AUTO, scans=3)
    nodes.write("T", 300.0, ua.StatusCodes.BadSensorFailure)
    assert within(20, lambda: bool(running.commands[-1].bridged or running.commands[-1].shed))
    assert within(20, lambda: list(running.commands[-1].shed) == ["T"])
    assert running.commands[-1].mode is Mode.AUTO
    nodes.write("T", 290.0)  # ten below its set point: the valve goes up to its end
    assert within(20, lambda: not running.commands[-1].shed)
    assert within(20, lambda: running.commands[-1].mv[0] == 100.0)
    nodes.write("high", 70.0)
    assert within(20, lambda: running.commands[-1].mv[0] == 70.0)
    assert running.does("operate", {"valve.high": 60.0}).startswith("valve: high limit 70 -> 60 %")
    assert within(20, lambda: running.commands[-1].mv[0] == 60.0)
    nodes.write("use", False)  # the plant's own switch: the MV is in local
    assert within(20, lambda: "change plant: valve taken out" in running.events())
    before = len(running.commands)
    assert within(20, lambda: len(running.commands) > before + 2)
    assert running.commands[-1].mv[0] == 60.0
    nodes.write("high", 120.0)
    assert within(20, lambda: any("refused: valve: high limit 60 -> 120" in line for line in running.events()))
    running.end()


def test_the_check_shows_the_nodes_of_operate(nodes: WrittenNodes, operated: Controller, tmp_path: Path) -> None:
    nodes.write("high", 120.0)
    made = settings_of(nodes, operated, tmp_path)
    rows = {r.signal: r for r in inspected(operated.manifest, made.server, made.nodes, 0.05).rows}
    high, use = rows["operate valve.high"], rows["operate valve.use"]
    assert (high.wrong, high.value, use.wrong, use.note, use.value) == ("", "120", "", "", "1")
    assert "0 to 100 %" in high.note


def test_a_switch_is_written_as_true_or_false(
    nodes: WrittenNodes, operated: Controller, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the command; a value that is no switch takes numbers alone, as a set point does."""
    settings = settings_of(nodes, operated, tmp_path)
    running = RunningLoop(settings)
    running.becomes(Mode.AUTO, scans=3)
    with mock.patch.object(Settings, "read", return_value=settings):
        for words, stands in (("T.use=false", 0.0), ("T.use=TRUE", 1.0), ("T.use=0", 0.0)):
            assert main(["loop", "operate", words]) == 0
            assert within(20, lambda stands=stands: dict(_operate(running))["T.use"] == stands)
        capsys.readouterr()
        for wrong in (("operate", "valve.high=true"), ("operate", "T.use=maybe"), ("sp", "T=true")):
            assert main(["loop", *wrong]) == 2
            assert capsys.readouterr().err.count("\n") == 1
    assert dict(_operate(running))["valve.high"] == 100.0
    running.end()


def _operate(running: RunningLoop) -> Iterator[tuple[str, float]]:
    loop = running.station.loop
    assert loop is not None
    return zip((e.name for e in loop.controller.manifest.operate), loop.operate.tolist(), strict=True)


# ----------------------------------------------------------------------------------------------------------- analysers
class Results:
    """The scans of a loop at which its law got a new reading of p, and the number that it got."""

    def __init__(self, running: RunningLoop, controller: Controller) -> None:
        self.running, self.manifest = running, controller.manifest

    def found(self) -> list[float]:
        given = [Given.of(self.manifest, c.info) for c in self.running.commands if c.info is not None]
        assert all(g.fresh["T"] == 1 for g in given)
        return [g.pv["p"] for g in given if g.fresh["p"]]

    def after(self, scans: int = 4) -> list[float]:
        """Those until so many scans from now."""
        enough = len(self.running.commands) + scans
        assert within(20, lambda: len(self.running.commands) >= enough)
        return self.found()


@pytest.mark.parametrize("new", ["number", "source_time"])
def test_a_law_gets_each_result_of_an_analyser_once(
    nodes: WrittenNodes, operated: Controller, tmp_path: Path, new: Any
) -> None:
    nodes.write("p", 5.0, at_s=0)
    of = {"p": AnalyserNode(1_000.0, new)}
    running = RunningLoop(settings_of(nodes, operated, tmp_path, analysers=of))
    running.becomes(Mode.AUTO, scans=3)
    results = Results(running, operated)
    stamped = new == "source_time"
    assert results.after() == [5.0]
    nodes.write("p", 5.5, at_s=60)
    assert results.after() == [5.0, 5.5]
    nodes.write("p", 5.5, at_s=120)  # two equal results, or a server that stamps what stands
    expected = [5.0, 5.5, *[5.5] * stamped]
    assert results.after() == expected
    nodes.write("p", 6.0, ua.StatusCodes.BadSensorFailure, at_s=180)
    assert results.after() == expected
    nodes.write("p", 5.5, at_s=120)  # the last good one stands there again
    assert results.after() == expected
    nodes.write("p", 6.0, at_s=180)  # good in the end
    assert results.after() == [*expected, 6.0]
    assert not any(c.bridged or c.shed or c.fault for c in running.since(0, Mode.AUTO))
    running.end()


def test_an_analyser_that_has_no_result_for_too_long_is_left_out_and_comes_back(
    nodes: WrittenNodes, operated: Controller, tmp_path: Path
) -> None:
    limits = {"analysers": {"p": 8.0}, "fresh": Bridge(3.0)}  # 8 and 3 scans
    running = RunningLoop(settings_of(nodes, operated, tmp_path, **limits))
    running.becomes(Mode.AUTO, scans=1)
    assert within(20, lambda: list(running.commands[-1].shed) == ["p"])
    given = [Given.of(operated.manifest, c.info) for c in running.commands if c.info is not None]
    assert given[-1].operate["p.use"] == 0.0
    assert given[-1].fresh == {"T": 1.0, "p": 0.0, "x": 1.0}
    first = next(i for i, c in enumerate(running.commands) if c.bridged)
    assert "no new reading" in running.commands[first].bridged["p"]
    assert running.commands[-1].mode is Mode.AUTO
    with closing(JournalReader(running.settings.journal.file)) as reader:
        assert within(20, lambda: [e.event.alarm for e in reader.active()] == ["reading p"])
    nodes.write("T", 299.0)  # the other variable is controlled meanwhile
    before = running.commands[-1].mv[0]
    assert within(20, lambda: running.commands[-1].mv[0] > before)
    nodes.write("T", 300.0)
    nodes.write("p", 5.1)
    assert within(20, lambda: not running.commands[-1].shed)
    with closing(JournalReader(running.settings.journal.file)) as reader:
        assert within(20, lambda: not reader.active())
    said = [line for line in running.events() if "PV p" in line]
    assert ["is bridged" in said[0], "is left out" in said[1], "is read again" in said[2]] == [True] * 3
    counts = running.station.watching.weekly.counts
    assert counts["cv p shed"] > 0
    assert counts["cv p bridged"] >= 1
    running.end()


@pytest.mark.parametrize("nodes", [{"y0": 0.4, "y1": -0.2, "u0": 0.1, "u1": 0.3}], indirect=True)
def test_an_analyser_comes_back_without_a_bump(nodes: WrittenNodes, predictive: Controller, tmp_path: Path) -> None:
    """A plant at rest: whatever moves an MV is the law's."""
    nodes.write("y1", -0.2, at_s=0)
    limits = {"analysers": {"y1": AnalyserNode(5.0, "source_time")}, "fresh": Bridge(2.0)}
    running = RunningLoop(settings_of(nodes, predictive, tmp_path, **limits))
    running.becomes(Mode.AUTO, scans=1)
    assert within(20, lambda: list(running.commands[-1].shed) == ["y1"])
    nodes.write("y1", -0.2, at_s=60)
    assert within(20, lambda: not running.commands[-1].shed)
    enough = len(running.commands) + 3
    assert within(20, lambda: len(running.commands) >= enough)
    seen = running.since(0, Mode.AUTO)
    mv = np.array([c.mv for c in seen])
    left_out = next(i for i, c in enumerate(seen) if c.shed)
    assert np.abs(mv - [0.1, 0.3]).max() < 1e-3  # a plan from a cold start settles
    assert np.abs(np.diff(mv[left_out - 1 :], axis=0)).max() < 1e-5  # of a range of 2
    nodes.write("y1", -0.1, at_s=120)  # off its set point: the law is there
    assert within(20, lambda: bool(np.abs(running.commands[-1].mv - [0.1, 0.3]).max() > 1e-3))
    running.end()
