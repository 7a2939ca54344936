"""A plant behind an OPC UA server of a world, and the network to it: late, silent, gone, started anew, renumbered."""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any

from asyncua import ua

from loopwright.serving.manifest import Manifest
from world.virtual_time import VirtualTime

SPACE, OTHER = "urn:plant", "urn:somebody"
LEASE, HEARTBEAT, WATCHDOG = (f"nsu={SPACE};s={name}" for name in ("lease", "heartbeat", "watchdog"))
GOOD, BAD = ua.StatusCodes.Good, ua.StatusCodes.BadSensorFailure
USUAL_S, SLOWEST_S = (0.002, 0.05), 5.0  # one way of a message
TIME_CONSTANT = 12.0  # periods of the loop
PULL = 0.6  # of a PV's range by the whole range of an MV
NOISE = 0.002  # of a PV's range
DOUBLE = ua.VariantType.Double


@dataclass(slots=True)
class Item:
    """A node that holds a value."""

    value: Any
    kind: ua.VariantType = DOUBLE
    status: int = GOOD
    writable: bool = False
    stands_s: float | None = None  # since when it and its source time stand still
    shown: Any = None  # in the place of its value


@dataclass(frozen=True, slots=True)
class Written:
    """MVs that a server was asked to write, by whom and when; ``arrived`` where it took them."""

    time_s: float
    by: str
    mv: dict[str, float]
    owner: str  # of the lease when they came
    lost_s: dict[str, float]  # when each owner before that had it last
    taken: bool
    shown: bool  # whether a reading on this connection had come back before


@dataclass(slots=True)
class Network:
    """Faults of a connection: each until this time."""

    silent_until_s: float = -math.inf  # what is sent gets lost
    slow_until_s: float = -math.inf
    refused_until_s: float = -math.inf  # nothing listens


@dataclass(eq=False)
class PlantServer:
    """Nodes, a plant that moves with its MVs, and sessions. ``written`` has all MVs that came."""

    manifest: Manifest
    time: VirtualTime
    rng: random.Random
    network: Network = field(default_factory=Network)
    spaces: list[str] = field(default_factory=lambda: ["http://opcfoundation.org/UA/", "urn:server", SPACE])
    written: list[Written] = field(default_factory=list)
    refuses: bool = False  # to write MVs
    deleted: set[str] = field(default_factory=set)  # nodes that are not there now
    stamp_by_s: float = 0.0  # its clock beside the world's
    takes_s: tuple[float, float] = USUAL_S  # one way of a message, at least and at most
    answered_s: dict[str, float] = field(default_factory=dict)  # when each machine was last told all values
    had_lease_s: dict[str, float] = field(default_factory=dict)  # when each owner's name last stood in the lease

    def __post_init__(self) -> None:
        m, self.started_s = self.manifest, self.time.wall_s()
        self.items: dict[str, Item] = {"lease": Item("", ua.VariantType.String, writable=True)}
        self.items["heartbeat"] = Item(0, ua.VariantType.Int32, writable=True)
        self.items["watchdog"] = Item(0, ua.VariantType.Int32)
        for s in (*m.pv, *m.dv):
            self.items[s.name] = Item(s.middle)
        for s in m.mv:
            self.items[s.name] = Item(s.values[0] if s.values else s.middle, writable=True)
        self.sessions: set[object] = set()
        self._moved_s = self.time.now_s

    @property
    def mv(self) -> dict[str, float]:
        return {s.name: float(self.items[s.name].value) for s in self.manifest.mv}

    def start_anew(self) -> None:
        """Forget all sessions, and have begun now; its namespaces may be numbered another way."""
        self.sessions.clear()
        self.started_s = self.time.wall_s()

    def renumber(self, *others: str) -> None:
        """Start anew, with other namespaces in front of the plant's, where these are not there already."""
        spaces = [*self.spaces[:2], *others, SPACE]
        if spaces != self.spaces:
            self.spaces = spaces
            self.start_anew()

    # --------------------------------------------------------------------------------------------------------- plant
    def move(self) -> None:
        """The plant as it is now: each PV goes to where the MVs lead, with noise."""
        m, now = self.manifest, self.time.now_s
        share = 1 - math.exp(-(now - self._moved_s) / (TIME_CONSTANT * m.period_s))
        if share <= 0:
            return
        self._moved_s = now
        if self.items["watchdog"].stands_s is None:
            self.items["watchdog"].value = int(now / m.period_s)
        pull = sum((self.mv[s.name] - s.middle) / (s.high - s.low) for s in m.mv) / len(m.mv)
        for s in m.pv:
            item, span = self.items[s.name], s.high - s.low
            if item.stands_s is not None:
                continue
            item.value += share * (s.middle + PULL * span * pull - item.value)
            item.value += NOISE * span * self.rng.uniform(-1, 1)
            item.value = min(max(item.value, s.low), s.high)

    # ------------------------------------------------------------------------------------------------------ requests
    def read(self, node: ua.NodeId, attribute: int) -> ua.DataValue:
        """One attribute of a node."""
        stamp = datetime.fromtimestamp(self.time.wall_s() + self.stamp_by_s, UTC).replace(tzinfo=None)
        if int(node.NamespaceIndex) == 0:
            return _answer(self._of_server(node.Identifier), stamp)
        item = self._item(node)
        if item is None:
            return ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown))
        if attribute == ua.AttributeIds.DataType:
            return _answer(ua.NodeId(ua.ObjectIds.Double), stamp)
        if attribute != ua.AttributeIds.Value:
            return ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadAttributeIdInvalid))
        if item.stands_s is not None:
            stamp -= timedelta(seconds=self.time.now_s - item.stands_s)
        variant = ua.Variant(item.value, item.kind) if item.shown is None else ua.Variant(item.shown)
        return ua.DataValue(variant, ua.StatusCode(item.status), SourceTimestamp=stamp)

    def write(self, node: ua.NodeId, value: ua.Variant) -> int:
        """The status of a write of one node."""
        item = self._item(node)
        if item is None or not item.writable:
            return ua.StatusCodes.BadNodeIdUnknown if item is None else ua.StatusCodes.BadNotWritable
        if value.VariantType is not item.kind:
            return ua.StatusCodes.BadTypeMismatch
        if self.refuses and node.Identifier in self.mv:
            return ua.StatusCodes.BadNotWritable
        if node.Identifier == "lease":
            self.had_lease_s[str(item.value).partition(" ")[0]] = self.time.now_s
        item.value = value.Value
        return GOOD

    def _item(self, node: ua.NodeId) -> Item | None:
        at = int(node.NamespaceIndex)
        if node.Identifier in self.deleted:
            return None
        return self.items.get(str(node.Identifier)) if at < len(self.spaces) and self.spaces[at] == SPACE else None

    def _of_server(self, identifier: Any) -> Any:
        of = {
            ua.ObjectIds.Server_NamespaceArray: list(self.spaces),
            ua.ObjectIds.Server_ServerArray: ["urn:server"],
            ua.ObjectIds.Server_ServerStatus_StartTime: datetime.fromtimestamp(self.started_s, UTC).replace(
                tzinfo=None
            ),
            ua.ObjectIds.Server_ServerStatus_State: 0,
        }
        return of.get(identifier)


def _answer(value: Any, stamp: datetime) -> ua.DataValue:
    if value is None:
        return ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown))
    return ua.DataValue(ua.Variant(value), ua.StatusCode(GOOD), SourceTimestamp=stamp)


class Wire:
    """Messages of one connection. What was not yet delivered when it is reset never comes."""

    def __init__(self, server: PlantServer) -> None:
        self.server, self.reset = server, False
        self.shown, self.doubt_s = False, -math.inf  # whether a reading has told where the MVs stand; when one was lost
        self.session: object = None
        self.transport = SimpleNamespace(get_extra_info=lambda _: None, abort=self.abort)

    def doubts(self) -> None:
        """A write may not have come: only what is read from now on tells where the MVs stand."""
        self.shown, self.doubt_s = False, self.server.time.now_s

    def abort(self) -> None:
        self.reset = True
        self.server.sessions.discard(self.session)

    async def ask(self, answer: Callable[[], Any]) -> Any:
        """The server's answer to a message, both ways taking their time; for ever where the network is silent."""
        loop, done = self.server.time.loop, self.server.time.loop.create_future()

        def arrives() -> None:
            if self.reset or self._silent:
                return
            try:
                if self.session is not None and self.session not in self.server.sessions:
                    raise ua.UaStatusCodeError(ua.StatusCodes.BadSessionIdInvalid)
                found, raised = answer(), None
            except ua.UaStatusCodeError as error:
                found, raised = None, error

            def comes_back() -> None:
                if not (self.reset or self._silent or done.done()):
                    done.set_result(found) if raised is None else done.set_exception(raised)

            loop.call_later(self._takes_s(), comes_back)

        if not self._silent:
            loop.call_later(self._takes_s(), arrives)
        return await done

    @property
    def _silent(self) -> bool:
        return self.server.time.now_s < self.server.network.silent_until_s

    def _takes_s(self) -> float:
        rng, net = self.server.rng, self.server.network
        slow = self.server.time.now_s < net.slow_until_s
        return rng.uniform(0.0, SLOWEST_S) if slow else rng.uniform(*self.server.takes_s)


class PlantClient:
    """As much of asyncua's client as a loop's connection uses."""

    def __init__(self, server: PlantServer, by: str) -> None:
        self.server, self.by = server, by
        self.application_uri, self.session_timeout = "", 60_000.0
        self._renew_channel_task = None
        self.wire: Wire | None = Wire(server)
        self.uaclient = SimpleNamespace(protocol=None, session=self, security_policy=None)

    async def connect(self) -> None:
        wire = self.uaclient.protocol = self.wire
        if self.server.time.now_s < self.server.network.refused_until_s:
            await asyncio.sleep(0.001)
            raise ConnectionRefusedError
        await wire.ask(lambda: None)
        wire.session = object()
        self.server.sessions.add(wire.session)

    async def disconnect(self) -> None:
        await self.uaclient.protocol.ask(lambda: None)

    async def read(self, asked: ua.ReadParameters) -> list[ua.DataValue]:
        def answer() -> list[ua.DataValue]:
            self.server.move()
            return [self.server.read(row.NodeId, row.AttributeId) for row in asked.NodesToRead]

        wire, began_s = self.uaclient.protocol, self.server.time.now_s
        found = list(await wire.ask(answer))
        of_value = {str(row.NodeId.Identifier) for row in asked.NodesToRead if row.AttributeId == ua.AttributeIds.Value}
        if of_value >= {*self.server.mv, *(s.name for s in self.server.manifest.pv)}:
            self.server.answered_s[self.by] = self.server.time.now_s
            wire.shown = wire.shown or began_s >= wire.doubt_s
        return found

    async def write(self, asked: ua.WriteParameters) -> list[ua.StatusCode]:
        wire = self.uaclient.protocol
        of_mv = any(str(row.NodeId.Identifier) in self.server.mv for row in asked.NodesToWrite)

        def answer() -> list[ua.StatusCode]:
            server = self.server
            server.move()
            owner = str(server.items["lease"].value).partition(" ")[0]
            found = [server.write(row.NodeId, row.Value.Value) for row in asked.NodesToWrite]
            wanted = {str(r.NodeId.Identifier): r.Value.Value.Value for r in asked.NodesToWrite}
            if of_mv:
                taken = all(status == GOOD for status in found)
                server.written.append(
                    Written(server.time.now_s, self.by, wanted, owner, dict(server.had_lease_s), taken, wire.shown)
                )
                if not taken:
                    wire.doubts()
            return [ua.StatusCode(status) for status in found]

        try:
            return list(await wire.ask(answer))
        except BaseException:  # no answer in time
            if of_mv:
                wire.doubts()
            raise

    async def browse(self, asked: ua.BrowseParameters) -> list[ua.BrowseResult]:
        return list(await self.uaclient.protocol.ask(lambda: [ua.BrowseResult() for _ in asked.NodesToBrowse]))

    async def translate_browsepaths_to_nodeids(self, paths: Sequence[ua.BrowsePath]) -> list[ua.BrowsePathResult]:
        return list(await self.uaclient.protocol.ask(lambda: [ua.BrowsePathResult() for _ in paths]))
