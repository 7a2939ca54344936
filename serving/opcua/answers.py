"""The end of a request to a server: an answer, a refusal, or none in time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import TypeVar

from asyncua import ua

from loopwright.serving.errors import EndpointError
from loopwright.serving.opcua.values import words
from loopwright.serving.words import named

T = TypeVar("T")

GONE = {
    ua.StatusCodes.BadConnectionClosed,
    ua.StatusCodes.BadSecureChannelClosed,
    ua.StatusCodes.BadSecureChannelIdInvalid,
    ua.StatusCodes.BadSecureChannelTokenUnknown,
    ua.StatusCodes.BadSessionClosed,
    ua.StatusCodes.BadSessionIdInvalid,
    ua.StatusCodes.BadSessionNotActivated,
}  # answers after which no other request has a chance

TOO_MANY = {
    ua.StatusCodes.BadEncodingLimitsExceeded,
    ua.StatusCodes.BadRequestTooLarge,
    ua.StatusCodes.BadResponseTooLarge,
    ua.StatusCodes.BadTooManyOperations,
}  # answers after which a smaller request has a chance
BUSY = {
    ua.StatusCodes.BadNoContinuationPoints,
    ua.StatusCodes.BadOutOfMemory,
    ua.StatusCodes.BadResourceUnavailable,
    ua.StatusCodes.BadServerHalted,
    ua.StatusCodes.BadShutdown,
    ua.StatusCodes.BadTcpServerTooBusy,
    ua.StatusCodes.BadTimeout,
}  # answers after which the same request may have another one


class LateError(EndpointError):
    """There was no answer in time."""


class BusyError(EndpointError):
    """The server says that it cannot answer now."""


def unanswered(error: EndpointError, gone: str) -> bool:
    """Whether the server has not answered, and may yet; ``gone``: why the connection is of no use any more, or empty.

    A refusal is an answer: the same request gets it again.
    """
    return bool(gone) or isinstance(error, LateError | BusyError)


async def in_time(doing: Awaitable[T], timeout_s: float) -> T:
    """The result of ``doing``. TimeoutError where it takes longer, ConnectionError where it was broken off.

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


def reason(error: BaseException) -> str:
    """The refusal, by OPC UA's own name where it has one."""
    if isinstance(error, ConnectionRefusedError):
        return "nothing listens there; is the server running?"
    code = getattr(error, "code", None)
    if isinstance(error, ua.UaStatusCodeError) and code is not None:
        return words(code)
    return named(error) if isinstance(error, Exception) else type(error).__name__
