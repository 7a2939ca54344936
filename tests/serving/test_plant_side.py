"""Nodes of a plant's own operator and the loop agree in the end, over refusals, other laws and starts of the server."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from asyncua import ua

from loopwright.serving import Controller, ControlLoop, Mode, Sample
from loopwright.serving.guard import Fault
from loopwright.serving.manifest import Manifest
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.plan import NodePlan
from loopwright.serving.opcua.sampling import Ages, Values
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.opcua.values import NodeReading
from loopwright.serving.station.plant_side import PlantSide
from loopwright.serving.station.recorder import Recorder
from loopwright.serving.station.requests import NodeRequests

pytest_plugins = ["small_laws", "operated_files"]
NAN = float("nan")
SERVER = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True, connect_s=0.05)
NODES = Nodes({n: f"ns=2;s={n}" for n in ("T", "p", "x")}, {n: f"ns=2;s={n}" for n in ("valve", "heat")})


def sample(t: float = 300.0, p: float = 5.0, x: float = 0.5, valve: float = 40.0, **changed: Any) -> Sample:
    return replace(Sample(np.array([t, p, x]), np.array([valve, 0.5])), **changed)


def loop_of(controller: Controller, **options: Any) -> ControlLoop:
    return ControlLoop(controller, **{"sp": [300.0, 5.0], "mv": [40.0, 0.5], "mode": Mode.AUTO, **options})


def named(loop: ControlLoop) -> dict[str, float]:
    entries = loop.controller.manifest.operate
    return dict(zip([e.name for e in entries], loop.operate.tolist(), strict=True))


class Lines:
    """In the place of the recorder, and of its journal: what is said, and which alarms are active."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.alarms: dict[str, bool] = {}

    def note(self, kind: str, who: str, what: str, reason: str = "", **_: Any) -> None:
        self.said.append(what)

    def event(self, entry: Any) -> None:
        if entry.alarm:
            self.alarms[entry.alarm] = entry.raised

    def begin(self, *_: Any) -> None:
        """Nothing is written."""

    def scan(self, *_: Any) -> None:
        """Nothing is written."""


# --------------------------------------------------------------------------------------------------- values of operate
class Operator:
    """Writes nodes of a plant, which the loop reads after each change."""

    def __init__(self, loop: ControlLoop) -> None:
        self.loop, self.lines = loop, Lines()
        nodes = SimpleNamespace(sp={}, operate={e.name: "" for e in loop.controller.manifest.operate}, mode=None)
        settings: Any = SimpleNamespace(nodes=nodes, accept_unproven=True)
        self.side = PlantSide(settings, loop.controller.manifest, self.lines)  # type: ignore[arg-type]
        self.shown: dict[str, float] = {}
        self.starts = 0

    def write(self, **values: float) -> list[str]:
        """What was said of it; ``valve_low`` is valve.low."""
        self.shown |= {name.replace("_", ".", 1): value for name, value in values.items()}
        before = len(self.lines.said)
        pv, mv = np.array([300.0, 5.0, 0.5]), np.array([40.0, 0.5])
        seen = Values(0.0, pv, mv, np.zeros(0), 0.0, "", (0,) * 5, asked_operate=self.shown, starts=self.starts)
        self.side.carry_out(self.loop, seen)
        return self.lines.said[before:]


def test_a_range_that_moves_end_by_end_gets_there(operated: Controller) -> None:
    loop = loop_of(operated)
    operator = Operator(loop)
    operator.write(T_low=260.0, T_high=280.0)
    (refused,) = operator.write(T_low=300.0)
    assert refused.startswith("refused")
    assert operator.write() == []
    assert operator.write(T_high=320.0) == ["T: low limit 260 -> 300 K, high limit 280 -> 320 K"]
    assert (named(loop)["T.low"], named(loop)["T.high"]) == (300.0, 320.0)
    assert operator.write() == []


def test_a_wrong_value_takes_only_itself_with_it(operated: Controller) -> None:
    loop = loop_of(operated)
    operator = Operator(loop)
    operator.write(T_low=260.0, T_high=280.0, valve_low=0.0, valve_high=100.0, speed=1.0)
    said = operator.write(T_low=300.0, T_high=320.0, valve_low=999.0, valve_high=60.0, speed=9.0)
    assert sum(line.startswith("refused") for line in said) == 2
    found = named(loop)
    assert (found["T.low"], found["T.high"], found["valve.high"], found["speed"]) == (300.0, 320.0, 60.0, 1.0)
    (once,) = operator.write(valve_high=70.0)  # and nothing again of the others
    assert once == "valve: high limit 60 -> 70 %"
    assert len(operator.write(speed=8.0)) == 1


def test_ends_that_cross_are_taken_neither_one_alone(operated: Controller) -> None:
    loop = loop_of(operated)
    operator = Operator(loop)
    operator.write(T_low=260.0, T_high=320.0)
    operator.write(T_low=300.0, T_high=290.0)
    assert (named(loop)["T.low"], named(loop)["T.high"]) == (260.0, 320.0)
    operator.write(T_low=280.0)
    assert (named(loop)["T.low"], named(loop)["T.high"]) == (280.0, 290.0)


def test_a_refused_node_does_not_undo_a_later_word(operated: Controller) -> None:
    loop = loop_of(operated)
    operator = Operator(loop)
    operator.write(T_low=260.0, T_high=280.0, speed=1.0)
    operator.write(T_low=300.0)
    loop.set_operate({"T.low": 270.0, "T.high": 320.0})  # on the page
    operator.write(speed=2.0)
    assert named(loop)["T.low"] == 270.0


def test_a_node_of_what_the_law_has_not_is_tried_again_with_another_law(
    operated: Controller, not_operated: Controller
) -> None:
    loop = loop_of(operated)
    operator = Operator(loop)
    operator.write(valve_use=1.0)
    for to, wanted in ((not_operated, 0.0), (operated, 0.0)):
        loop.swap(to, 1)
        loop.scan(sample())
        operator.write(valve_use=wanted)
    assert loop.controller is operated
    assert named(loop)["valve.use"] == 0.0


def test_a_contact_that_fell_while_the_server_started_anew_counts(operated: Controller) -> None:
    loop = loop_of(operated)
    operator = Operator(loop)
    operator.write(valve_use=1.0, speed=2.0)
    operator.starts = 1
    (told, taken) = operator.write(valve_use=0.0, speed=1.0)
    assert "operate" in told
    assert taken == "valve taken out"
    assert (named(loop)["valve.use"], named(loop)["speed"]) == (0.0, 2.0)


def test_a_contact_that_stands_as_before_is_no_new_word() -> None:
    asked = NodeRequests()

    def of(starts: int, **operate: float) -> dict[str, float]:
        shown = {name.replace("_", "."): value for name, value in operate.items()}
        values: Any = SimpleNamespace(asked_sp={}, asked_mode="", starts=starts, asked_operate=shown)
        return asked.of(values).operate

    assert of(0, v_use=1.0, v_low=1.0) == {"v.use": 1.0, "v.low": 1.0}
    assert of(1, v_use=1.0, v_low=2.0) == {}
    assert of(1, v_use=0.0, v_low=2.0) == {"v.use": 0.0}
    assert of(2, v_use=1.0, w_use=0.0, v_low=3.0) == {"v.use": 1.0, "w.use": 0.0}  # not seen before


# --------------------------------------------------------------------------------------------------------- the journal
def test_the_alarm_of_a_pv_that_is_left_out_ends_also_where_it_is_bridged_next(operated: Controller) -> None:
    loop, lines = loop_of(operated, recover_after=1, bridge_s=3.0), Lines()
    recorder = Recorder(lines, lambda _: None)  # type: ignore[arg-type]
    recorder.begin(operated)

    def scans(given: Sample, n: int = 1) -> list[str]:
        for _ in range(n):
            recorder.scan(loop, given, loop.scan(given))
        return [alarm for alarm, raised in lines.alarms.items() if raised]

    scans(sample())
    scans(sample(t=NAN), 3)
    assert scans(sample(t=NAN, x=NAN), 3) == ["reading T"]
    assert scans(sample(x=NAN)) == ["reading T", "fault"]  # T is read well, and the loop holds without x
    assert scans(sample(t=NAN)) == []
    assert scans(sample()) == []


# --------------------------------------------------------------------------------------------------------- the endpoint
def endpoint_of(manifest: Manifest, **ages: float) -> OpcUaEndpoint:
    made = OpcUaEndpoint(manifest, SERVER, NODES, max_age_s=1.5, clock=lambda: 0.0)
    names = {f"PV {s.name}": ages.get(s.name, 0.0) for s in manifest.pv}
    pv, mv = np.array([300.0, 5.0, 0.5]), np.array([40.0, 0.5])
    made.values = Values(0.0, pv, mv, np.zeros(0), max(names.values()), "", (0,) * 5, ages=names)
    made.trouble = ""
    return made


def test_a_late_pv_is_a_fault_that_knows_its_kind(operated: Controller) -> None:
    late, *others = endpoint_of(operated.manifest, T=9.0).read().bad_pv
    assert isinstance(late, Fault)
    assert (late.kind, late.subject) == ("age", "PV T")
    assert others == ["", ""]


@pytest.mark.parametrize("first_reads", [False, True])
def test_quality_and_age_are_judged_for_the_law_in_charge(
    operated: Controller, not_operated: Controller, first_reads: bool
) -> None:
    first, second = (operated, not_operated) if first_reads else (not_operated, operated)
    made = endpoint_of(first.manifest, T=9.0)
    plan = NodePlan(NODES, first.manifest)
    bad = NodeReading(300.0, int(ua.StatusCodes.BadSensorFailure), None, ua.VariantType.Double)
    answers = [bad, *(NodeReading(0.5, 0, None, ua.VariantType.Double) for _ in plan.rows[1:])]
    for law in (first, second, first):
        made.serve(law.manifest)
        apart = "fresh" in law.manifest.inputs
        found = made._sampling.valued(plan, answers, Ages(len(plan.timed)), 0.0, unbeaten="", starts=0)
        assert (bool(found.bad_pv), bool(found.fault)) == (apart, not apart)
        assert bool(made.read().bad_pv) == apart
