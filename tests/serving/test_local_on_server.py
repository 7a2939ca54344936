"""A loop on a real OPC UA server goes on without an MV that the plant has itself, and gets it back without a bump."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from asyncua import ua
from plant_servers import RunningLoop
from processes import within
from written_nodes import SPACE, WrittenNodes, loop_settings, written_nodes

from loopwright.serving import Controller, LoopError, Mode
from loopwright.serving.opcua.inspection import inspected
from loopwright.serving.opcua.settings import LocalNode, Point
from loopwright.serving.station.settings import Local, Settings

pytest_plugins = ["small_laws", "operated_files"]
BY = {"word": LocalNode(f"{SPACE}word", local=("MAN", "IMAN")), "number": LocalNode(f"{SPACE}number", remote=(1.0,))}


@pytest.fixture
def nodes() -> Iterator[WrittenNodes]:
    with written_nodes() as made:
        yield made


def settings_of(nodes: WrittenNodes, controller: Controller, folder: Path, by: str) -> Settings:
    """The valve is read back by a node of its own, and a node says whether the plant has it."""
    mv = {"valve": Point(f"{SPACE}valve", read_back=f"{SPACE}back"), "heat": f"{SPACE}heat"}
    return loop_settings(nodes, controller, folder, {"mv": mv, "local": {"valve": BY[by]}}, local=Local(0.0))


@pytest.mark.parametrize(("by", "theirs", "ours"), [("word", "man", "CAS"), ("number", 0, 1)])
def test_the_plant_takes_an_mv_and_gives_it_back(
    nodes: WrittenNodes, operated: Controller, tmp_path: Path, by: str, theirs: Any, ours: Any
) -> None:
    running = RunningLoop(settings_of(nodes, operated, tmp_path, by))
    running.becomes(Mode.AUTO, scans=3)
    nodes.write(by, theirs)
    assert within(20, lambda: list(running.commands[-1].local) == ["valve"])
    nodes.write("back", 63.0)
    assert within(20, lambda: nodes.has("valve") == 63.0)  # what the loop writes follows
    assert running.commands[-1].mode is Mode.AUTO
    with pytest.raises(LoopError, match="valve"):
        running.does("mv", {"valve": 50.0})
    assert within(20, lambda: any("MV valve is out" in line for line in running.events()))
    nodes.write("T", 290.0)  # ten below its set point: the law wants the valve up
    before = len(running.commands)
    assert within(20, lambda: len(running.commands) > before + 3)
    assert nodes.has("valve") == 63.0
    nodes.write(by, ours)
    assert within(20, lambda: not running.commands[-1].local)
    first = next(c for c in running.commands[before:] if not c.local)
    assert 63.0 <= first.mv[0] <= 68.0
    assert within(20, lambda: any("over: MV valve" in line for line in running.events()))
    running.end()


def test_a_bad_read_back_stops_no_loop_and_an_mv_in_hand_goes_where_it_is_sent(
    nodes: WrittenNodes, operated: Controller, tmp_path: Path
) -> None:
    running = RunningLoop(settings_of(nodes, operated, tmp_path, "word"))
    running.becomes(Mode.AUTO, scans=3)
    nodes.write("back", 40.0, ua.StatusCodes.BadNoCommunication)
    assert within(20, lambda: list(running.commands[-1].local) == ["valve"])
    assert running.commands[-1].mode is Mode.AUTO
    nodes.write("back", 40.0)
    assert within(20, lambda: not running.commands[-1].local)
    with pytest.raises(LoopError, match="valve"):
        running.does("mv", {"valve": 47.0})
    running.does("operate", {"valve.use": False})
    assert running.does("mv", {"valve": 47.0}).startswith("MV valve 40 -> 47")
    assert within(20, lambda: nodes.has("valve") == 47.0)
    assert running.commands[-1].mode is Mode.AUTO
    running.end()


def test_a_status_that_cannot_be_read_leaves_the_mv_as_it_was(
    nodes: WrittenNodes, operated: Controller, tmp_path: Path
) -> None:
    running = RunningLoop(settings_of(nodes, operated, tmp_path, "word"))
    running.becomes(Mode.AUTO, scans=3)
    for word, local in (("CAS", []), ("MAN", ["valve"])):
        nodes.write("word", word)
        assert within(20, lambda local=local: list(running.commands[-1].local) == local)  # type: ignore[misc]
        nodes.write("word", "", ua.StatusCodes.BadNoCommunication)
        before = len(running.commands)
        assert within(20, lambda before=before: len(running.commands) > before + 3)  # type: ignore[misc]
        assert list(running.commands[-1].local) == local
    running.end()


def test_the_check_shows_whose_each_mv_is(nodes: WrittenNodes, operated: Controller, tmp_path: Path) -> None:
    notes = []
    for word in ("CAS", "MAN"):
        nodes.write("word", word)
        made = settings_of(nodes, operated, tmp_path, "word")
        rows = {r.signal: r for r in inspected(operated.manifest, made.server, made.nodes, 0.05).rows}
        assert (rows["local valve"].wrong, rows["local valve"].value) == ("", word)
        notes.append(rows["local valve"].note)
    assert len(set(notes)) == 2


# --------------------------------------------------------------------------------------------------------- a restart
def test_a_restart_says_what_operators_had_set_and_takes_it_back_where_it_is_told_to(
    nodes: WrittenNodes, operated: Controller, tmp_path: Path
) -> None:
    settings = settings_of(nodes, operated, tmp_path, "word")
    running = RunningLoop(settings)
    running.does("operate", {"valve.high": 77.0, "T.use": 0})
    running.does("sp", {"p": 6.0})
    running.end()
    again = RunningLoop(settings)
    assert within(20, lambda: any("the last one ended" in line for line in again.events()))
    said = [line for line in again.events() if "the last one ended" in line]
    assert len(said) == 1
    assert all(word in said[0] for word in ("valve: high limit 77", "T back", "p 6"))
    assert again.station.loop is not None
    assert again.station.loop.wishes == {}
    again.does("operate", {"valve.high": 66.0})
    again.does("sp", {"p": 7.0})
    again.end()
    third = RunningLoop(replace(settings, restore=True))
    assert third.station.loop is not None
    assert third.station.loop.wishes == {"valve.high": 66.0}
    assert third.station.loop.sp.tolist() == [300.0, 7.0]
    assert within(20, lambda: any("restored" in line and "-> 66 %" in line for line in third.events()))
    third.end()
