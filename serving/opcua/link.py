"""One connection to an OPC UA server: nodes by name, values with quality and time, values in a node's own type."""

from __future__ import annotations

import asyncio
import math
import socket
import struct
from collections.abc import Awaitable, Sequence
from contextlib import suppress
from datetime import datetime
from typing import Any, NamedTuple, TypeVar

import numpy as np
from asyncua import Client, ua
from asyncua.crypto import security_policies

from serving.errors import EndpointError, LoopError
from serving.opcua.certificates import APPLICATION, require_valid
from serving.opcua.settings import Server
from serving.words import named

T = TypeVar("T")

INTEGERS = {
    t: (low, high)
    for t, low, high in (
        (ua.VariantType.SByte, -(2**7), 2**7 - 1),
        (ua.VariantType.Byte, 0, 2**8 - 1),
        (ua.VariantType.Int16, -(2**15), 2**15 - 1),
        (ua.VariantType.UInt16, 0, 2**16 - 1),
        (ua.VariantType.Int32, -(2**31), 2**31 - 1),
        (ua.VariantType.UInt32, 0, 2**32 - 1),
        (ua.VariantType.Int64, -(2**63), 2**63 - 1),
        (ua.VariantType.UInt64, 0, 2**64 - 1),
    )
}
FLOATS = {ua.VariantType.Float, ua.VariantType.Double}
EPOCH = datetime(1970, 1, 1)
GOOD, UNCERTAIN, BAD = 0, 1, 2  # the two highest bits of a status


class Reading(NamedTuple):
    """A node's value. ``number`` is NaN where there is none, and ``text`` then says what is there instead."""

    number: float
    status: int
    source_s: float | None  # source time [s since 1970]; None where the server gives none
    kind: ua.VariantType | None
    text: str = ""
    words_held: str = ""  # of a node that holds a text

    @property
    def quality(self) -> int:
        """GOOD, UNCERTAIN or BAD."""
        return min(self.status >> 30, BAD)

    @property
    def words(self) -> str:
        """The status by name."""
        return words(self.status)


class Link:
    """A session, made by ``opened``. A call takes at most ``timeout_s`` and raises EndpointError where it fails."""

    def __init__(self, client: Client, server: Server) -> None:
        self.client, self.server = client, server
        self._securing = False

    @classmethod
    async def opened(cls, server: Server) -> Link:
        """Connect and log on, within ``server.connect_s``. EndpointError names what refused."""
        # What this class does itself, with deadlines of its own, the library need not do beside it.
        client = Client(server.endpoint, timeout=server.connect_s, watchdog_intervall=1e6)
        client.application_uri = APPLICATION
        client.session_timeout = 60_000
        link = cls(client, server)
        try:
            await in_time(link._log_on(), server.connect_s)
        except TimeoutError:
            link.abort()
            raise EndpointError(
                f"{server.endpoint} does not answer within {server.connect_s:g} s{link._hint()}"
            ) from None
        except LoopError:
            raise
        except AssertionError:  # asyncua asks for the endpoints in the clear first, and expects an answer
            link.abort()
            raise EndpointError(
                f"{server.endpoint} opens no channel to ask for its endpoints; pin its certificate by "
                "server_certificate, and none is asked for"
            ) from None
        except Exception as error:
            link.abort()
            reason = _reason(error)
            hint = "" if "User" in reason or "Identity" in reason else link._hint()
            raise EndpointError(f"{server.endpoint} refuses: {reason}{hint}") from None
        except BaseException:
            link.abort()
            raise
        return link

    def _hint(self) -> str:
        """What to look at where a server does not open a secure channel."""
        if not self._securing:
            return ""
        pinned = "" if self.server.server_certificate is None else ", and see that server_certificate is its own"
        return f"; let the server trust {self.server.certificate}{pinned}"

    def server_certificate(self) -> bytes:
        """The server's own certificate; empty without security."""
        return bytes(getattr(self.client.uaclient.security_policy, "peer_certificate", None) or b"")

    async def _log_on(self) -> None:
        server, client = self.server, self.client
        if server.security != "None":
            assert server.certificate is not None
            require_valid(server.certificate)
            pinned = None if server.server_certificate is None else str(server.server_certificate)
            policy = getattr(security_policies, f"SecurityPolicy{server.security}")
            await client.set_security(
                policy, str(server.certificate), str(server.private_key), server_certificate=pinned
            )
            self._securing = True
        if server.user:
            client.set_user(server.user)
            client.set_password(server.password())
        await client.connect()
        self._securing = False

    async def resolved(self, nodes: Sequence[str], timeout_s: float) -> list[ua.NodeId]:
        """The server's ids of nodes. EndpointError for a text that is no id and a namespace that is not there."""
        spaces: list[str] = []
        if any(n.startswith("nsu=") for n in nodes):
            (answer,) = await self._within(
                self.client.uaclient.session.read_attributes(
                    [ua.NodeId(ua.Int32(ua.ObjectIds.Server_NamespaceArray))], ua.AttributeIds.Value
                ),
                timeout_s,
            )
            spaces = list(answer.Value.Value or [])
        return [node_id(n, spaces) for n in nodes]

    async def read(
        self, nodes: Sequence[ua.NodeId], timeout_s: float, attribute: ua.AttributeIds = ua.AttributeIds.Value
    ) -> list[Reading]:
        """The values of nodes, in one request."""
        return [reading(v) for v in await self.values(nodes, timeout_s, attribute)]

    async def values(
        self, nodes: Sequence[ua.NodeId], timeout_s: float, attribute: ua.AttributeIds = ua.AttributeIds.Value
    ) -> list[ua.DataValue]:
        """An attribute of nodes, as the server gives it."""
        request = ua.ReadParameters()
        request.TimestampsToReturn = ua.TimestampsToReturn.Source
        request.MaxAge = 0.0
        request.NodesToRead = [ua.ReadValueId(NodeId=n, AttributeId=attribute) for n in nodes]
        return list(await self._within(self.client.uaclient.session.read(request), timeout_s))

    async def started_s(self, timeout_s: float) -> float | None:
        """When the server started [s since 1970, by its clock]; None where it does not say."""
        node = ua.NodeId(ua.Int32(ua.ObjectIds.Server_ServerStatus_StartTime))
        try:
            (answer,) = await self.values([node], timeout_s)
        except EndpointError:
            return None
        when = None if answer.Value is None else answer.Value.Value
        if not isinstance(when, datetime):
            return None
        started = (when.replace(tzinfo=None) - EPOCH).total_seconds()
        return started if started > 0 else None

    async def write(self, values: Sequence[tuple[ua.NodeId, ua.Variant]], timeout_s: float) -> list[int]:
        """Write values, in one request; the status of each."""
        request = ua.WriteParameters()
        for node, value in values:
            row = ua.WriteValue(NodeId=node, AttributeId=ua.AttributeIds.Value)
            row.Value = ua.DataValue(value)
            request.NodesToWrite.append(row)
        return [int(s.value) for s in await self._within(self.client.uaclient.session.write(request), timeout_s)]

    async def close(self, timeout_s: float = 1.0) -> None:
        """Log off; where the server does not answer, break off."""
        with suppress(Exception):
            await in_time(self.client.disconnect(), timeout_s)
        self.abort()

    def abort(self) -> None:
        """Break the connection off. What was not sent yet is never sent: an MV that comes late is a wrong one."""
        protocol = self.client.uaclient.protocol
        transport = getattr(protocol, "transport", None)
        if transport is not None:
            wire = transport.get_extra_info("socket")
            if wire is not None:
                with suppress(OSError):
                    wire.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            transport.abort()
        for name in ("_supervisor_task", "_stale_watchdog_task", "_renew_channel_task"):
            task = getattr(self.client, name, None)
            if task is not None:
                task.cancel()

    async def _within(self, answer: Any, timeout_s: float) -> Any:
        try:
            return await in_time(answer, timeout_s)
        except TimeoutError:
            raise EndpointError(f"{self.server.endpoint} does not answer within {timeout_s:.3g} s") from None
        except Exception as error:
            raise EndpointError(f"{self.server.endpoint}: {_reason(error)}") from None


async def in_time(doing: Awaitable[T], timeout_s: float) -> T:
    """What ``doing`` gives. TimeoutError where it takes longer, ConnectionError where it was broken off.

    It is a task of its own: asyncua waits by wait_for2, whose own kind of cancellation ``asyncio.timeout`` does not
    take for its own when an answer comes in the moment of its deadline, and would let through to the thread's end.
    """
    task = asyncio.ensure_future(doing)
    try:
        await asyncio.wait({task}, timeout=timeout_s)
        if not task.done():
            raise TimeoutError
        if task.cancelled():
            raise ConnectionError("the connection was broken off")
        return task.result()
    finally:
        if not task.done():
            task.add_done_callback(_forgotten)
            task.cancel()


def _forgotten(task: asyncio.Future[T]) -> None:
    """Nobody waits for it any more: what it raises is no news."""
    if not task.cancelled():
        task.exception()


def node_id(text: str, spaces: Sequence[str]) -> ua.NodeId:
    """The id that ``text`` writes; ``spaces`` are the server's namespaces."""
    head, _, rest = text.partition(";")
    if head.startswith("nsu="):
        if head[4:] not in spaces:
            raise EndpointError(f"the server has no namespace {head[4:]!r}; it has {', '.join(spaces)}")
        text = f"ns={spaces.index(head[4:])};{rest}"
    try:
        return ua.NodeId.from_string(text)
    except Exception:
        raise EndpointError(f"{text!r} is no node id; it is written as 'ns=2;s=TIC101.PV' or 'ns=2;i=1001'") from None


def reading(value: ua.DataValue) -> Reading:
    """A server's answer as a number with its quality and time."""
    status = int(value.StatusCode.value) if value.StatusCode is not None else 0
    when = value.SourceTimestamp
    source = None if when is None else when.timestamp() if when.tzinfo else (when - EPOCH).total_seconds()
    inner = value.Value
    kind = None if inner is None else inner.VariantType
    given = None if inner is None else inner.Value
    if isinstance(given, bool | int | float) and not isinstance(given, ua.StatusCode):
        number = float(given)
        return Reading(number, status, source, kind, "" if math.isfinite(number) else f"{number}")
    text = "no value" if given is None else f"{type(given).__name__} instead of a number"
    return Reading(math.nan, status, source, kind, text, given if isinstance(given, str) else "")


def variant(value: float, kind: ua.VariantType, low: float, high: float) -> ua.Variant:
    """``value`` in a node's own type, within ``low`` and ``high`` also after it was rounded to that type.

    EndpointError for a type that holds no number, and where no number of the type lies in the range.
    """
    if kind is ua.VariantType.Double:
        return ua.Variant(value, kind)
    if kind is ua.VariantType.Float:
        near = np.float32(value)
        if not low <= float(near) <= high:
            near = np.nextafter(near, np.float32(math.inf if float(near) < low else -math.inf))
        if low <= float(near) <= high:
            return ua.Variant(float(near), kind)
        raise EndpointError(f"no number of the type REAL lies within {low:g} .. {high:g}")
    if kind is ua.VariantType.Boolean:
        if value not in (0.0, 1.0):
            raise EndpointError(f"the node is of the type Boolean; {value:g} is neither 0 nor 1")
        return ua.Variant(value == 1.0, kind)
    if kind in INTEGERS:
        whole = round(value)
        whole = math.ceil(value) if whole < low else math.floor(value) if whole > high else whole
        least, most = INTEGERS[kind]
        if low <= whole <= high and least <= whole <= most:
            return ua.Variant(whole, kind)
        raise EndpointError(f"no number of the type {kind.name} lies near {value:g} within {low:g} .. {high:g}")
    raise EndpointError(f"the node is of the type {kind.name}, which holds no number")


def words(status: int) -> str:
    """A status by OPC UA's own name."""
    return str(ua.StatusCode(ua.UInt32(status)).name)


def _reason(error: BaseException) -> str:
    """What refused, by OPC UA's own name where it has one."""
    if isinstance(error, ConnectionRefusedError):
        return "nothing listens there; is the server running?"
    code = getattr(error, "code", None)
    if isinstance(error, ua.UaStatusCodeError) and code is not None:
        return words(code)
    return named(error) if isinstance(error, Exception) else type(error).__name__
