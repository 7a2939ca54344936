"""One connection to an OPC UA server: opened, kept, and broken off."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime
from typing import Any

from asyncua import Client, ua
from asyncua.crypto import security_policies

from loopwright.serving.errors import EndpointError, LoopError
from loopwright.serving.opcua.certificates import APPLICATION, identity, require_valid
from loopwright.serving.opcua.limits import LIMITS, OperationLimits, TooManyError, in_pieces
from loopwright.serving.opcua.settings import Server
from loopwright.serving.opcua.values import (
    BUSY,
    EPOCH,
    GONE,
    TOO_MANY,
    BusyError,
    LateError,
    NodeReading,
    in_time,
    reading,
    reason,
)

# How long a server is asked to keep a session of which it hears nothing: some periods, within these bounds.
SESSION, LEAST_SESSION_S, MOST_SESSION_S = 3, 60.0, 3600.0
# of the time that the server grants: after so long without a request one is made to keep the session
KEEP_ALIVE = 2 / 3
KEPT_TRY = 1 / 6  # of it: so long such a request may take before the next one


class Link:
    """A session, made by ``opened``. A call takes at most ``timeout_s`` and raises EndpointError where it fails.

    A server closes a session of which it hears nothing for longer than it grants. Where the loop's own requests are
    that far apart, the link reads the server's state between them, beside whatever else is asked for. asyncua renews
    the secure channel once three quarters of its lifetime are over. ``gone`` says why the connection is of no use any
    more, and ``on_gone`` is called when that becomes known.
    """

    def __init__(self, client: Client, server: Server) -> None:
        self.client, self.server = client, server
        self.on_gone: Callable[[], object] = lambda: None
        self._gone = ""
        self._asked_s = 0.0  # when the last request was made that the server has answered
        self._keeping: asyncio.Task[None] | None = None
        self._securing = False
        self._spaces: list[str] | None = None  # the server's namespaces, once they were asked for
        self.limits = OperationLimits()

    @classmethod
    async def opened(cls, server: Server, period_s: float = 0.0, client_of: Callable[..., Client] = Client) -> Link:
        """Connect and log on, within ``server.connect_s``. EndpointError names what refused.

        ``period_s`` [s of the machine's clock] lies between two requests of the loop. ``client_of`` makes the client of
        an endpoint, asyncua's unless given.
        """
        # What this class does itself, with deadlines of its own, the library need not do beside it.
        client = client_of(server.endpoint, timeout=server.connect_s, watchdog_intervall=1e6)
        client.application_uri = APPLICATION
        client.session_timeout = 1000 * min(max(LEAST_SESSION_S, SESSION * period_s), MOST_SESSION_S)
        link = cls(client, server)
        try:
            await in_time(link._log_on(), server.connect_s)
        except TimeoutError:
            link.abort()
            raise LateError(f"{server.endpoint} does not answer within {server.connect_s:g} s{link._hint()}") from None
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
            why = reason(error)
            hint = link._user_hint() if "User" in why or "Identity" in why else link._hint()
            raise EndpointError(f"{server.endpoint} refuses: {why}{hint}") from None
        except BaseException:
            link.abort()
            raise
        return link

    def _hint(self) -> str:
        """Things to look at where a server does not open a secure channel."""
        if not self._securing:
            return ""
        pinned = "" if self.server.server_certificate is None else ", and see that server_certificate is its own"
        return f"; let the server trust {self.server.certificate}{pinned}"

    def _user_hint(self) -> str:
        """Things to look at where a server does not know its user."""
        user = self.server.user_certificate
        return "" if user is None else f"; let the server trust {user} as a user's"

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
        if server.user_certificate is not None:
            assert server.user_key is not None
            client.user_certificate, client.user_private_key = identity(server.user_certificate, server.user_key)
        self._asked_s = asyncio.get_running_loop().time()
        await client.connect()
        self._securing = False
        self.limits = await self._asked_limits(server.connect_s)
        self._keeping = asyncio.create_task(self._keep())
        renewing = client._renew_channel_task
        if renewing is not None:
            renewing.add_done_callback(self._unrenewed)

    @property
    def gone(self) -> str:
        """Why this connection is of no use any more; empty while it may be of use."""
        return self._gone or ("the connection is lost" if self.client.uaclient.protocol is None else "")

    async def _keep(self) -> None:
        """Ask for something before the server's patience ends, where nobody else does."""
        patience_s, time = self.client.session_timeout / 1000, asyncio.get_running_loop().time
        state = ua.NodeId(ua.Int32(ua.ObjectIds.Server_ServerStatus_State))
        while True:
            left_s = self._asked_s + KEEP_ALIVE * patience_s - time()
            if left_s > 0:
                await asyncio.sleep(left_s)
                continue
            try:
                await self.values([state], KEPT_TRY * patience_s)
            except LateError:
                continue  # the loop's own readings judge a server that is silent
            except EndpointError:
                if self.gone:
                    self.on_gone()
                    return
                await asyncio.sleep(KEPT_TRY * patience_s)

    def _unrenewed(self, renewing: asyncio.Task[None]) -> None:
        """The library tries once: a channel that was not renewed then ends soon."""
        error = None if renewing.cancelled() else renewing.exception()
        if error is not None and not self._gone:
            self._gone = f"the secure channel could not be renewed: {reason(error)}"
            self.on_gone()

    async def _asked_limits(self, timeout_s: float) -> OperationLimits:
        """How many nodes the server takes in one request, as far as it says; one by one, as it may take one alone."""
        nodes = [ua.NodeId(ua.Int32(i)) for i in LIMITS]
        try:
            return OperationLimits.told([v for n in nodes for v in await self.values([n], timeout_s)])
        except LateError:
            raise
        except EndpointError:
            return OperationLimits()

    async def namespaces(self, timeout_s: float, *, anew: bool = False) -> list[str]:
        """The server's namespaces, each at its index; empty where it does not tell. Asked once unless ``anew``."""
        if self._spaces is None or anew:
            (answer,) = await self.values([ua.NodeId(ua.Int32(ua.ObjectIds.Server_NamespaceArray))], timeout_s)
            self._spaces = _texts(answer)
        return self._spaces

    async def server_uri(self, timeout_s: float) -> str:
        """The server's own name of itself (``ServerArray[0]``); empty where it does not tell."""
        (answer,) = await self.values([ua.NodeId(ua.Int32(ua.ObjectIds.Server_ServerArray))], timeout_s)
        return next(iter(_texts(answer)), "")

    async def resolved(self, nodes: Sequence[str], timeout_s: float) -> list[ua.NodeId]:
        """The server's ids of nodes. EndpointError for a text that is no id and a namespace that is not there."""
        spaces = await self.namespaces(timeout_s) if any(n.startswith("nsu=") for n in nodes) else []
        return [node_id(n, spaces) for n in nodes]

    async def read(
        self, nodes: Sequence[ua.NodeId], timeout_s: float, attribute: ua.AttributeIds = ua.AttributeIds.Value
    ) -> list[NodeReading]:
        """The values of nodes, in as few requests as the server allows."""
        return [reading(v) for v in await self.values(nodes, timeout_s, attribute)]

    async def values(
        self, nodes: Sequence[ua.NodeId], timeout_s: float, attribute: ua.AttributeIds = ua.AttributeIds.Value
    ) -> list[ua.DataValue]:
        """An attribute of nodes, as the server gives it."""

        async def ask(piece: Sequence[ua.NodeId], left_s: float) -> list[ua.DataValue]:
            request = ua.ReadParameters()
            request.TimestampsToReturn = ua.TimestampsToReturn.Source
            request.MaxAge = 0.0
            request.NodesToRead = [ua.ReadValueId(NodeId=n, AttributeId=attribute) for n in piece]
            return list(await self._within(self.client.uaclient.session.read(request), left_s))

        return await in_pieces(nodes, self.limits.read, ask, timeout_s)

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
        """Write values, in as few requests as the server allows; the status of each."""

        async def ask(piece: Sequence[tuple[ua.NodeId, ua.Variant]], left_s: float) -> list[int]:
            request = ua.WriteParameters()
            for node, value in piece:
                row = ua.WriteValue(NodeId=node, AttributeId=ua.AttributeIds.Value)
                row.Value = ua.DataValue(value)
                request.NodesToWrite.append(row)
            return [int(s.value) for s in await self._within(self.client.uaclient.session.write(request), left_s)]

        return await in_pieces(values, self.limits.write, ask, timeout_s)

    async def browsed(
        self, nodes: Sequence[ua.NodeId], reference: ua.ObjectIds, timeout_s: float, *, inverse: bool = False
    ) -> list[list[ua.ReferenceDescription]]:
        """The nodes that a kind of reference leads to from each node, or comes from; empty where nothing does."""
        result = ua.BrowseResultMask.BrowseName | ua.BrowseResultMask.NodeClass

        async def ask(piece: Sequence[ua.NodeId], left_s: float) -> list[list[ua.ReferenceDescription]]:
            request = ua.BrowseParameters()
            for node in piece:
                row = ua.BrowseDescription(NodeId=node, ReferenceTypeId=ua.NodeId(ua.Int32(reference)))
                row.BrowseDirection = ua.BrowseDirection.Inverse if inverse else ua.BrowseDirection.Forward
                row.ResultMask = ua.UInt32(result)
                request.NodesToBrowse.append(row)
            end_s = asyncio.get_running_loop().time() + left_s
            found = list(await self._within(self.client.uaclient.session.browse(request), left_s))
            rows = [list(row.References or []) for row in found]
            crowded = any(row.StatusCode.value == ua.StatusCodes.BadNoContinuationPoints for row in found)
            parted = [(i, row.ContinuationPoint) for i, row in enumerate(found) if row.ContinuationPoint]
            while parted:  # to the end: a server keeps few points open, and none for longer than it must
                following = ua.BrowseNextParameters()
                following.ContinuationPoints = [point for _, point in parted]
                left_s = max(end_s - asyncio.get_running_loop().time(), 0.0)
                more = list(await self._within(self.client.uaclient.session.browse_next(following), left_s))
                parts = list(zip((i for i, _ in parted), more, strict=False))
                for i, row in parts:
                    rows[i] += row.References or []
                parted = [(i, row.ContinuationPoint) for i, row in parts if row.ContinuationPoint]
            if crowded and len(piece) > 1:
                raise TooManyError(f"{self.server.endpoint}: BadNoContinuationPoints")
            return rows

        return await in_pieces(nodes, self.limits.browse, ask, timeout_s)

    async def beside(self, node: ua.NodeId, name: str, timeout_s: float) -> list[ua.NodeId]:
        """The nodes of a name, in the namespace of ``node``, that lie in the same folder or object as it."""
        (above,) = await self.browsed([node], ua.ObjectIds.HierarchicalReferences, timeout_s, inverse=True)
        paths = []
        for parent in above:
            step = ua.RelativePathElement(
                ReferenceTypeId=ua.NodeId(ua.Int32(ua.ObjectIds.HierarchicalReferences)),
                IsInverse=False,
                TargetName=ua.QualifiedName(name, node.NamespaceIndex),
            )
            at = ua.NodeId(parent.NodeId.Identifier, parent.NodeId.NamespaceIndex)
            paths.append(ua.BrowsePath(at, ua.RelativePath([step])))
        found = await self._within(self.client.uaclient.session.translate_browsepaths_to_nodeids(paths), timeout_s)
        targets = [t.TargetId for row in found for t in row.Targets or []]
        return [ua.NodeId(t.Identifier, t.NamespaceIndex) for t in targets]

    async def close(self, timeout_s: float = 1.0) -> None:
        """Log off; where the server does not answer, break off."""
        with suppress(Exception):
            await in_time(self.client.disconnect(), timeout_s)
        self.abort()

    def abort(self) -> None:
        """Break the connection off. A write not yet sent is never sent: an MV that comes late is a wrong one."""
        protocol = self.client.uaclient.protocol
        transport = getattr(protocol, "transport", None)
        if transport is not None:
            wire = transport.get_extra_info("socket")
            if wire is not None:
                with suppress(OSError):
                    wire.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            transport.abort()
        if self._keeping is not None:
            self._keeping.cancel()
        for name in ("_supervisor_task", "_stale_watchdog_task", "_renew_channel_task"):
            task = getattr(self.client, name, None)
            if task is not None:
                task.cancel()

    async def _within(self, answer: Any, timeout_s: float) -> Any:
        asked_s = asyncio.get_running_loop().time()
        try:
            found = await in_time(answer, timeout_s)
        except TimeoutError:
            raise LateError(f"{self.server.endpoint} does not answer within {timeout_s:.3g} s") from None
        except Exception as error:
            code = getattr(error, "code", None) if isinstance(error, ua.UaStatusCodeError) else None
            if code in GONE:
                self._gone = reason(error)
            if code in TOO_MANY:
                raise TooManyError(f"{self.server.endpoint}: {reason(error)}") from None
            if code in BUSY:
                raise BusyError(f"{self.server.endpoint}: {reason(error)}") from None
            raise EndpointError(f"{self.server.endpoint}: {reason(error)}") from None
        self._asked_s = max(self._asked_s, asked_s)
        return found


def node_id(text: str, spaces: Sequence[str]) -> ua.NodeId:
    """The id that ``text`` writes; ``spaces`` are the server's namespaces."""
    head, _, rest = text.partition(";")
    if head.startswith("nsu=") and head[4:] not in spaces:
        raise EndpointError(f"the server has no namespace {head[4:]!r}; it has {', '.join(spaces)}")
    number = spaces.index(head[4:]) if head.startswith("nsu=") else None
    try:
        node = ua.NodeId.from_string(text if number is None else f"ns={number};{rest}")
    except Exception:
        node = None
    if node is None or number not in {None, int(node.NamespaceIndex)}:  # a second namespace behind the first one
        raise EndpointError(
            f"{text!r} is no node id; it is written as 'nsu=urn:plant;s=TIC101.PV' or 'nsu=urn:plant;i=1001'"
        )
    return node


def _texts(answer: ua.DataValue) -> list[str]:
    """A list of texts; empty where the server gives none."""
    given = None if answer.Value is None else answer.Value.Value
    return [str(text) for text in given] if isinstance(given, list) else []
