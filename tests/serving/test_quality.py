"""The quality of a value is written down and shown with that value, whatever arrives beside the scan."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from asyncua import ua
from still_station import still_machine

from loopwright.serving import Controller, EndpointError, Sample
from loopwright.serving.journal import JournalReader
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.plan import NodePlan
from loopwright.serving.opcua.sampling import Ages, NodeSampling, Values
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.opcua.values import NodeReading
from loopwright.serving.station.journal_export import export
from loopwright.serving.station.settings import JournalSettings, Settings
from loopwright.serving.station.station import Station
from loopwright.serving.station.views import state

PID = Path(__file__).parents[2] / "artifacts" / "thiosulfate_cstr" / "pid.onnx"
NODES: dict[str, Any] = {"pv": {"C_A": "ns=2;s=a", "T": "ns=2;s=b"}, "mv": {"T_j": "ns=2;s=c"}}
SERVER = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True, connect_s=0.05)
GOOD, BAD = 0, int(ua.StatusCodes.BadSensorFailure)
UNCERTAIN = int(ua.StatusCodes.UncertainSensorNotAccurate)


class Between(OpcUaEndpoint):
    """An endpoint without a server: the next answer arrives while the loop still works on the one that it read."""

    def __init__(self, *words: Any, **options: Any) -> None:
        super().__init__(*words, **options)
        self.reads, self.lost = 0, False
        self._arrives()

    def _arrives(self) -> None:
        """C_A is bad in each second answer."""
        bad = self.reads % 2 == 1
        pv = np.array([math.nan if bad else 0.9, 330.0])
        status = BAD if bad else GOOD
        fault = "PV C_A: BadSensorFailure" if bad else ""
        self.values = Values(self.clock(), pv, np.array([250.0]), np.zeros(0), 0.0, fault, (status, GOOD, GOOD))
        self.trouble = ""

    def start(self) -> None:
        """Nothing: it is there."""

    def read(self) -> Sample:
        sample = super().read()
        self.reads += 1
        self._arrives()
        if self.lost:
            raise EndpointError("the connection is lost")
        return sample


@pytest.fixture
def running(tmp_path: Path) -> Station:
    settings = Settings(PID, SERVER, Nodes(**NODES), journal=JournalSettings(tmp_path / "loop.journal"))
    return Station(settings, controller=Controller(PID), machine=still_machine(tmp_path, Between))


def test_an_answer_beside_the_scan_gives_its_quality_to_no_other_answers_values(
    running: Station, tmp_path: Path
) -> None:
    shown: list[tuple[float | None, list[str]]] = []

    def seen(sample: Sample | None, _: Any) -> None:
        now = state(running)
        shown.append((None if now["pv"] is None else now["pv"][0], now["quality"]))
        if running.scans == 5:
            running.endpoint.lost = True  # type: ignore[attr-defined]

    running.watch(seen)
    running.run(6)
    good, bad = ["Good"] * 3, ["BadSensorFailure", "Good", "Good"]
    assert shown == [(0.9, good), (None, bad)] * 2 + [(0.9, good), (None, [])]
    with closing(JournalReader(tmp_path / "loop.journal")) as reader:
        rows = [(scan.numbers[1], scan.quality) for _, _, scan in reader.scans()]  # behind a set point
    assert [quality for _, quality in rows] == [(), (BAD, 0, 0)] * 2 + [(), ()]
    assert [math.isnan(pv) for pv, _ in rows] == [False, True, False, True, False, True]
    export(tmp_path / "loop.journal", tmp_path / "loop.csv")
    table = pd.read_csv(tmp_path / "loop.csv")
    assert table["C_A.PV"].isna().tolist() == [False, True, False, True, False, True]
    assert table["T.PV"].isna().tolist() == [False] * 5 + [True]  # nothing was read at the last


def valued(uncertain: Any, *readings: NodeReading) -> Values:
    """What an endpoint makes of the answers to one request."""
    manifest = Controller(PID).manifest
    nodes = Nodes(**NODES)
    server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True, uncertain=uncertain)
    plan = NodePlan(nodes, manifest)
    ages = Ages(len(plan.timed))
    return NodeSampling(manifest, server, nodes).valued(plan, list(readings), ages, 100.0, unbeaten="", starts=0)


def reading(number: float, status: int = GOOD) -> NodeReading:
    return NodeReading(number, status, None, ua.VariantType.Double)


@pytest.mark.parametrize(
    ("uncertain", "fault", "read_back"),
    [("fault", "MV T_j: UncertainSensorNotAccurate", math.nan), ("use", "", 250.0)],
)
def test_uncertain_values_are_used_where_the_settings_say_so(uncertain: str, fault: str, read_back: float) -> None:
    values = valued(uncertain, reading(0.9), reading(330.0), reading(250.0, UNCERTAIN))
    assert (values.fault, values.quality) == (fault, (GOOD, GOOD, UNCERTAIN))
    assert np.array_equal(values.mv, [read_back], equal_nan=True)
    values = valued(uncertain, reading(0.9), reading(330.0, UNCERTAIN), reading(250.0))
    assert values.fault == fault.replace("MV T_j", "PV T")
    assert values.pv.tolist() == [0.9, 330.0]
    # What is bad is a fault under either setting.
    assert valued(uncertain, reading(0.9, BAD), reading(330.0), reading(250.0)).fault == "PV C_A: BadSensorFailure"


def test_uncertain_is_a_fault_unless_the_settings_say_otherwise() -> None:
    assert SERVER.uncertain == "fault"
