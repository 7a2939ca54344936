"""A station takes operate and single bad readings: by requests, by nodes, in its journal and its views."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asyncua import ua
from fake_loop import FakeLoop
from still_station import still_machine

from loopwright.pipeline.__main__ import main
from loopwright.serving import Controller, LoopError, Mode, Sample
from loopwright.serving.journal import JournalReader
from loopwright.serving.loop import Command
from loopwright.serving.manifest import Manifest
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.plan import NodePlan
from loopwright.serving.opcua.sampling import Ages, NodeSampling, Values
from loopwright.serving.opcua.settings import AnalyserNode, Nodes, Point, Server
from loopwright.serving.opcua.values import NodeReading
from loopwright.serving.station.build_loop import control_loop
from loopwright.serving.station.requests import Request, change
from loopwright.serving.station.settings import Bridge, JournalSettings, Settings, template
from loopwright.serving.station.station import Station
from loopwright.serving.station.views import about, state

pytest_plugins = ["small_laws", "operated_files"]
SERVER = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True, connect_s=0.05)
NODES: dict[str, Any] = {
    group: {name: f"ns=2;s={name}" for name in names}
    for group, names in {"pv": ("T", "p", "x"), "mv": ("valve", "heat")}.items()
}
BY_NODES = {"valve.high": "ns=2;s=high", "valve.low": "ns=2;s=low", "T.use": Point("ns=2;s=use")}
GOOD, BAD = 0, int(ua.StatusCodes.BadSensorFailure)


# ------------------------------------------------------------------------------------------------------------ readings
def valued(manifest: Manifest, nodes: Nodes | None = None, **changed: NodeReading) -> Values:
    """One reading, of good values but for some."""
    nodes = nodes or Nodes(**NODES)
    plan = NodePlan(nodes, manifest)
    usual = {"T": 300.0, "p": 5.0, "x": 0.5, "valve": 40.0, "heat": 0.5, "high": 80.0, "low": 10.0, "use": 1.0}
    answers = []
    for row in plan.rows:
        name = row.node.removeprefix("ns=2;s=")
        answers.append(changed.get(name, NodeReading(usual[name], GOOD, None, ua.VariantType.Double)))
    return NodeSampling(manifest, SERVER, nodes).valued(
        plan, answers, Ages(len(plan.timed)), 0.0, unbeaten="", starts=0
    )


BAD_T = NodeReading(300.0, BAD, None, ua.VariantType.Double)


def test_a_bad_pv_speaks_against_itself_alone_where_the_law_bridges_it(
    operated: Controller, not_operated: Controller
) -> None:
    found = valued(operated.manifest, T=BAD_T, x=NodeReading(np.nan, GOOD, None, ua.VariantType.Double, "nan"))
    assert found.fault == ""
    assert [bool(why) for why in found.bad_pv] == [True, False, True]
    assert "BadSensorFailure" in found.bad_pv[0]
    assert valued(operated.manifest).bad_pv == ()
    assert "heat" in valued(operated.manifest, T=BAD_T, heat=BAD_T).fault  # the law cannot do without it
    alone = valued(operated.manifest, valve=BAD_T)
    assert (alone.fault, bool(alone.local[0]), alone.local[1]) == ("", True, "")
    assert np.isnan(alone.mv[0])
    whole = valued(not_operated.manifest, T=BAD_T, valve=BAD_T)
    assert whole.fault.startswith("PV T")
    assert whole.bad_pv == ()


def endpoint_with(manifest: Manifest, **ages: float) -> Sample:
    """A sample of values of these ages; 1.5 s are allowed."""
    made = OpcUaEndpoint(manifest, SERVER, Nodes(**NODES), max_age_s=1.5, clock=lambda: 0.0)
    names = {"PV T": 0.0, "PV p": 0.0, "PV x": 0.0} | {f"PV {n}": age for n, age in ages.items()}
    pv, mv = np.array([300.0, 5.0, 0.5]), np.array([40.0, 0.5])
    made.values = Values(0.0, pv, mv, np.zeros(0), max(names.values()), "", (0,) * 5, ages=names)
    made.trouble = ""
    return made.read()


def test_a_late_pv_is_bad_alone_where_the_law_bridges_it(operated: Controller, not_operated: Controller) -> None:
    found = endpoint_with(operated.manifest, T=9.0, p=1.0)
    assert (found.age_s, found.late) == (1.0, "")
    assert [bool(why) for why in found.bad_pv] == [True, False, False]
    everything = endpoint_with(operated.manifest, T=9.0, p=9.0, x=9.0)
    assert (everything.age_s, everything.bad_pv) == (9.0, ())
    found = endpoint_with(not_operated.manifest, T=9.0)
    assert (found.age_s, found.late, found.bad_pv) == (9.0, "PV T", ())


def test_nodes_of_operate_are_read_and_named(operated: Controller) -> None:
    nodes = settings_of(operated, nodes={**NODES, "operate": BY_NODES}).nodes
    assert {"ns=2;s=high", "ns=2;s=use"} <= set(nodes.ids())
    found = valued(operated.manifest, nodes)
    assert found.asked_operate == {"valve.high": 80.0, "valve.low": 10.0, "T.use": 1.0}
    assert not found.fault
    gone = valued(operated.manifest, nodes, high=NodeReading(80.0, BAD, None, ua.VariantType.Double))
    assert (gone.fault, gone.bad_pv) == ("", ())
    assert "valve.high" not in gone.asked_operate
    rows = {row.name for row in NodePlan(nodes, operated.manifest).rows}
    assert "operate valve.high" in rows


def settings_of(controller: Controller, **changed: Any) -> Settings:
    nodes = Nodes(**changed.pop("nodes", NODES))
    return Settings(controller.path, SERVER, nodes, **{"start": "MANUAL", **changed})


# ------------------------------------------------------------------------------------------------------------ settings
def test_the_template_of_a_law_with_operate_can_be_read(operated: Controller, tmp_path: Path) -> None:
    text = template(operated, operated.path, "opc.tcp://127.0.0.1:4840")
    tree = tomllib.loads(text)
    assert tree["fresh"] == {"bridge_s": 10.0}
    whole = re.sub(r"^# (?=\[nodes\.operate|\"|\[operate\]|critical)", "", text, flags=re.M)
    (tmp_path / "loop.toml").write_text(whole)
    found = Settings.read(tmp_path / "loop.toml")
    assert list(found.nodes.operate) == [e.name for e in operated.manifest.operate]
    assert found.operate == {"T.use": 1.0}
    assert found.fresh == Bridge(10.0, ("T",))
    found.nodes.check(operated.manifest)


def test_the_template_of_any_other_law_has_none_of_it(not_operated: Controller) -> None:
    text = template(not_operated, not_operated.path, "opc.tcp://127.0.0.1:4840")
    assert "operate" not in text
    assert "fresh" not in text


@pytest.mark.parametrize(
    "changed",
    [
        {"operate": {"valve.hihg": 60.0}},
        {"operate": {"valve.high": 600.0}},
        {"fresh": Bridge(critical=("q",))},
    ],
    ids=str,
)
def test_settings_that_do_not_fit_the_controller_are_refused(operated: Controller, changed: Any) -> None:
    with pytest.raises(LoopError):
        control_loop(settings_of(operated, **changed), operated)


def test_nodes_and_values_for_a_law_without_operate_are_refused(not_operated: Controller) -> None:
    with pytest.raises(LoopError, match=r"nodes\.operate"):
        settings_of(not_operated, nodes={**NODES, "operate": BY_NODES}).nodes.check(not_operated.manifest)
    with pytest.raises(LoopError, match="has no operate"):
        control_loop(settings_of(not_operated, operate={"speed": 2.0}), not_operated)


def test_a_bridge_of_no_time_that_can_be_is_refused() -> None:
    with pytest.raises(LoopError, match="bridge_s"):
        Bridge(-1.0)


# ------------------------------------------------------------------------------------------------------------- station
class Plant:
    """In the place of the endpoint: it shows what the test says, and reads back what was written."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.trouble, self.connections, self.connected = "", 1, True
        self.mv = np.array([40.0, 0.5])
        self.bad: tuple[str, ...] = ()
        self.asked: dict[str, float] = {}

    @property
    def values(self) -> Values:
        pv = np.array([300.0, 5.0, 0.5])
        return Values(0.0, pv, self.mv, np.zeros(0), 0.0, "", (), bad_pv=self.bad, asked_operate=self.asked)

    def start(self) -> None:
        """Nothing: it is there."""

    def serve(self, law: Manifest) -> None:
        self.law = law

    def close(self) -> None:
        """Nothing."""

    def read(self) -> Sample:
        return Sample(self.values.pv, self.mv, bad_pv=self.bad)

    def write(self, mv: np.ndarray) -> None:
        self.mv = mv.copy()


@pytest.fixture
def make_station(tmp_path: Path) -> Callable[..., Station]:
    def make(controller: Controller, **changed: Any) -> Station:
        journal = JournalSettings(tmp_path / "loop.journal")
        made = settings_of(controller, journal=journal, **changed)
        machine = still_machine(tmp_path, Plant)
        return Station(made, controller=Controller(controller.path), machine=machine)  # type: ignore[arg-type]

    return make


def ran(made: Station, **at: Callable[[Any], None]) -> tuple[list[Command], list[str]]:
    """The commands and events of a run in which something happens after the scans ``s0``, ``s1``, ..."""
    commands: list[Command] = []
    scans = 1 + max((int(name[1:]) for name in at), default=0) + 3

    def seen(_: Sample | None, command: Command) -> None:
        commands.append(command)
        if act := at.get(f"s{len(commands) - 1}"):
            act(made.endpoint)

    made.watch(seen)
    made.run(scans)
    with closing(JournalReader(made.settings.journal.file)) as reader:
        return commands, [f"{e.kind} {e.who}: {e.what} ({e.reason})" for _, e in reader.events()]


def asked(made: Station, value: Any, do: str = "operate") -> Callable[[Any], None]:
    def act(_: Any) -> None:
        assert made.loop is not None
        request = Request.read({"do": do, "value": value, "who": "anna", "reason": "valve sticks"})
        made.ask(change(request, made.loop, lambda file, sha256: Controller(file)))

    return act


def test_a_request_is_carried_out_written_down_and_shown(
    operated: Controller, make_station: Callable[..., Station]
) -> None:
    made = make_station(operated, operate={"speed": 2.0})
    _, events = ran(made, s2=asked(made, {"valve.high": 60, "T.use": 0}))
    assert "change anna: T taken out; valve: high limit 100 -> 60 % (valve sticks)" in events
    names = [row["name"] for row in about(made)["operate"]]
    shown = dict(zip(names, state(made)["operate"], strict=True))
    assert (shown["valve.high"], shown["T.use"], shown["speed"]) == (60.0, 0.0, 2.0)
    json.dumps([about(made), state(made)], allow_nan=False)


def test_an_mv_is_taken_in_hand_and_sent_in_one_change(
    operated: Controller, make_station: Callable[..., Station]
) -> None:
    made = make_station(operated, start="AUTO", accept_unproven=True)
    commands, events = ran(made, s2=asked(made, {"valve": 71.0}, "by_hand"))
    said = [line for line in events if line.startswith("change anna")]
    assert len(said) == 1
    assert "valve taken out" in said[0]
    assert "71 %" in said[0]
    assert [float(c.mv[0]) for c in commands[3:]] == [71.0] * len(commands[3:])
    assert commands[-1].mode is Mode.AUTO
    shown = dict(zip([row["name"] for row in about(made)["operate"]], state(made)["operate"], strict=True))
    assert (shown["valve.use"], state(made)["goal"][0]) == (0.0, 71.0)


@pytest.mark.parametrize("value", [{"valve": 140.0}, {"heat": 0.5}, {"vlave": 1.0}, {"valve": "much"}, None], ids=str)
def test_an_mv_that_cannot_be_taken_or_sent_is_refused(operated: Controller, value: Any) -> None:
    loop = control_loop(settings_of(operated, start="AUTO", accept_unproven=True), operated, mv=[40.0, 0.5])
    request = Request.read({"do": "by_hand", "value": value, "who": "anna"})
    with pytest.raises(LoopError) as error:
        change(request, loop, lambda file, sha256: Controller(file))
    assert error.value.entry == ("valve" if value == {"valve": 140.0} else "")


@pytest.mark.parametrize("value", [{"valve.hihg": 1.0}, {"valve.high": 1000.0}, {"T.use": 0.5}, {}, None, 5.0], ids=str)
def test_a_request_that_cannot_be_is_refused_before_it_comes_near_the_loop(operated: Controller, value: Any) -> None:
    loop = control_loop(settings_of(operated), operated, mv=[40.0, 0.5])
    request = Request.read({"do": "operate", "value": value, "who": "anna"})
    with pytest.raises(LoopError):
        change(request, loop, lambda file, sha256: Controller(file))


def test_a_request_to_a_law_without_operate_is_one_clear_error(not_operated: Controller) -> None:
    loop = control_loop(settings_of(not_operated), not_operated, mv=[40.0, 0.5])
    with pytest.raises(LoopError, match="formula has no operate"):
        change(
            Request.read({"do": "operate", "value": {"speed": 2.0}, "who": "anna"}), loop, lambda f, s: Controller(f)
        )


def test_a_request_that_another_one_has_made_impossible_is_refused_in_the_journal(
    operated: Controller, make_station: Callable[..., Station]
) -> None:
    made = make_station(operated)

    def both(plant: Any) -> None:
        asked(made, {"valve.high": 30.0})(plant)
        asked(made, {"valve.low": 50.0})(plant)

    _, events = ran(made, s2=both)
    assert any("refused: valve: low limit 0 -> 50 %" in line for line in events)


def test_the_plants_own_operator_steers_by_nodes(operated: Controller, make_station: Callable[..., Station]) -> None:
    made = make_station(operated, nodes={**NODES, "operate": BY_NODES})

    def both_ends(plant: Any) -> None:
        plant.asked = {"valve.low": 70.0, "valve.high": 90.0, "T.use": 1.0}

    def one_wrong(plant: Any) -> None:
        plant.asked = {"valve.low": 95.0, "valve.high": 90.0, "T.use": 0.0}

    made.endpoint.asked = {"valve.low": 10.0, "valve.high": 60.0, "T.use": 1.0}  # type: ignore[attr-defined]
    _, events = ran(made, s3=both_ends, s6=one_wrong)
    said = [line for line in events if line.startswith("change plant")]
    assert said[0] == "change plant: valve: low limit 0 -> 10 %, high limit 100 -> 60 % ()"  # as it stood at first
    assert said[1] == "change plant: valve: low limit 10 -> 70 %, high limit 60 -> 90 % ()"
    assert said[2].startswith("change plant: refused: valve: low limit 70 -> 95 %")
    assert said[3] == "change plant: T taken out ()"
    assert len(said) == 4
    assert made.loop is not None
    assert made.loop.operate[[0, 5, 6]].tolist() == [0.0, 70.0, 90.0]


def test_bridged_left_out_and_read_again_stand_in_the_journal_and_the_views(
    operated: Controller, make_station: Callable[..., Station]
) -> None:
    made = make_station(operated, fresh=Bridge(2.0))
    shown: dict[int, tuple[Any, Any]] = {}

    def bad(plant: Any) -> None:
        plant.bad = ("BadSensorFailure", "", "")

    def look(_: Any) -> None:
        now = state(made)
        shown[len(shown)] = (now["bridged"], now["shed"])

    def good(plant: Any) -> None:
        look(plant)
        plant.bad = ()

    commands, events = ran(made, s1=bad, s2=look, s7=good, s10=look)
    assert [bool(c.bridged) for c in commands[:6]] == [False, False, True, True, False, False]
    assert [bool(c.shed) for c in commands[:6]] == [False, False, False, False, True, True]
    assert shown[0] == ({"T": "BadSensorFailure"}, {})
    assert shown[1] == ({}, {"T": "BadSensorFailure"})
    assert shown[2] == ({}, {})
    said = [line for line in events if line.startswith("fault loop")]
    assert said == [
        "fault loop: PV T is bridged: BadSensorFailure ()",
        "fault loop: PV T is left out: BadSensorFailure ()",
        "fault loop: over: PV T is read again ()",
    ]
    with closing(JournalReader(made.settings.journal.file)) as reader:
        assert not [e for e in reader.active() if e.event.kind == "fault"]
        raised = [e for _, e in reader.events() if e.raised]
    assert [e.alarm for e in raised] == ["reading T"]
    assert made.loop is not None
    assert made.loop.mode is Mode.MANUAL


def test_the_endpoint_is_told_which_law_it_serves(
    operated: Controller, not_operated: Controller, make_station: Callable[..., Station]
) -> None:
    made = make_station(not_operated)

    def swap(_: Any) -> None:
        assert made.loop is not None
        made.loop.swap(operated, 1)

    ran(made, s1=swap)
    assert "fresh" in made.endpoint.law.inputs  # type: ignore[attr-defined]


# ------------------------------------------------------------------------------------------------------------- command
def test_the_command_passes_names_and_values_on(operated: Controller, tmp_path: Path) -> None:
    made = FakeLoop(tmp_path, operated)
    toml = tmp_path / "loop.toml"
    toml.write_text(
        f'controller = "{operated.path}"\n[server]\nendpoint = "opc.tcp://127.0.0.1:1"\nsecurity = "None"\n'
        f'insecure = true\n[nodes.pv]\n[nodes.mv]\n[journal]\nfile = "{made.journal.name}"\n'
    )
    words = ["loop", "operate", "valve.high=60", "T.use=0", "--loop", str(toml), "--who", "anna", "--reason", "sticks"]
    try:
        assert main(words) == 0
        assert made.changes[-1] == {
            "do": "operate", "value": {"valve.high": 60.0, "T.use": 0.0}, "who": "anna", "reason": "sticks",
        }  # fmt: skip
        assert main([*words[:2], "valve.high", *words[4:]]) == 2
    finally:
        made.close()


# ----------------------------------------------------------------------------------------------------------- analysers
def test_an_analyser_is_new_where_its_number_changes_and_bad_after_it_has_stood_too_long(operated: Controller) -> None:
    nodes = Nodes(**NODES, analysers={"x": 100.0})
    nodes.check(operated.manifest)
    rows = NodePlan(nodes, operated.manifest).rows[:3]
    assert [row.title for row in rows if not row.ages] == ["PV x"]
    times = [0.0]
    made = OpcUaEndpoint(operated.manifest, SERVER, nodes, max_age_s=1.5, clock=lambda: times[-1])
    made.trouble = ""
    found = []
    for at, number in ((0.0, 0.5), (1.0, 0.5), (2.0, 0.6), (3.0, 0.6), (102.0, 0.6), (103.0, 0.6), (104.0, 0.7)):
        times.append(at)
        pv = np.array([300.0, 5.0, number])
        ages = {"PV T": 0.0, "PV p": 0.0}
        made.values = Values(at, pv, np.array([40.0, 0.5]), np.zeros(0), 0.0, "", (0,) * 5, ages=ages)
        sample = made.read()
        assert sample.fresh is not None
        found.append((sample.fresh.tolist(), bool(sample.bad_pv and sample.bad_pv[2])))
    assert [fresh[2] for fresh, _ in found] == [1, 0, 1, 0, 0, 0, 1]
    assert all(fresh[:2] == [1, 1] for fresh, _ in found)
    assert [bad for _, bad in found] == [False, False, False, False, False, True, False]


def test_an_analyser_that_cannot_be_is_refused(operated: Controller, not_operated: Controller) -> None:
    for analysers, of in (({"y": 9.0}, operated), ({"x": 0.0}, operated), ({"x": 9.0}, not_operated)):
        with pytest.raises(LoopError, match=r"nodes\.analysers"):
            Nodes(**NODES, analysers=analysers).check(of.manifest)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("x = 1800", AnalyserNode(1800.0)),
        ("x = { longest_s = 60.5 }", AnalyserNode(60.5)),
        ('x = { longest_s = 1800, new = "source_time" }', AnalyserNode(1800.0, "source_time")),
        ('x = { longest_s = 1800, new = "stamp" }', None),
        ("x = { longest_s = 0 }", None),
        ('x = "half an hour"', None),
        ('x = { new = "number" }', None),
    ],
)
def test_loop_toml_names_an_analyser_by_a_time_or_by_a_table(
    operated: Controller, tmp_path: Path, line: str, expected: AnalyserNode | None
) -> None:
    path = tmp_path / "loop.toml"
    path.write_text(
        f'controller = "{operated.path}"\n[server]\nendpoint = "opc.tcp://127.0.0.1:1"\nsecurity = "None"\n'
        f"insecure = true\n[nodes.pv]\n[nodes.mv]\n[nodes.analysers]\n{line}\n"
    )
    if expected is not None:
        assert Settings.read(path).nodes.results() == {"x": expected}
    else:
        with pytest.raises(LoopError, match="analysers"):
            Settings.read(path)
