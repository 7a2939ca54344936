"""Writes to the server: MVs, passed on by the loop and sent by the connection's thread, and the count of its scans."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import TypeAlias

import numpy as np
from asyncua import ua
from numpy.typing import NDArray

from loopwright.serving.errors import EndpointError
from loopwright.serving.opcua.link import Link
from loopwright.serving.opcua.nameplates import Nameplates
from loopwright.serving.opcua.node_lease import LeaseRefusedError, NodeLease
from loopwright.serving.opcua.plan import NodePlan
from loopwright.serving.opcua.values import STATUS_GOOD, NodeReading, variant, words
from loopwright.serving.words import first_line

Array: TypeAlias = NDArray[np.float64]

UNUSED_SCANS = 3  # without a write: the lease is given back

HAND_BACK = "hand back"
"""In place of an MV that waits: the plant's own controller is asked to take the plant."""


class MvSender:
    """The MVs that wait to be written, why the last one did not arrive, and the lease under which they are written.

    The loop calls ``called``, ``stands``, ``refuse``, ``ask_back`` and ``unread``, counts ``scans``, notes ``told_on``
    and adds to ``outbox``; the connection's thread calls ``begin``, ``send`` and ``keep_lease``, and sets ``shown_on``.

    Parameters
    ----------
    names
        Of the MVs.
    rewrite_s
        Seconds of the clock for which an MV that stands is not written again.
    answer_s
        So long an answer of the server may take [s].
    lease
        Of this loop.
    clock
        Monotonic seconds.
    """

    def __init__(
        self, names: list[str], rewrite_s: float, answer_s: float, lease: NodeLease, clock: Callable[[], float]
    ) -> None:
        self.names, self.rewrite_s, self.answer_s, self.clock = names, rewrite_s, answer_s, clock
        self.lease = lease
        self.scans = 0  # of the loop
        self.outbox = deque[Array | str]()  # MVs that wait, or HAND_BACK
        self.unwritten = ""  # why the last MV did not reach the plant
        self.barred = ""  # why this connection takes none
        # Which connection has shown where the plant is (0: the present one has not, since a write failed if one did),
        # and which one `read` told of.
        self.shown_on, self.told_on = 0, 0
        self._wrote = 0  # the last scan that needed the lease
        self._written: tuple[Array, float] | None = None  # the last MV that was passed on, and when
        self._called = self._asked = 0  # the scans of the last calls to write and to hand_back
        self._handed_back = False

    # ------------------------------------------------------------------ the loop's side
    @property
    def unread(self) -> bool:
        """Whether the loop has not been told yet where the MV stands."""
        return self.shown_on == 0 or self.told_on != self.shown_on

    @property
    def doubted(self) -> bool:
        """Whether what was sent last may not have come, and no reading since has told where the MVs stand."""
        return self.shown_on == 0

    def called(self) -> bool:
        """Note a call to write, and say whether the scan before had one too."""
        now, before, self._called = self.scans, self._called, self.scans
        if now - before > 1:
            self.unwritten = ""  # of a time after which nothing was written: it says nothing of now
        return now - before <= 1

    def refuse(self, why: str) -> None:
        """EndpointError: the loop holds the MV before this one, so neither this one may go out nor one that waits."""
        self.outbox.clear()
        self.unwritten, self._written = "", None
        raise EndpointError(why)

    def stands(self, mv: Array, mine: bool) -> bool:
        """Whether this very MV was passed on less than ``rewrite_s`` ago, and, as ``mine`` says, at each scan since."""
        now, last = self.clock(), self._written
        young = last is not None and now - last[1] < self.rewrite_s
        if mine and young and last is not None and np.array_equal(last[0], mv):
            self._wrote = self.scans  # the lease is still needed
            return True
        self._written = np.array(mv), now
        return False

    def ask_back(self) -> bool:
        """Note a call to hand_back, and say whether the server has confirmed the one of the scan before."""
        confirmed, before, self._asked = self._handed_back, self._asked, self.scans
        self._handed_back = False
        return confirmed and self.scans - before <= 1  # an older answer is to a request of before the loop wrote again

    # ------------------------------------------------------------------ the thread's side
    def begin(self, barred: str) -> None:
        """A connection begins. ``barred`` says why it takes no MV; empty where it does."""
        if self.outbox:
            self.outbox.clear()  # what was to be written then is too old now
            self.unwritten = self.unwritten or "the connection was lost before the MV was sent"
        self._written, self.shown_on, self.barred = None, 0, barred

    async def send(self, link: Link, plan: NodePlan, nameplates: Nameplates) -> None:
        """Write what waits. A server that refuses is a fault; one that does not answer loses the connection."""
        last: Array | str | None = None
        with suppress(IndexError):  # the loop may take out what waits
            while True:
                last = self.outbox.popleft()
        if last is None:
            return
        handing = isinstance(last, str)
        barred = nameplates.unwritable or self.barred
        if not handing and self.doubted:
            # It was passed on while another one was on its way, and goes on from where that was to lead; behind a
            # request to hand the plant back that was refused, it waits for a reading, too.
            self._failed(self.unwritten or "where the MV stands has not been read yet")
            return
        if not handing and barred:  # it may be so since the MV was passed on
            self._failed(barred)
            return
        try:
            rows = [plan.hand_back()] if isinstance(last, str) else plan.variants(last)
        except EndpointError as error:
            self._failed(first_line(error))
            if handing:
                return
            raise  # with the next connection all types are asked for anew
        if plan.lease is not None:
            try:
                await self.lease.take(link, plan.lease, self.answer_s)
            except EndpointError as error:
                self._failed(first_line(error))
                return
        self._wrote = self.scans
        try:
            statuses = await link.write(rows, self.answer_s)
        except EndpointError as error:
            self._failed(first_line(error))
            raise
        names = ["hand_back"] if handing else self.names
        wrong = [f"{name}: {words(s)}" for name, s in zip(names, statuses, strict=True) if s >> 30 != STATUS_GOOD]
        if wrong:
            self._failed(f"the server refuses {', '.join(wrong)}")
        else:
            self.unwritten = ""
        self._handed_back = handing and not wrong
        if ua.StatusCodes.BadTypeMismatch in statuses:
            # With the next connection all types are asked for anew.
            raise EndpointError(f"{self.unwritten}: a node's type has changed")

    def _failed(self, why: str) -> None:
        """A write did not arrive: only a reading that is asked for from now on tells where the MV stands."""
        self.shown_on = 0
        self.unwritten = why

    async def keep_lease(self, link: Link, node: ua.NodeId, answer: NodeReading) -> None:
        """Keep the lease while MVs are written, and let it go when they are not: a shadow needs none."""
        self.lease.seen(answer.words_held)
        if not self.lease.held:
            self._written = None  # also an MV that stands is sent then: only that takes the lease, or says who has it
        elif self.scans - self._wrote > UNUSED_SCANS:
            await self.lease.give_back(link, node, self.answer_s)
        else:
            try:
                await self.lease.renew(link, node, self.answer_s)
            except LeaseRefusedError as error:
                self.unwritten = self.unwritten or first_line(error)  # also while an MV stands and none is sent


# ---------------------------------- the scans counted on the server's side, so that the plant knows that its loop lives
class Heartbeat:
    """Counts while there are scans. A plant that gets no count must not be written: ``trouble`` says why."""

    def __init__(self) -> None:
        self.trouble = ""
        self._beats = 0  # scans that were counted

    async def beat(self, link: Link, plan: NodePlan, scans: int, answer_s: float) -> None:
        """Write how many ``scans`` there were, if there are new ones.

        A node that has another type now is counted in that one from the next scan on.
        """
        if plan.heartbeat is None or scans == self._beats:
            return
        self._beats = scans
        node, kind, most = plan.heartbeat
        try:
            count = variant(float(scans % most), kind, 0.0, float(most))
        except EndpointError as error:
            self.trouble = f"heartbeat: {first_line(error)}"
        else:
            (status,) = await link.write([(node, count)], answer_s)
            self.trouble = "" if status >> 30 == STATUS_GOOD else f"the server refuses heartbeat: {words(status)}"
        if self.trouble:
            (now,) = await link.read([node], answer_s)
            if now.kind is not None:
                plan.beat_in(node, now.kind)
