"""Nodes that are others than when the loop began: another namespace, type, unit or range is held, and named."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asyncua import ua

from loopwright.serving import Controller
from loopwright.serving.errors import EndpointError
from loopwright.serving.journal import Journal
from loopwright.serving.manifest import Manifest
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.link import node_id
from loopwright.serving.opcua.nameplates import ChangedNodeError, Nameplates, by_name, identity, others_since
from loopwright.serving.opcua.plan import NodePlan
from loopwright.serving.opcua.sampling import Ages, NodeSampling, Values
from loopwright.serving.opcua.settings import ModeNode, Nodes, Point, Server
from loopwright.serving.opcua.values import BusyError, LateError, NodeReading
from loopwright.serving.station.build_loop import keep_namespaces, keep_nodes, namespaces_before, nodes_before
from loopwright.serving.station.requests import NodeRequests

pytest_plugins = ["small_laws"]
UA_SPACE = "http://opcfoundation.org/UA/"
DOUBLE, INT32, STRING = ua.VariantType.Double, ua.VariantType.Int32, ua.VariantType.String
UNITS = {"SP": "m", "level": "m", "T": "K", "inflow": "l/s", "valve": "%"}


class MadeUpLink:
    """A server that was started with some namespaces, and whose nodes tell a type, a unit and a range."""

    def __init__(self, *spaces: str) -> None:
        self.spaces, self.gone = [UA_SPACE, "urn:server", *spaces], ""
        self.kinds: dict[str, ua.VariantType] = {}
        self.units: dict[str, str] = {}
        self.ends: dict[str, float] = {}
        self.declared: dict[str, int] = {}  # DataType by node
        self.fails: EndpointError | None = None  # how each browse ends

    async def namespaces(self, _: float, *, anew: bool = False) -> list[str]:
        return self.spaces

    async def beside(self, _: ua.NodeId, __: str, ___: float) -> list[ua.NodeId]:
        return []

    async def server_uri(self, _: float) -> str:
        return "urn:server"

    async def resolved(self, nodes: Sequence[str], _: float) -> list[ua.NodeId]:
        return [node_id(n, self.spaces) for n in nodes]

    async def read(self, nodes: Sequence[ua.NodeId], _: float) -> list[NodeReading]:
        return [NodeReading(1.0, 0, None, self.kinds.get(str(n.Identifier), DOUBLE)) for n in nodes]

    async def browsed(
        self, nodes: Sequence[ua.NodeId], _: int, __: float, *, inverse: bool = False
    ) -> list[list[ua.ReferenceDescription]]:
        names = ("EngineeringUnits", "EURange")
        if self.fails is not None:
            raise self.fails
        return [
            [
                ua.ReferenceDescription(
                    NodeId=ua.NodeId(f"{n.Identifier} {name}", 2), BrowseName=ua.QualifiedName(name)
                )
                for name in names
            ]
            for n in nodes
        ]

    async def values(
        self, nodes: Sequence[ua.NodeId], _: float, attribute: ua.AttributeIds = ua.AttributeIds.Value
    ) -> list[ua.DataValue]:
        found = []
        if attribute is ua.AttributeIds.DataType:
            kinds = [self.declared.get(str(n.Identifier), ua.ObjectIds.Double) for n in nodes]
            return [ua.DataValue(ua.Variant(ua.NodeId(k), ua.VariantType.NodeId)) for k in kinds]
        for node in nodes:
            of, _, what = str(node.Identifier).rpartition(" ")
            unit = ua.EUInformation(DisplayName=ua.LocalizedText(self.units.get(of, UNITS[of])))
            given: Any = unit if what == "EngineeringUnits" else ua.Range(Low=0.0, High=self.ends.get(of, 100.0))
            found.append(ua.DataValue(ua.Variant(given, ua.VariantType.ExtensionObject)))
        return found


def nodes_of(m: Manifest, head: str) -> Nodes:
    groups: Any = {g: {s.name: f"{head};s={s.name}" for s in m.signals(g)} for g in ("pv", "mv", "dv")}
    return Nodes(**groups, sp={"level": f"{head};s=SP"}, mode=ModeNode(f"{head};s=mode", {"AUTO": 1.0}))


@pytest.fixture
def manifest(controller: Controller) -> Manifest:
    return controller.manifest


def connected(link: Any, made: Nameplates) -> NodePlan:
    """What the endpoint does at each connection."""

    async def act() -> NodePlan:
        await made.require_spaces(link, 1.0)
        plan = await NodePlan.made(link, made.manifest, made.nodes, 1.0)
        await made.look(link, plan, 1.0)
        return plan

    return asyncio.run(act())


def test_a_number_that_stands_for_another_namespace_is_no_node_of_this_loop(manifest: Manifest) -> None:
    """A server that was started anew had its namespaces the other way round: the loop wrote another unit's valve."""
    made = Nameplates(nodes_of(manifest, "ns=2"), manifest)
    connected(MadeUpLink("urn:one", "urn:two"), made)
    for other, advice in (
        (("urn:two", "urn:one"), r"; write nsu=urn:one;s=level in loop\.toml"),
        (("urn:two",), r"no namespace urn:one any more: if urn:two is .* write nsu=urn:two;s=level in loop\.toml"),
        ((), "the server has the namespaces .*, urn:server$"),
    ):
        with pytest.raises(ChangedNodeError, match=advice):
            connected(MadeUpLink(*other), made)
    connected(MadeUpLink("urn:one", "urn:three"), made)  # it is there again, and what lies behind it is no matter
    by_name = Nameplates(nodes_of(manifest, "nsu=urn:one"), manifest)
    assert connected(MadeUpLink("urn:one", "urn:two"), by_name).asked[0].NamespaceIndex == 2
    assert connected(MadeUpLink("urn:two", "urn:one"), by_name).asked[0].NamespaceIndex == 3
    with pytest.raises(EndpointError, match="no namespace 'urn:one'"):
        connected(MadeUpLink("urn:two"), by_name)


def test_a_namespace_that_is_not_told_once_is_no_other_one(manifest: Manifest, tmp_path: Path) -> None:
    """It was kept as a nameless one, and the loop refused its server for good, with "write nsu=;s=level"."""
    made, silent = Nameplates(nodes_of(manifest, "ns=2"), manifest), MadeUpLink("urn:one")
    silent.spaces = []
    connected(silent, made)
    assert asyncio.run(identity(silent, made.nodes, 1.0, 1.0)).spaces == made.spaces == {}  # type: ignore[arg-type]
    connected(MadeUpLink("urn:one"), made)
    with pytest.raises(ChangedNodeError, match="the server does not say what it is now"):
        connected(silent, made)
    assert made.spaces == {2: "urn:one"}
    journal = Journal(tmp_path / "loop.journal")
    keep_namespaces(journal, "opc.tcp://localhost:4840", {2: "", 3: "urn:two"})  # of a release that kept it so
    journal.close()
    assert namespaces_before(journal.path, "opc.tcp://127.0.0.1:4840") == {3: "urn:two"}


@pytest.mark.parametrize(
    ("text", "named"),
    [("ns=2;s=A;ns=1;x", "nsu=u;s=A;ns=1;x"), ("i=5;ns=2", "nsu=u;i=5"), ("ns=2;s=TIC.PV", "nsu=u;s=TIC.PV")],
)
def test_an_id_by_its_namespaces_name_is_the_same_node(text: str, named: str) -> None:
    assert by_name(text, "u") == named
    assert node_id(named, ["", "", "u"]) == node_id(text, [])
    with pytest.raises(EndpointError, match="is no node id"):
        node_id("nsu=u;i=5;ns=1", ["", "", "u"])


def test_what_a_number_stood_for_outlives_the_loop(manifest: Manifest, tmp_path: Path) -> None:
    journal = Journal(tmp_path / "loop.journal")
    made = Nameplates(nodes_of(manifest, "ns=2"), manifest)
    connected(MadeUpLink("urn:one"), made)
    keep_namespaces(journal, "opc.tcp://a:1", made.spaces)
    journal.close()
    assert namespaces_before(journal.path, "opc.tcp://b:1") == {}
    assert namespaces_before(tmp_path / "none", "opc.tcp://a:1") == {}
    after = Nameplates(made.nodes, manifest, namespaces_before(journal.path, "opc.tcp://a:1"))
    with pytest.raises(ChangedNodeError):
        connected(MadeUpLink("urn:two"), after)
    connected(MadeUpLink("urn:one"), after)


def valued(made: Nameplates, plan: NodePlan, **kinds: ua.VariantType) -> Values:
    """The values of a reading in which some nodes have another type."""
    server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True)
    answers = [NodeReading(1.0, 0, None, kinds.get(row.name.replace(" ", "_"), DOUBLE)) for row in plan.rows]
    sampling = NodeSampling(made.manifest, server, made.nodes, made)
    return sampling.valued(plan, answers, Ages(len(plan.timed)), 0.0, unbeaten="", starts=0)


@pytest.mark.parametrize("name", ["PV level", "MV valve", "DV inflow", "SP level", "mode"])
def test_a_node_of_another_type_is_a_fault_while_it_is(name: str, manifest: Manifest) -> None:
    """A PV went on in AUTO when its Double became an integer.

    A value of the wrong type is no wish either; but nothing is wrong with the sample then, which once was refused.
    """
    made = Nameplates(nodes_of(manifest, "ns=2"), manifest)
    plan = connected(MadeUpLink("urn:one"), made)
    wish = name in {"SP level", "mode"}
    used = not wish and ("dv" in manifest.inputs or not name.startswith("DV"))
    assert valued(made, plan).fault == ""
    other = valued(made, plan, **{name.replace(" ", "_"): INT32})
    assert other.fault.startswith(f"{name}: its type is Int32 now and was Double") is used
    asked = NodeRequests()
    assert [len(asked.refused(v)) for v in (other, other, valued(made, plan), other)] == [wish, 0, 0, wish]
    assert (other.asked_mode, bool(other.asked_sp)) == ("" if name == "mode" else "AUTO", name != "SP level")
    assert np.isnan(other.mv[0]) == (name == "MV valve")
    assert valued(made, plan).fault == ""


def written_elsewhere(m: Manifest) -> Nodes:
    """A valve that is read back from another node than the loop writes."""
    nodes = nodes_of(m, "ns=2")
    return replace(nodes, mv={"valve": Point("ns=2;s=to", read_back="ns=2;s=valve")})


@pytest.mark.parametrize("told", [{"kinds": {"to": INT32}}, {"units": {"to": "m"}}, {"ends": {"to": 27_648.0}}])
def test_an_mv_whose_written_node_is_another_one_is_not_written_and_its_sample_is_good(
    told: dict[str, Any], manifest: Manifest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shadow, which writes nothing, was at fault at every scan."""
    monkeypatch.setitem(UNITS, "to", "%")
    made, link = Nameplates(written_elsewhere(manifest), manifest), MadeUpLink("urn:one")
    plan = connected(link, made)
    assert made.unwritable == ""
    for name, values in told.items():
        setattr(link, name, values)
    for again in (lambda: connected(link, made), lambda: asyncio.run(made.again(link, plan, 1.0))):  # type: ignore[arg-type]
        again()
        assert made.unwritable.startswith("MV valve, written: ")
        assert made.fault == valued(made, plan).fault == ""
    server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True)
    endpoint = OpcUaEndpoint(manifest, server, made.nodes, max_age_s=1.0)
    endpoint.nameplates, endpoint._link = made, link  # type: ignore[assignment]
    endpoint.sender.told_on = endpoint.sender.shown_on = 1
    with pytest.raises(EndpointError, match="MV valve, written: "):
        endpoint.write(np.array([50.0]))
    endpoint.sender.outbox.append(np.array([50.0]))  # passed on before it was known
    asyncio.run(endpoint.sender.send(link, plan, made))  # type: ignore[arg-type]
    assert endpoint.sender.unwritten == made.unwritable
    link.kinds, link.units, link.ends = {}, {}, {}
    asyncio.run(made.again(link, plan, 1.0))  # type: ignore[arg-type]
    assert made.unwritable == ""


def test_a_set_point_whose_unit_is_another_one_is_no_wish(manifest: Manifest) -> None:
    made, link = Nameplates(nodes_of(manifest, "ns=2"), manifest), MadeUpLink("urn:one")
    plan = connected(link, made)
    link.units["SP"] = "mm"
    asyncio.run(made.again(link, plan, 1.0))  # type: ignore[arg-type]
    values = valued(made, plan)
    assert (values.fault, values.asked_sp, list(values.unheard)) == ("", {}, ["SP level"])


@pytest.mark.parametrize("declared", [ua.ObjectIds.Number, ua.ObjectIds.BaseDataType])
def test_a_node_that_is_declared_to_hold_any_number_may_hold_any(declared: int, manifest: Manifest) -> None:
    """A whole number that somebody typed there is an Int64 on some servers; a truth value or a text is no number."""
    link = MadeUpLink("urn:one")
    link.declared = dict.fromkeys((*UNITS, "mode"), declared)
    made = Nameplates(nodes_of(manifest, "ns=2"), manifest)
    plan = connected(link, made)
    valued(made, plan)
    whole = dict.fromkeys((row.name.replace(" ", "_") for row in plan.rows), INT32)
    assert (valued(made, plan, **whole).fault, valued(made, plan, **whole).unheard) == ("", {})
    assert valued(made, plan, PV_level=ua.VariantType.Boolean).fault.startswith("PV level: its type is Boolean now")
    link.kinds["valve"] = INT32
    connected(link, made)
    assert made.unwritable == ""


def test_another_unit_or_range_is_a_fault_while_it_is(manifest: Manifest) -> None:
    made, link = Nameplates(nodes_of(manifest, "ns=2"), manifest), MadeUpLink("urn:one")
    plan = connected(link, made)
    assert made.fault == ""
    for told, words in (({"units": {"T": "degC"}}, "unit is degC now and was K"), ({"ends": {"T": 200.0}}, "range is")):
        for name, values in told.items():
            setattr(link, name, values)
        asyncio.run(made.again(link, plan, 1.0))  # type: ignore[arg-type]
        assert made.fault.startswith(f"PV T: its {words}")
        assert valued(made, plan).fault == made.fault
        link.units, link.ends = {}, {}
        asyncio.run(made.again(link, plan, 1.0))  # type: ignore[arg-type]
        assert made.fault == valued(made, plan).fault == ""


@pytest.mark.parametrize("told", [{"units": {"T": "degC"}}, {"ends": {"T": 200.0}}])
def test_only_the_unit_or_range_itself_ends_its_fault(told: dict[str, Any], manifest: Manifest) -> None:
    """One late answer, or a server that refused once, cleared the fault: the loop went on in AUTO on another unit."""
    made, link = Nameplates(nodes_of(manifest, "ns=2"), manifest), MadeUpLink("urn:one")
    plan = connected(link, made)
    for name, values in told.items():
        setattr(link, name, values)
    asyncio.run(made.again(link, plan, 1.0))  # type: ignore[arg-type]
    fault = made.fault
    for fails in (LateError("late"), BusyError("BadTimeout"), EndpointError("BadServiceUnsupported")):
        link.fails = fails
        if isinstance(fails, LateError | BusyError):
            with pytest.raises(type(fails)):
                asyncio.run(made.again(link, plan, 1.0))  # type: ignore[arg-type]
            with pytest.raises(type(fails)):
                connected(link, made)
        else:
            asyncio.run(made.again(link, plan, 1.0))  # type: ignore[arg-type]
            connected(link, made)
        assert made.fault == fault != ""
    link.fails, link.units, link.ends = None, {}, {}
    asyncio.run(made.again(link, plan, 1.0))  # type: ignore[arg-type]
    assert made.fault == ""


def test_what_a_node_was_outlives_the_loop_and_another_one_is_told(manifest: Manifest, tmp_path: Path) -> None:
    """A node that was changed while the loop was down was accepted without a word."""
    journal, link = Journal(tmp_path / "loop.journal"), MadeUpLink("urn:one")
    assert nodes_before(tmp_path / "none") == {}
    first = Nameplates(nodes_of(manifest, "ns=2"), manifest)
    keep_nodes(journal, first.seen(connected(link, first)))
    journal.close()
    before = nodes_before(journal.path)
    assert before["PV T"] == ("ns=2;s=T", "Double", "K", "0 .. 100")
    link.units["T"], link.ends["valve"], link.kinds["level"] = "degC", 200.0, INT32
    second = Nameplates(first.nodes, manifest)
    told = others_since(before, second.seen(connected(link, second)))
    assert [line.split(" now")[0] for line in told] == [
        "PV level: its type is Int32",
        "PV T: its unit is degC",
        "MV valve: its range is 0 .. 200",
        "MV valve, written: its range is 0 .. 200",
    ]
    respelt = Nameplates(nodes_of(manifest, "nsu=urn:one"), manifest)
    assert others_since(before, respelt.seen(connected(link, respelt))) == []


def test_a_unit_that_never_was_the_controllers_is_a_fault_of_the_first_connection(manifest: Manifest) -> None:
    """`loop run` asks before it begins, but not a server that is not there yet; what loop.toml explains is right."""
    link = MadeUpLink("urn:one")
    link.units["T"] = "degC"
    made = Nameplates(nodes_of(manifest, "ns=2"), manifest)
    connected(link, made)
    assert made.fault.startswith("PV T: the server says the unit is degC, the controller's is K")
    pv = {**made.nodes.pv, "T": Point("ns=2;s=T", offset=273.15)}
    explained = Nameplates(Nodes(pv, made.nodes.mv, made.nodes.dv), manifest)
    connected(link, explained)
    assert explained.fault == ""


def test_a_node_is_the_same_however_it_is_spelt_and_on_another_server_another_one(manifest: Manifest) -> None:
    def keys(link: Any, head: str, started_s: float | None) -> list[str]:
        return list(asyncio.run(identity(link, nodes_of(manifest, head), started_s, 1.0)).writes)

    link = MadeUpLink("urn:one", "urn:two")
    numbered = keys(link, "ns=2", 1.5)
    assert len(numbered) == 1
    assert keys(link, "nsu=urn:one", 1.5) == numbered
    assert keys(link, "ns=3", 1.5) != numbered
    assert keys(link, "ns=2", 2.5) != numbered  # of the same name and make, started at another time
    assert keys(MadeUpLink("urn:one", "urn:added"), "ns=2", 1.5) == numbered  # it may add some while it runs
    assert keys(link, "ns=2", None) == []  # one that does not tell when it started may be another one
    found = asyncio.run(identity(link, nodes_of(manifest, "ns=2"), None, 1.0))  # type: ignore[arg-type]
    assert found.nodes == {"nsu=urn:one;s=valve": "ns=2;s=valve"}
