"""A server that refuses the heartbeat or the lease, and one that falls silent: each is said, and held."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from asyncua import ua
from processes import within

from loopwright.serving import Controller, EndpointError
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.link import node_id
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.opcua.values import LateError, NodeReading

pytest_plugins = ["small_laws"]
GOOD, REFUSED, MISMATCH = 0, ua.StatusCodes.BadNotWritable, ua.StatusCodes.BadTypeMismatch
BEAT, LEASE = "ns=2;s=beat", "ns=2;s=lease"


class MadeUpLink:
    """A server's answers without a server: ``refuses`` has a status by node, ``silent`` answers nothing."""

    def __init__(self) -> None:
        self.kinds = {BEAT: ua.VariantType.Int32}
        self.held: dict[str, Any] = {LEASE: ""}
        self.refuses: dict[str, int] = {}
        self.silent, self.opened, self.reads = False, 0, 0
        self.fails = ""  # why readings do
        self.gone, self.on_gone = "", lambda: None

    async def resolved(self, nodes: Sequence[str], _: float) -> list[ua.NodeId]:
        return [node_id(n, []) for n in nodes]

    async def namespaces(self, _: float, *, anew: bool = False) -> list[str]:
        return ["http://opcfoundation.org/UA/", "urn:server", "urn:plant"]

    async def beside(self, _: ua.NodeId, __: str, ___: float) -> list[ua.NodeId]:
        return []

    async def server_uri(self, _: float) -> str:
        return "urn:server"

    async def browsed(self, nodes: Sequence[ua.NodeId], _: int, __: float, *, inverse: bool = False) -> list[Any]:
        return [[] for _ in nodes]

    async def read(self, nodes: Sequence[ua.NodeId], _: float) -> list[NodeReading]:
        self.reads += 1
        if self.silent:
            raise LateError("it does not answer")
        if self.fails:
            raise EndpointError(self.fails)
        names = [n.to_string() for n in nodes]
        return [
            NodeReading(1.0, 0, None, self.kinds.get(n, ua.VariantType.Double), "", self.held.get(n, "")) for n in names
        ]

    async def values(
        self, nodes: Sequence[ua.NodeId], _: float, attribute: ua.AttributeIds = ua.AttributeIds.Value
    ) -> list[ua.DataValue]:
        if attribute is not ua.AttributeIds.Value:
            return [ua.DataValue() for _ in nodes]
        return [ua.DataValue(ua.Variant(self.held[n.to_string()])) for n in nodes]

    async def write(self, rows: Sequence[tuple[ua.NodeId, ua.Variant]], _: float) -> list[int]:
        found = []
        for node, value in rows:
            name = node.to_string()
            right = name not in self.kinds or value.VariantType is self.kinds[name]
            found.append(self.refuses.get(name, GOOD) if right else MISMATCH)
            if found[-1] == GOOD:
                self.held[name] = value.Value
        return found

    async def started_s(self, _: float) -> float:
        return 1.0

    async def close(self) -> None: ...

    def abort(self) -> None: ...


class Scanning:
    """An endpoint on that server, scanned by hand."""

    def __init__(
        self, controller: Controller, link: MadeUpLink, max_age_s: float = 5.0, rewrite_s: float = 0.0
    ) -> None:
        m = controller.manifest
        nodes = {g: {s.name: f"ns=2;s={g}.{s.name}" for s in m.signals(g)} for g in ("pv", "mv", "dv")}
        server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True, rewrite_s=rewrite_s)
        self.told: list[str] = []
        self.link = link
        self.endpoint = OpcUaEndpoint(
            m,
            server,
            Nodes(**nodes, heartbeat=BEAT, lease=LEASE),
            max_age_s=max_age_s,
            speed=25.0,
            tell=self.told.append,
            connect=self._connected,
        )
        self.endpoint.start()

    async def _connected(self, *_: object) -> Any:
        self.link.opened += 1
        return self.link

    def scan(self) -> str:
        """What is wrong with the sample or the last MV; empty: nothing."""
        before = self.link.reads
        try:
            fault = self.endpoint.read().fault
        except EndpointError as error:
            fault = str(error)
        try:
            self.endpoint.write(np.array([1.0]))
        except EndpointError as error:
            fault = fault or str(error)
        assert within(20, lambda: self.link.reads > before and not self.endpoint.sender.outbox)
        return fault

    def becomes(self, fault: str) -> bool:
        return within(20, lambda: self.scan() == fault)


@pytest.fixture
def link() -> MadeUpLink:
    return MadeUpLink()


@pytest.fixture
def scanning(controller: Controller, link: MadeUpLink) -> Iterator[Scanning]:
    made = Scanning(controller, link)
    assert made.becomes("")
    yield made
    made.endpoint.close()
    assert threading.current_thread() is not made.endpoint._thread
    assert not made.endpoint._thread.is_alive()


def test_a_heartbeat_that_is_refused_is_a_fault_until_it_is_taken(scanning: Scanning, link: MadeUpLink) -> None:
    link.refuses[BEAT] = REFUSED
    assert scanning.becomes("the server refuses heartbeat: BadNotWritable")
    link.refuses.clear()
    assert scanning.becomes("")


@pytest.mark.parametrize("kind", [ua.VariantType.Double, ua.VariantType.Boolean])
def test_a_heartbeat_of_another_type_is_counted_in_that_type(
    scanning: Scanning, link: MadeUpLink, kind: ua.VariantType
) -> None:
    link.kinds[BEAT] = kind
    assert scanning.becomes("the server refuses heartbeat: BadTypeMismatch")
    assert scanning.becomes("")
    assert link.opened == 1


def test_a_heartbeat_that_holds_no_number_is_a_fault(scanning: Scanning, link: MadeUpLink) -> None:
    link.kinds[BEAT] = ua.VariantType.String
    assert scanning.becomes("heartbeat: the node is of the type String, which holds no number")
    link.kinds[BEAT] = ua.VariantType.Int32
    assert scanning.becomes("")
    assert link.opened == 1


def test_a_lease_that_is_refused_is_lost_and_nothing_more_is_written(scanning: Scanning, link: MadeUpLink) -> None:
    assert within(20, lambda: scanning.scan() == "" and scanning.endpoint.sender.lease.held)
    link.refuses[LEASE] = REFUSED
    assert scanning.becomes("the server refuses lease: BadNotWritable")
    assert not scanning.endpoint.sender.lease.held
    mv = next(name for name in link.held if "mv." in name)
    link.held[mv] = "as it was left"
    for _ in range(10):
        scanning.scan()
    assert link.held[mv] == "as it was left"
    link.refuses.clear()
    assert within(20, lambda: scanning.scan() == "" and scanning.endpoint.sender.lease.held)
    assert link.held[mv] == 1.0


def test_a_lease_that_another_loop_took_is_told_also_while_the_mv_rests(
    controller: Controller, link: MadeUpLink
) -> None:
    """An MV that stands is not sent for a long time, and the other loop moves it meanwhile."""
    scanning = Scanning(controller, link, rewrite_s=1e9)
    try:
        assert within(20, lambda: scanning.scan() == "" and scanning.endpoint.sender.lease.held)
        for _ in range(5):
            assert scanning.scan() == ""
        mv = next(name for name in link.held if "mv." in name)
        link.held[mv], link.held[LEASE] = "as the other one has it", "other:1:a 1e6 1"
        assert scanning.becomes("the plant is controlled by other:1:a")
        assert link.held[LEASE] == "other:1:a 1e6 1"
        assert link.held[mv] == "as the other one has it"
        link.held[LEASE] = ""  # it has given it back
        assert within(20, lambda: scanning.scan() == "" and scanning.endpoint.sender.lease.held)
        assert link.held[mv] == 1.0
    finally:
        scanning.endpoint.close()


def test_a_connection_that_is_lost_by_silence_is_told_once_and_so_is_the_next_one(
    scanning: Scanning, link: MadeUpLink
) -> None:
    for n in (1, 2):
        link.silent = True
        assert scanning.becomes("it does not answer")
        assert within(20, lambda: scanning.told.count("it does not answer") == n)  # noqa: B023
        link.silent = False
        assert scanning.becomes("")
    connected = "connected to opc.tcp://127.0.0.1:1; lease nsu=urn:plant;s=lease"
    assert scanning.told == [connected, "it does not answer", connected, "it does not answer", connected]


def test_a_reading_that_fails_is_a_fault_however_young_the_one_before_may_be(
    controller: Controller, link: MadeUpLink
) -> None:
    """An answer that is late is judged by its age; one that says that nothing was read is not."""
    scanning = Scanning(controller, link, max_age_s=1e9)
    try:
        assert scanning.becomes("")
        endpoint = scanning.endpoint
        link.silent = True
        scanning.scan()
        assert within(20, lambda: endpoint.trouble == "it does not answer")
        assert endpoint.read().fault == ""
        link.silent, link.fails = False, "BadTooManyOperations"
        assert within(20, lambda: endpoint.trouble == "BadTooManyOperations")
        with pytest.raises(EndpointError, match="BadTooManyOperations"):
            endpoint.read()
        link.fails = ""
        assert scanning.becomes("")
    finally:
        scanning.endpoint.close()


def test_a_connection_that_the_server_has_ended_is_made_anew_at_once(scanning: Scanning, link: MadeUpLink) -> None:
    """Between two scans, and not after three that failed."""
    opened, reads = link.opened, link.reads
    link.gone = "BadSessionNotActivated"
    link.on_gone()
    assert within(20, lambda: "opc.tcp://127.0.0.1:1: BadSessionNotActivated" in scanning.told)
    link.gone = ""
    assert within(20, lambda: link.opened > opened)
    assert scanning.becomes("")
    assert link.reads > reads
