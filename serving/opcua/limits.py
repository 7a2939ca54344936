"""How many nodes a server takes in one request: longer lists go out in pieces."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from asyncua import ua

from loopwright.serving.errors import EndpointError

T = TypeVar("T")
R = TypeVar("R")

LIMITS = (
    ua.ObjectIds.Server_ServerCapabilities_OperationLimits_MaxNodesPerRead,
    ua.ObjectIds.Server_ServerCapabilities_OperationLimits_MaxNodesPerWrite,
    ua.ObjectIds.Server_ServerCapabilities_OperationLimits_MaxNodesPerBrowse,
)


class TooManyError(EndpointError):
    """The server refuses a request for so many nodes at once."""


@dataclass(slots=True)
class Pieces:
    """The most nodes of one kind of request; 0: any number. A refusal makes it smaller, for the next request too."""

    most: int = 0


class OperationLimits:
    """The server's limits of one connection (``Server.ServerCapabilities.OperationLimits``)."""

    def __init__(self, read: int = 0, write: int = 0, browse: int = 0) -> None:
        self.read, self.write, self.browse = Pieces(read), Pieces(write), Pieces(browse)

    @classmethod
    def told(cls, answers: Sequence[ua.DataValue]) -> OperationLimits:
        """The values of the nodes ``LIMITS``; a server that has none of them, or shows no number, tells no limit."""
        given = [None if a.Value is None else a.Value.Value for a in answers]
        return cls(*(g if isinstance(g, int) and not isinstance(g, bool) and g > 0 else 0 for g in given))


async def in_pieces(
    rows: Sequence[T], pieces: Pieces, ask: Callable[[Sequence[T], float], Awaitable[list[R]]], timeout_s: float
) -> list[R]:
    """The answers to ``rows``, asked for in pieces that the server takes, all within ``timeout_s``.

    A server may refuse more than it told, or have told nothing: the pieces then become half as large. Raises what
    ``ask`` raises, and TooManyError where the server refuses a single row.
    """
    now = asyncio.get_running_loop().time
    end, left_s, found = now() + timeout_s, timeout_s, list[R]()
    while len(found) < len(rows):
        piece = rows[len(found) : len(found) + pieces.most] if pieces.most else rows[len(found) :]
        try:
            answers = await ask(piece, left_s)
        except TooManyError:
            if len(piece) == 1:
                raise
            pieces.most = len(piece) // 2
            continue
        finally:
            left_s = max(end - now(), 0.0)
        if len(answers) != len(piece):
            raise EndpointError(f"the server gives {len(answers)} answers to a request for {len(piece)} nodes")
        found += answers
    return found
