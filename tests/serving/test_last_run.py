"""Operators' values in a loop's journal, and another loop that takes them back."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from loopwright.serving import Controller, ControlLoop, LoopError, Mode
from loopwright.serving.journal import Journal
from loopwright.serving.opcua.settings import LocalNode, Nodes
from loopwright.serving.station.last_run import STEERED, Steered
from loopwright.serving.station.settings import Local, Settings
from loopwright.serving.station.toml_lines import operate_lines

pytest_plugins = ["small_laws", "operated_files"]
NODES: dict[str, Any] = {"pv": {n: n for n in ("T", "p", "x")}, "mv": {n: n for n in ("valve", "heat")}}


def loop_of(controller: Controller) -> ControlLoop:
    return ControlLoop(controller, sp=[300.0, 5.0], mv=[40.0, 0.5], mode=Mode.AUTO)


def noted(act: Any, loop: ControlLoop) -> list[str]:
    found: list[str] = []
    act(loop, lambda what, reason: found.append(what))
    return found


def test_values_come_back_as_they_were_kept(operated: Controller, tmp_path: Path) -> None:
    loop = loop_of(operated)
    loop.set_operate({"valve.high": 61.0, "T.use": False})
    loop.set_sp([310.0, 5.0])
    with closing(Journal(tmp_path / "loop.journal")) as journal:
        Steered.of(loop).keep(journal)
    kept = Steered.before(tmp_path / "loop.journal")
    assert kept == Steered.of(loop)
    fresh = loop_of(operated)
    assert len(noted(kept.compare, fresh)) == 1
    assert fresh.wishes == {}
    assert len(noted(kept.restore, fresh)) == 1
    assert Steered.of(fresh) == kept
    assert noted(kept.restore, fresh) == []
    assert noted(kept.compare, fresh) == []


@pytest.mark.parametrize(
    "kept",
    ["", "[]", "{", '{"sha256": 4}', '{"sha256": "x", "sp": [1], "operate": {"T.use": "no"}}', "[" * 5000],
    ids=["none", "list", "cut", "number", "kinds", "deep"],
)
def test_a_journal_that_does_not_tell_stops_nothing(operated: Controller, tmp_path: Path, kept: str) -> None:
    with closing(Journal(tmp_path / "loop.journal")) as journal:
        if kept:
            journal.keep(STEERED, kept)
    found = Steered.before(tmp_path / "loop.journal")
    assert (dict(found.sp), dict(found.operate)) == ({}, {})
    assert noted(found.restore, loop_of(operated)) == []
    assert Steered.before(tmp_path / "none.journal") == Steered()


def test_another_controllers_values_and_wrong_ones_are_said_and_left(
    operated: Controller, otherwise_operated: Controller, tmp_path: Path
) -> None:
    loop = loop_of(operated)
    loop.set_operate({"valve.high": 61.0})
    other = loop_of(otherwise_operated)
    assert len(noted(Steered.of(loop).restore, other)) == 1
    assert other.wishes == {}
    wrong = Steered(operated.sha256, {"T": 310.0}, {"valve.high": 610.0})
    fresh = loop_of(operated)
    assert len(noted(wrong.restore, fresh)) == 2
    assert fresh.wishes == {}
    assert fresh.sp.tolist() == [310.0, 5.0]
    assert json.loads(json.dumps(dict(wrong.sp))) == {"T": 310.0}


# --------------------------------------------------------------------------------------------------------- settings
@pytest.mark.parametrize(
    ("node", "theirs", "ours"),
    [
        (LocalNode("n", local=("MAN", "LO")), [(float("nan"), "man"), (float("nan"), " LO ")], [(float("nan"), "CAS")]),
        (LocalNode("n", remote=("CAS",)), [(float("nan"), "MAN")], [(float("nan"), "cas")]),
        (LocalNode("n", local=(0.0, 2.0)), [(0.0, ""), (2.0, "")], [(1.0, "")]),
        (LocalNode("n", remote=(True,)), [(0.0, "")], [(1.0, "")]),
    ],
    ids=["texts", "remote", "numbers", "truth"],
)
def test_a_node_says_whose_an_mv_is(node: LocalNode, theirs: Any, ours: Any) -> None:
    assert [node.plants(*held) for held in theirs] == [True] * len(theirs)
    assert [node.plants(*held) for held in ours] == [False] * len(ours)


@pytest.mark.parametrize("given", [{}, {"local": (1.0,), "remote": (0.0,)}, {"node": "", "local": (1.0,)}], ids=str)
def test_a_node_that_says_nothing_is_refused(given: dict[str, Any]) -> None:
    with pytest.raises(LoopError):
        LocalNode(**{"node": "n", **given})


def test_loop_toml_names_them_and_an_mv_that_the_law_needs_is_refused(operated: Controller, tmp_path: Path) -> None:
    text = """
controller = "law.onnx"
restore = true
[server]
endpoint = "opc.tcp://127.0.0.1:1"
security = "None"
insecure = true
[nodes.pv]
T = "T"
p = "p"
x = "x"
[nodes.mv]
valve = "valve"
heat = "heat"
[nodes.local]
valve = { node = "mode", local = ["MAN", 4, true] }
[local]
after_s = 30
[operate]
"T.use" = false
"""
    (tmp_path / "loop.toml").write_text(text)
    found = Settings.read(tmp_path / "loop.toml")
    assert found.restore
    assert found.local == Local(30.0)
    assert dict(found.nodes.local) == {"valve": LocalNode("mode", ("MAN", 4.0, True))}
    assert "mode" in found.nodes.ids()
    assert dict(found.operate) == {"T.use": False}
    found.nodes.check(operated.manifest)
    with pytest.raises(LoopError, match="heat"):
        Nodes(**NODES, local={"heat": LocalNode("mode", ("MAN",))}).check(operated.manifest)
    with pytest.raises(LoopError, match="after_s"):
        Local(-1.0)


def test_the_template_says_which_values_are_switches(operated: Controller) -> None:
    lines = [line for line in operate_lines(operated.manifest) if ".use" in line and "Operate" in line]
    assert len(lines) == 3
    assert all("0 or 1" in line for line in lines)
