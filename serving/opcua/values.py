"""Values as a server gives and takes them, and the end of a request: an answer, a refusal, or none in time."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable
from datetime import datetime
from typing import NamedTuple, TypeVar

import numpy as np
from asyncua import ua

from loopwright.serving.errors import EndpointError
from loopwright.serving.words import named

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
STATUS_GOOD, STATUS_UNCERTAIN, STATUS_BAD = 0, 1, 2  # the two highest bits of a status


class NodeReading(NamedTuple):
    """A node's value. ``number`` is NaN where there is none, and ``text`` then says what is there instead."""

    number: float
    status: int
    source_s: float | None  # source time [s since 1970]; None where the server gives none
    kind: ua.VariantType | None
    text: str = ""
    words_held: str = ""  # of a node that holds a text

    @property
    def quality(self) -> int:
        """STATUS_GOOD, STATUS_UNCERTAIN or STATUS_BAD."""
        return min(self.status >> 30, STATUS_BAD)

    @property
    def words(self) -> str:
        """The status by name."""
        return words(self.status)


def reading(value: ua.DataValue) -> NodeReading:
    """A server's answer as a number with its quality and time."""
    status = int(value.StatusCode.value) if value.StatusCode is not None else 0
    when = value.SourceTimestamp
    source = None if when is None else when.timestamp() if when.tzinfo else (when - EPOCH).total_seconds()
    inner = value.Value
    kind = None if inner is None else inner.VariantType
    given = None if inner is None else inner.Value
    if isinstance(given, bool | int | float) and not isinstance(given, ua.StatusCode):
        number = float(given)
        return NodeReading(number, status, source, kind, "" if math.isfinite(number) else f"{number}")
    text = "no value" if given is None else f"{type(given).__name__} instead of a number"
    return NodeReading(math.nan, status, source, kind, text, given if isinstance(given, str) else "")


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


def exact(value: float, kind: ua.VariantType) -> ua.Variant:
    """``value`` itself in a node's own type, or the nearest one of a REAL; EndpointError where the type has it not."""
    low, high = (-math.inf, math.inf) if kind in FLOATS else (value, value)
    return variant(value, kind, low, high)


def words(status: int) -> str:
    """A status by OPC UA's own name."""
    return str(ua.StatusCode(ua.UInt32(status)).name)


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
