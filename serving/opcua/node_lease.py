"""The writer of a plant's MVs, in a node of the plant's server: loops on different machines find each other there."""

from __future__ import annotations

import math
import os
import secrets
import socket
from collections.abc import Iterable
from contextlib import suppress

from asyncua import ua

from loopwright.serving.errors import EndpointError, LoopError
from loopwright.serving.opcua.link import Link
from loopwright.serving.opcua.values import STATUS_GOOD, unanswered, words

NAME = "LoopwrightLease"  # of a node beside those of the MVs: it is the lease of every loop that is told of none
WRITABLE = 2  # the second bit of an access level
SCANS = 5  # of the slower loop, without a renewal: the one that had the lease is gone


class LeaseRefusedError(EndpointError):
    """The server does not take what is written into the lease's node."""


class NodeLease:
    """A text node: ``OWNER PERIOD COUNT`` of the loop that writes, renewed at each of its readings; empty without one.

    PERIOD is that loop's, in seconds: a fast loop waits for as long as a slow one needs. Whether another owner lives is
    judged by whether its count moves, not by clocks. A loop takes the lease only to write, and once it reads back its
    own name: of two that take it in one moment the later one has it, and the other finds that out at its next reading.

    Parameters
    ----------
    period_s
        Between two readings of this loop [s].
    """

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self.owner = f"{socket.gethostname()}:{os.getpid()}:{secrets.token_hex(3)}"
        self.held = False
        self._count = 0
        self._text, self._still = "", 0  # of the node, and for how many readings it has stood so

    def seen(self, text: str) -> None:
        """Content of the node at a reading."""
        self._still = self._still + 1 if text == self._text else 0
        self._text = text
        if self.held and _owner(text) != self.owner:
            self.held = False

    @property
    def other(self) -> str:
        """The other loop that has the lease and lives; empty: nobody."""
        owner = _owner(self._text)
        slower = max(1.0, _period(self._text, self.period_s) / self.period_s)
        return owner if owner not in {"", self.owner} and self._still < SCANS * slower else ""

    async def take(self, link: Link, node: ua.NodeId, timeout_s: float) -> None:
        """Have the lease. EndpointError while another loop has it."""
        if self.held:
            return
        if self.other:
            raise EndpointError(f"the plant is controlled by {self.other}")
        await self._count_on(link, node, timeout_s)
        (answer,) = await link.values([node], timeout_s)
        found = "" if answer.Value is None else str(answer.Value.Value)
        if _owner(found) != self.owner:
            raise EndpointError(f"the plant is controlled by {_owner(found) or 'nobody: the lease cannot be written'}")
        self.held, self._text, self._still = True, found, 0

    async def renew(self, link: Link, node: ua.NodeId, timeout_s: float) -> None:
        """Write the next count. EndpointError, and the lease is lost, where the server refuses it."""
        try:
            await self._count_on(link, node, timeout_s)
        except LeaseRefusedError:
            self.held = False  # the others see no count move, and take it
            raise

    async def _count_on(self, link: Link, node: ua.NodeId, timeout_s: float) -> None:
        self._count = (self._count + 1) % 1_000_000
        await self._write(link, node, f"{self.owner} {self.period_s:g} {self._count}", timeout_s)

    async def give_back(self, link: Link, node: ua.NodeId, timeout_s: float) -> None:
        """Let others have it at once."""
        if self.held:
            self.held = False
            with suppress(LeaseRefusedError):  # then they have it once its count has not moved
                await self._write(link, node, "", timeout_s)

    async def _write(self, link: Link, node: ua.NodeId, text: str, timeout_s: float) -> None:
        (status,) = await link.write([(node, ua.Variant(text, ua.VariantType.String))], timeout_s)
        if status >> 30 != STATUS_GOOD:
            raise LeaseRefusedError(f"the server refuses lease: {words(status)}")


class SeveralLeasesError(LoopError):
    """The MVs have several leases: whoever takes another one than this loop would write beside it."""


async def beside(link: Link, written: Iterable[ua.NodeId], timeout_s: float) -> ua.NodeId | None:
    """The node NAME that lies beside one or more of the MVs, where it is a text that this user may write.

    None where there is no such node, and where the server refuses to show its folders. EndpointError where it does not
    answer, as nobody knows then whether there is one; SeveralLeasesError where there are several.
    """
    found = dict[ua.NodeId, None]()
    try:
        for node in written:
            found |= dict.fromkeys(await link.beside(node, NAME, timeout_s))
        texts = await link.read(list(found), timeout_s)
        access = await link.values(list(found), timeout_s, ua.AttributeIds.UserAccessLevel)
    except EndpointError as error:
        if unanswered(error, link.gone):
            raise
        return None
    may = [a.Value is not None and isinstance(a.Value.Value, int) and bool(a.Value.Value & WRITABLE) for a in access]
    usable = [n for n, text, m in zip(found, texts, may, strict=True) if m and text.kind is ua.VariantType.String]
    if len(usable) > 1:
        those = ", ".join(n.to_string() for n in usable)
        raise SeveralLeasesError(
            f"there are {len(usable)} nodes {NAME} beside the MVs ({those}); name one by nodes.lease"
        )
    return next(iter(usable), None)


def _owner(text: str) -> str:
    return text.partition(" ")[0]


def _period(text: str, otherwise: float) -> float:
    """The period that a lease tells [s]; ``otherwise`` where it tells none."""
    words = text.split(" ")
    try:
        period_s = float(words[1]) if len(words) == 3 else otherwise
    except ValueError:
        return otherwise
    return period_s if math.isfinite(period_s) and period_s > 0 else otherwise
