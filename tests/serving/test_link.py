"""Deadlines of a connection, against a library that raises what it should not."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from asyncua import ua
from processes import within

from loopwright.serving import Controller
from loopwright.serving.errors import EndpointError, LoopError
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.limits import OperationLimits, Pieces, TooManyError, in_pieces
from loopwright.serving.opcua.link import Link, node_id
from loopwright.serving.opcua.node_lease import SeveralLeasesError, beside
from loopwright.serving.opcua.plan import NodePlan
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.opcua.values import LateError, NodeReading, in_time

pytest_plugins = ["small_laws"]


class OwnKindOfCancellation(asyncio.CancelledError):
    """As wait_for2 raises it where an answer comes in the moment of its deadline."""


async def forever(ended: list[str]) -> None:
    try:
        await asyncio.Event().wait()
    finally:
        ended.append("cancelled")


async def raising(error: BaseException) -> None:
    raise error


def test_what_takes_too_long_is_cancelled() -> None:
    ended: list[str] = []

    async def run() -> None:
        with pytest.raises(TimeoutError):
            await in_time(forever(ended), 0.01)
        await asyncio.sleep(0)

    asyncio.run(run())
    assert ended == ["cancelled"]


@pytest.mark.parametrize(
    ("raised", "seen"),
    [(OwnKindOfCancellation(), ConnectionError), (OSError("no route"), OSError), (TimeoutError(), TimeoutError)],
)
def test_what_a_library_raises_is_an_error_and_no_cancellation(raised: BaseException, seen: type[Exception]) -> None:
    async def run() -> None:
        with pytest.raises(seen):
            await in_time(raising(raised), 1.0)

    asyncio.run(run())


def test_whatever_ends_the_thread_the_plant_is_to_be_reached_again(controller: Controller) -> None:
    tries, told = [0], list[str]()

    async def opened(_: Server, __: float) -> Link:
        tries[0] += 1
        raise OwnKindOfCancellation if tries[0] == 1 else OSError("refused")

    m = controller.manifest
    nodes = Nodes(**{g: {s.name: "ns=2;s=x" for s in m.signals(g)} for g in ("pv", "mv", "dv")})
    server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True)
    endpoint = OpcUaEndpoint(m, server, nodes, max_age_s=1.0, tell=told.append, connect=opened)
    endpoint.start()
    try:
        assert within(10, lambda: tries[0] > 2)
    finally:
        endpoint.close()
    assert told[0] == "the connection's thread begins anew: OwnKindOfCancellation"
    assert not endpoint._thread.is_alive()


@pytest.mark.parametrize(
    ("told", "takes", "sizes"), [(0, 9, [7]), (3, 9, [3, 3, 1]), (0, 2, [7, 3, 1, 1, 1, 1, 1, 1, 1])]
)
def test_a_server_is_asked_for_no_more_than_it_takes(told: int, takes: int, sizes: list[int]) -> None:
    """By what it tells, or where it tells nothing by what it refuses; the next request begins where this one ended."""
    asked, pieces = list[int](), Pieces(told)

    async def ask(piece: Sequence[int], left_s: float) -> list[int]:
        asked.append(len(piece))
        assert left_s > 0
        if len(piece) > takes:
            raise TooManyError("BadTooManyOperations")
        return [-n for n in piece]

    assert asyncio.run(in_pieces(range(7), pieces, ask, 5.0)) == [-n for n in range(7)]
    assert asked == sizes
    asked.clear()
    asyncio.run(in_pieces(range(7), pieces, ask, 5.0))
    assert max(asked) <= takes


@pytest.mark.parametrize("answers", [0, 3])
def test_a_server_that_gives_another_number_of_answers_is_a_fault(answers: int) -> None:
    async def ask(piece: Sequence[int], _: float) -> list[int]:
        return [0] * answers

    with pytest.raises(EndpointError):
        asyncio.run(in_pieces(range(2), Pieces(), ask, 5.0))


def test_limits_that_a_server_does_not_tell_are_none() -> None:
    def limit(value: object, kind: ua.VariantType) -> ua.DataValue:
        return ua.DataValue(ua.Variant(value, kind))

    found = OperationLimits.told([limit(20, ua.VariantType.UInt32), limit(0, ua.VariantType.UInt32), ua.DataValue()])
    assert [found.read.most, found.write.most, found.browse.most] == [20, 0, 0]


def test_the_pieces_of_a_request_share_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each half of what a server refused had the whole time anew."""
    now, left = [0.0], list[float]()
    monkeypatch.setattr(time, "monotonic", lambda: now[0])

    async def ask(piece: Sequence[int], left_s: float) -> list[int]:
        left.append(left_s)
        now[0] += 1.0
        if len(piece) > 2:
            raise TooManyError("BadTooManyOperations")
        return list(piece)

    asyncio.run(in_pieces(range(8), Pieces(), ask, 5.0))
    assert left == [5.0, 4.0, 3.0, 2.0, 1.0, 0.0]


class Session:
    """A server that answers a browse with one reference at a time, to at most ``points`` nodes in one request."""

    def __init__(self, references: int, points: int = 99) -> None:
        self.references, self.points = references, points
        self.open: dict[bytes, int] = {}

    def _part(self, node: bytes, k: int) -> ua.BrowseResult:
        found = ua.BrowseResult()
        found.References = [ua.ReferenceDescription(NodeId=ua.NodeId(f"{node.decode()} {k}", 2))]
        if k + 1 < self.references:
            self.open[node] = k + 1
            found.ContinuationPoint = node
        return found

    async def browse(self, request: ua.BrowseParameters) -> list[ua.BrowseResult]:
        rows = []
        for n in request.NodesToBrowse:
            full = len(self.open) >= self.points
            refused = ua.BrowseResult(StatusCode=ua.StatusCode(ua.StatusCodes.BadNoContinuationPoints))
            rows.append(refused if full else self._part(n.NodeId.Identifier.encode(), 0))
        return rows

    async def browse_next(self, request: ua.BrowseNextParameters) -> list[ua.BrowseResult]:
        return [self._part(p, self.open.pop(p)) for p in request.ContinuationPoints]

    async def read(self, _: ua.ReadParameters) -> list[ua.DataValue]:
        raise ua.UaStatusCodeError(ua.StatusCodes.BadResponseTooLarge)


def link_of(session: Session) -> Link:
    client: Any = SimpleNamespace(uaclient=SimpleNamespace(session=session, protocol=1))
    return Link(client, Server("opc.tcp://127.0.0.1:1", security="None", insecure=True))


@pytest.mark.parametrize("points", [99, 2, 1])
def test_a_browse_that_is_answered_in_parts_is_read_to_its_end(points: int) -> None:
    """A unit in the second part was not seen, and the points stayed open until the server had none left."""
    session = Session(3, points)
    nodes = [ua.NodeId(f"n{i}", 2) for i in range(3)]
    found = asyncio.run(link_of(session).browsed(nodes, ua.ObjectIds.HasProperty, 5.0))
    assert [[r.NodeId.Identifier for r in rows] for rows in found] == [
        [f"n{i} {k}" for k in range(3)] for i in range(3)
    ]
    assert session.open == {}


def test_a_request_that_is_too_large_for_a_server_is_made_smaller() -> None:
    link = link_of(Session(1))
    with pytest.raises(TooManyError, match="BadResponseTooLarge"):
        asyncio.run(link.values([ua.NodeId(1), ua.NodeId(2)], 5.0))
    assert link.limits.read.most == 1


class Folders:
    """A server whose folders hold some leases."""

    gone = ""

    def __init__(self, *leases: str) -> None:
        self.leases, self.kind, self.fails = leases, ua.VariantType.String, None

    async def beside(self, node: ua.NodeId, _: str, __: float) -> list[ua.NodeId]:
        if self.fails is not None:
            raise self.fails
        return [ua.NodeId(n, 2) for n in self.leases if n.startswith(str(node.Identifier)[0])]

    async def read(self, nodes: Sequence[ua.NodeId], _: float) -> list[NodeReading]:
        return [NodeReading(float("nan"), 0, None, self.kind) for _ in nodes]

    async def values(self, nodes: Sequence[ua.NodeId], _: float, __: int) -> list[ua.DataValue]:
        return [ua.DataValue(ua.Variant(3, ua.VariantType.Byte)) for _ in nodes]


def test_a_lease_is_found_beside_any_mv_and_never_missed_because_an_answer_was_late() -> None:
    """A late answer, or a lease in each of two folders, let the loop write without one, and nobody was told."""
    written = [ua.NodeId("a1", 2), ua.NodeId("b1", 2)]

    def found(folders: Any) -> ua.NodeId | None:
        return asyncio.run(beside(folders, written, 1.0))

    assert found(Folders()) is None
    assert found(Folders("b lease")) == ua.NodeId("b lease", 2)
    with pytest.raises(SeveralLeasesError, match=r"name one by nodes\.lease"):
        found(Folders("a lease", "b lease"))
    folders: Any = Folders("a lease", "b lease")
    folders.kind = ua.VariantType.Int32  # no text, so no lease
    assert found(folders) is None
    folders.fails = EndpointError("BadServiceUnsupported")
    assert found(folders) is None
    folders.fails = LateError("late")
    with pytest.raises(LateError):
        found(folders)


@pytest.mark.parametrize("also", ["heartbeat", "MV b"])
def test_what_is_written_as_an_mv_is_written_as_nothing_else(also: str, controller: Controller) -> None:
    """Two MVs of one loop.toml on one node, spelt two ways: nothing objected."""
    signals = [replace(controller.manifest.mv[0], name=name) for name in ("a", "b")]
    manifest = replace(controller.manifest, mv=tuple(signals))
    pv, dv = ({s.name: f"ns=2;s={s.name}" for s in manifest.signals(g)} for g in ("pv", "dv"))
    mv = {"a": "ns=2;s=a", "b": "ns=2;s=b" if also == "heartbeat" else "nsu=u;s=a"}
    nodes = Nodes(pv, mv, dv, heartbeat="nsu=u;s=a" if also == "heartbeat" else "")

    class Resolving:
        async def resolved(self, texts: Sequence[str], _: float) -> list[ua.NodeId]:
            return [node_id(t, ["", "", "u"]) for t in texts]

    with pytest.raises(LoopError, match=f"MV a and {also} are one node, ns=2;s=a; give each its own"):
        asyncio.run(NodePlan.made(Resolving(), manifest, nodes, 1.0))  # type: ignore[arg-type]


def test_where_there_are_several_leases_nothing_is_written_and_all_is_read(controller: Controller) -> None:
    class Several(Folders):
        async def resolved(self, texts: Sequence[str], _: float) -> list[ua.NodeId]:
            return [node_id(t, []) for t in texts]

        async def read(self, nodes: Sequence[ua.NodeId], _: float) -> list[NodeReading]:
            kinds = [self.kind if "lease" in str(n.Identifier) else ua.VariantType.Double for n in nodes]
            return [NodeReading(1.0, 0, None, kind) for kind in kinds]

    m = controller.manifest
    nodes = Nodes(**{g: {s.name: f"ns=2;s=a {s.name}" for s in m.signals(g)} for g in ("pv", "mv", "dv")})
    plan = asyncio.run(NodePlan.made(Several("a lease", "a lease too"), m, nodes, 1.0))  # type: ignore[arg-type]
    assert plan.lease is None
    assert plan.unwritable.startswith("lease: there are 2 nodes LoopwrightLease beside the MVs")
    server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True)
    endpoint: Any = OpcUaEndpoint(m, server, nodes, max_age_s=1.0)
    endpoint._link, sender = object(), endpoint.sender
    sender.barred, sender.told_on, sender.shown_on = plan.unwritable, 1, 1
    with pytest.raises(EndpointError, match="lease: there are 2 nodes"):
        endpoint.write([50.0])
    assert not sender.outbox
