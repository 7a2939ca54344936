"""A plant behind an OPC UA server as a loop's endpoint: no call waits for the network."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import EndpointError, LoopError
from loopwright.serving.guard import Fault, Sample
from loopwright.serving.manifest import Manifest
from loopwright.serving.opcua.analysers import Analysers
from loopwright.serving.opcua.link import Link
from loopwright.serving.opcua.mv_sender import HAND_BACK, Heartbeat, MvSender
from loopwright.serving.opcua.nameplates import Identity, Nameplates, identity, whole
from loopwright.serving.opcua.node_lease import NodeLease
from loopwright.serving.opcua.plan import NodePlan
from loopwright.serving.opcua.sampling import Ages, NodeSampling, Values
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.opcua.values import LateError
from loopwright.serving.words import first_line, named

__all__ = ["OpcUaEndpoint", "Values"]

Array: TypeAlias = NDArray[np.float64]

# So long before the scan values are asked for, as a share of the period: a value's age is dead time that no controller
# was validated with. Twice as long as answers have taken of late, within these bounds.
LEAST_LEAD, MOST_LEAD, LONGEST_LEAD_S = 0.05, 0.3, 0.5
FADES = 0.98  # what is remembered of the slowest answer, from scan to scan
ANSWER_PART, LONGEST_OPC_ANSWER_S = 0.8, 5.0  # of a period: so long an answer may take
SILENT_SCANS = 3  # without any answer: the connection is broken off and made anew
# Pause [s] before a new connection: first, longest, times the last one.
FIRST_RETRY_S, LAST_RETRY_S, RETRY_GROWTH = 0.2, 10.0, 1.6


class OpcUaEndpoint:
    """Reads and writes a plant over OPC UA from a thread of its own.

    Shortly before each scan is due, all values are read in one request; ``read`` gives the last ones with their age.
    ``write`` passes the MV on and returns; whether the plant took it is known at the next scan. An answer that is late
    is a fault and never waited for. After ``SILENT_SCANS`` without one the connection is broken off, and made anew with
    growing pauses; ids are resolved anew then. Nodes that are others now than when the loop began, or of another type,
    unit or range, are a fault, see ``loopwright.serving.opcua.nameplates``.

    Parameters
    ----------
    manifest
        The controller's: its signals say which nodes are needed.
    server, nodes
        See ``loopwright.serving.opcua.settings``.
    max_age_s
        Age [s] from which on values are none; ``read`` then says what became of the connection.
    speed
        Of the loop's clock beside the machine's.
    tell
        Called with a line for whoever watches: connected, lost, refused.
    clock
        Monotonic seconds.
    spaces
        The namespaces by number that an earlier run found behind the ids.
    identified
        Called at each connection, before anything is written, with what it is to.
    connect
        Opens a connection: ``Link.opened`` unless given.

    Raises
    ------
    LoopError
        A signal without a node, or a node without a signal.
    """

    def __init__(
        self,
        manifest: Manifest,
        server: Server,
        nodes: Nodes,
        *,
        max_age_s: float,
        speed: float = 1.0,
        tell: Callable[[str], None] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
        spaces: Mapping[int, str] | None = None,
        identified: Callable[[Identity], object] = lambda _: None,
        connect: Callable[[Server, float], Awaitable[Link]] = Link.opened,
    ) -> None:
        nodes.check(manifest)
        self.manifest, self.server, self.nodes = manifest, server, nodes
        self.speed, self.tell, self.clock, self._connect = speed, tell, clock, connect
        self.max_age_s, self.period_s = max_age_s / speed, manifest.period_s / speed  # of the machine's time
        self.answer_s = min(ANSWER_PART * self.period_s, LONGEST_OPC_ANSWER_S)
        self._slowest_s = MOST_LEAD * self.period_s  # until answers are known
        self.values: Values | None = None
        self.trouble = "not connected yet"  # why there are no values; empty while there are
        self._read_failure = ""  # why the last reading failed at once, or the connection did; late ones grow old
        self._given: Values | None = None  # at the last scan
        self._told_lost = ""  # what was said of the connection since it was lost
        self.connected = False  # as it was told last
        self.connections = self.starts = 0
        self._started_s: float | None = None  # when the server started, by its own clock
        self._next_s = 0.0
        names, rewrite_s = [s.name for s in manifest.mv], server.rewrite_s / speed
        self.sender = MvSender(names, rewrite_s, self.answer_s, NodeLease(self.period_s), clock)
        self.nameplates, self._identified = Nameplates(nodes, manifest, spaces), identified
        self._analysers = Analysers(manifest, nodes.results(), speed)
        self._heartbeat, self._sampling = Heartbeat(), NodeSampling(manifest, server, nodes, self.nameplates)
        self._wake: asyncio.Event | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="opcua", daemon=True)

    @property
    def lead_s(self) -> float:
        """How long before a scan values are asked for [s of the machine's clock]."""
        least, most = LEAST_LEAD * self.period_s, min(MOST_LEAD * self.period_s, LONGEST_LEAD_S)
        return min(max(2 * self._slowest_s, least), most)

    # ------------------------------------------------------------------ the loop's side
    def serve(self, law: Manifest) -> None:
        """The law in charge is this one now: it may go on without a PV whose reading alone is bad, or an MV."""
        self._sampling.serve(law)

    def start(self) -> None:
        """Begin to connect; returns at once."""
        self._thread.start()

    def close(self) -> None:
        """Log off and end the thread."""
        self._closed.set()
        self._stir()
        if self._thread.ident is not None:
            self._thread.join(self.server.connect_s + 2)

    def read(self) -> Sample:
        """The last values; EndpointError where there are none that are young enough."""
        self.sender.told_on = self.sender.shown_on
        values = self.values  # before the time is taken: newer ones may arrive meanwhile, from the future as it were
        now = self.clock()
        self.sender.scans += 1
        self._next_s = now + self.period_s - self.lead_s
        self._stir()
        if values is None:
            raise EndpointError(self.trouble or "no values yet")
        if self._read_failure and values is self._given:
            raise EndpointError(self._read_failure)  # the reading for this scan has failed, and this is the one before
        self._given = values
        age = now - values.arrived_s + values.age_s
        if self.trouble and age > self.max_age_s:
            raise EndpointError(self.trouble)
        # An MV of long ago, or from before a write that failed, is none that the plant has now; an old PV may come with
        # a young MV.
        mv = values.mv if self.sender.told_on and now - values.arrived_s <= self.max_age_s else None
        late = self._late(values, now)
        sample = Sample(
            values.pv, mv, values.dv, age * self.speed, values.fault, values.quality, ", ".join(late), values.bad_pv
        )
        sample = replace(sample, local=values.local) if values.local else sample
        sample = self._late_apart(sample, values, late, now) if late and self._sampling.apart else sample
        sample = self._analysers.look(sample, values.arrived_s, values.stamps)
        return sample if self._sampling.apart else replace(sample, fresh=None)

    def _late(self, values: Values, now: float) -> list[str]:
        """The signals that are too old, where others are not."""
        late = [name for name, age in values.ages.items() if now - values.arrived_s + age > self.max_age_s]
        return late if len(late) == 1 or len(late) < len(values.ages) else []

    def _late_apart(self, sample: Sample, values: Values, late: list[str], now: float) -> Sample:
        """The sample with its late PVs among those that are bad alone: its age is that of the others."""
        names = [f"PV {s.name}" for s in self.manifest.pv]
        rest = [age for name, age in values.ages.items() if name not in late or name not in names]
        if not rest:  # nothing else has come either
            return sample
        said = values.bad_pv or ("",) * len(names)
        bad = [
            why
            or (Fault(f"{name} is older than {self.max_age_s * self.speed:.3g} s", "age", name) if name in late else "")
            for name, why in zip(names, said, strict=True)
        ]
        age = now - values.arrived_s + max(rest)
        others = ", ".join(name for name in late if name not in names)
        return replace(sample, age_s=age * self.speed, late=others, bad_pv=tuple(bad))

    def write(self, mv: Array) -> None:
        """Pass an MV (n_mv,) on; EndpointError where the last one did not arrive, or there is no connection.

        A connection that was made anew takes none before ``read`` has told where the MV stands, and so does one on
        which a write has failed. An MV that still waits for a slow answer is not lost: this one goes out in its
        place, unless that answer is a refusal; then the next call says so.
        """
        sender = self.sender
        mine = sender.called()
        refused = sender.unwritten or self.nameplates.unwritable or sender.barred
        if self._link is None or sender.unread:
            unread = "where the MV stands has not been read yet"
            sender.refuse(self.trouble or refused or ("not connected" if self._link is None else unread))
        if refused:
            sender.refuse(refused)
        if not sender.stands(mv, mine):
            sender.outbox.append(np.array(mv))
            self._stir()

    def hand_back(self) -> None:
        """Ask the plant's own controller to take the plant; EndpointError until the server has confirmed it."""
        if self.nodes.hand_back is None:
            raise LoopError("nodes.hand_back is not set: the loop knows no node by which to hand the plant back")
        if self.sender.ask_back():
            return
        if self._link is not None:
            self.sender.outbox.append(HAND_BACK)
        self._stir()
        raise EndpointError(self.sender.unwritten or self.trouble or "asked for, not confirmed yet")

    # ------------------------------------------------------------------ the thread's side
    _link: Link | None = None

    def _stir(self) -> None:
        loop, wake = self._loop, self._wake
        if loop is not None and wake is not None:
            with suppress(RuntimeError):  # the thread is ending
                loop.call_soon_threadsafe(wake.set)

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                asyncio.run(self._keep_connected())
            except BaseException as error:  # whatever a library lets through, the plant is to be reached again
                self._link = None
                self._lost(f"the connection's thread begins anew: {type(error).__name__}")
                self._closed.wait(FIRST_RETRY_S)

    async def _keep_connected(self) -> None:
        self._loop, self._wake = asyncio.get_running_loop(), asyncio.Event()
        pause = FIRST_RETRY_S
        while not self._closed.is_set():
            try:
                link = await self._connect(self.server, self.period_s)
            except Exception as error:
                self._lost(first_line(error), late=isinstance(error, LateError))
                await self._rest(pause)
                pause = min(pause * RETRY_GROWTH, LAST_RETRY_S)
                continue
            plan = watching = None
            try:
                patience_s = max(self.answer_s, self.server.connect_s)
                await self.nameplates.require_spaces(link, patience_s)
                plan = await NodePlan.made(link, self.manifest, self.nodes, patience_s)
                await self.nameplates.look(link, plan, patience_s)
                self.connections += 1
                anew = await self._anew(link)
                found = await identity(link, self.nodes, self._started_s, patience_s)
                spaces, seen = dict(self.nameplates.spaces), self.nameplates.seen(plan)  # also what is not told now
                self._identified(found._replace(spaces=spaces, seen=seen))
                self.sender.begin(plan.unwritable)
                self._link = link
                pause = FIRST_RETRY_S
                self._told_lost = ""
                self.connected = True
                self.tell(f"connected to {self.server.endpoint}{anew}; {await self._leased(link, plan)}")
                self.nameplates.moved = None
                watching = asyncio.create_task(self.nameplates.watch(link, plan, patience_s))
                await self._serve_connection(link, plan)
            except Exception as error:
                why = first_line(error) if isinstance(error, LoopError) else named(error)
                self._lost(why, late=isinstance(error, LateError))
            finally:
                self._link = None
                if watching is not None:
                    watching.cancel()
                if self._closed.is_set():
                    with suppress(Exception):
                        if plan is not None and plan.lease is not None:
                            await self.sender.lease.give_back(link, plan.lease, self.answer_s)
                    await link.close()
                else:
                    link.abort()
            await self._rest(pause)
            pause = min(pause * RETRY_GROWTH, LAST_RETRY_S)

    async def _leased(self, link: Link, plan: NodePlan) -> str:
        """The lease that keeps loops on other machines from writing the same MVs, in words."""
        if plan.lease is None:
            return plan.unwritable or "no lease"
        spaces = await link.namespaces(self.server.connect_s)
        return f"lease {whole(plan.lease, spaces)}"

    async def _anew(self, link: Link) -> str:
        """Whether the server has started anew, or may have, since it was last spoken to: counted, and in words."""
        before, self._started_s = self._started_s, await link.started_s(self.server.connect_s)
        if self.connections == 1 or (before is not None and before == self._started_s):
            return ""
        self.starts += 1
        if before is None or self._started_s is None:
            return ": it does not say whether it has started anew since"
        return ": it has started anew"

    def _lost(self, why: str, *, late: bool = False) -> None:
        """Say it once. A silent server has been the trouble for some scans already, and was not told as lost."""
        self.connected = False
        if not late:
            self._read_failure = why
        if why != self._told_lost:
            self.tell(why)
        self.trouble = self._told_lost = why

    async def _rest(self, seconds: float) -> None:
        """Wait; not longer than until the endpoint is closed."""
        assert self._wake is not None
        end = self.clock() + seconds
        while not self._closed.is_set() and (left := end - self.clock()) > 0:
            with suppress(TimeoutError):
                async with asyncio.timeout(left):
                    await self._wake.wait()
            self._wake.clear()

    async def _serve_connection(self, link: Link, plan: NodePlan) -> None:
        """Read and write until the connection is lost, which raises EndpointError, or the endpoint closed."""
        assert self._wake is not None
        ages, silent, read_at = Ages(len(plan.timed)), 0, -float("inf")
        self._heartbeat.trouble = ""
        link.on_gone = self._wake.set
        while not self._closed.is_set():
            if link.gone:
                raise EndpointError(f"{self.server.endpoint}: {link.gone}")
            if self.nameplates.moved is not None:
                raise self.nameplates.moved
            now = self.clock()
            due = self._next_s if self._next_s > read_at else read_at + self.period_s
            if self.sender.outbox:
                await self.sender.send(link, plan, self.nameplates)
            elif now >= due:
                read_at = now
                try:
                    await self._heartbeat.beat(link, plan, self.sender.scans, self.answer_s)
                    answers = await link.read(plan.asked, self.answer_s)
                    if plan.lease is not None:
                        await self.sender.keep_lease(link, plan.lease, answers[-1])
                except EndpointError as error:
                    silent += 1
                    self.trouble = first_line(error)
                    if not isinstance(error, LateError):
                        self._read_failure = self.trouble
                    if silent >= SILENT_SCANS or link.gone:
                        raise
                    continue
                silent = 0
                self._slowest_s = max(self.clock() - now, FADES * self._slowest_s)
                self.values = self._sampling.valued(
                    plan, answers, ages, self.clock(), unbeaten=self._heartbeat.trouble, starts=self.starts
                )
                self.trouble, self._read_failure, self.sender.shown_on = "", "", self.connections
            else:
                with suppress(TimeoutError):
                    async with asyncio.timeout(due - now):
                        await self._wake.wait()
                self._wake.clear()
