"""Deadlines of a connection, against a library that raises what it should not."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import pytest
from asyncua import ua
from processes import within

from serving import Controller
from serving.errors import EndpointError
from serving.opcua.answers import in_time
from serving.opcua.endpoint import OpcUaEndpoint
from serving.opcua.limits import OperationLimits, Pieces, TooManyError, in_pieces
from serving.opcua.link import Link
from serving.opcua.settings import Nodes, Server

pytest_plugins = ["small_laws"]


class OwnKindOfCancellation(asyncio.CancelledError):
    """As wait_for2 raises it where an answer comes in the moment of its deadline."""


async def forever(ended: list[str]) -> None:
    try:
        await asyncio.Event().wait()
    finally:
        ended.append("cancelled")


async def raising(error: BaseException) -> None:
    raise error


def test_what_takes_too_long_is_cancelled() -> None:
    ended: list[str] = []

    async def run() -> None:
        with pytest.raises(TimeoutError):
            await in_time(forever(ended), 0.01)
        await asyncio.sleep(0)

    asyncio.run(run())
    assert ended == ["cancelled"]


@pytest.mark.parametrize(
    ("raised", "seen"),
    [(OwnKindOfCancellation(), ConnectionError), (OSError("no route"), OSError), (TimeoutError(), TimeoutError)],
)
def test_what_a_library_raises_is_an_error_and_no_cancellation(raised: BaseException, seen: type[Exception]) -> None:
    async def run() -> None:
        with pytest.raises(seen):
            await in_time(raising(raised), 1.0)

    asyncio.run(run())


def test_whatever_ends_the_thread_the_plant_is_to_be_reached_again(
    monkeypatch: pytest.MonkeyPatch, controller: Controller
) -> None:
    tries, told = [0], list[str]()

    async def opened(_: Server, __: float) -> Link:
        tries[0] += 1
        raise OwnKindOfCancellation if tries[0] == 1 else OSError("refused")

    monkeypatch.setattr(Link, "opened", opened)
    m = controller.manifest
    nodes = Nodes(**{g: {s.name: "ns=2;s=x" for s in m.signals(g)} for g in ("pv", "mv", "dv")})
    server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True)
    endpoint = OpcUaEndpoint(m, server, nodes, max_age_s=1.0, tell=told.append)
    endpoint.start()
    try:
        assert within(10, lambda: tries[0] > 2)
    finally:
        endpoint.close()
    assert told[0] == "the connection's thread begins anew: OwnKindOfCancellation"
    assert not endpoint._thread.is_alive()


@pytest.mark.parametrize(
    ("told", "takes", "sizes"), [(0, 9, [7]), (3, 9, [3, 3, 1]), (0, 2, [7, 3, 1, 1, 1, 1, 1, 1, 1])]
)
def test_a_server_is_asked_for_no_more_than_it_takes(told: int, takes: int, sizes: list[int]) -> None:
    """By what it tells, or where it tells nothing by what it refuses; the next request begins where this one ended."""
    asked, pieces = list[int](), Pieces(told)

    async def ask(piece: Sequence[int], left_s: float) -> list[int]:
        asked.append(len(piece))
        assert left_s > 0
        if len(piece) > takes:
            raise TooManyError("BadTooManyOperations")
        return [-n for n in piece]

    assert asyncio.run(in_pieces(range(7), pieces, ask, 5.0)) == [-n for n in range(7)]
    assert asked == sizes
    asked.clear()
    asyncio.run(in_pieces(range(7), pieces, ask, 5.0))
    assert max(asked) <= takes


@pytest.mark.parametrize("answers", [0, 3])
def test_a_server_that_gives_another_number_of_answers_is_a_fault(answers: int) -> None:
    async def ask(piece: Sequence[int], _: float) -> list[int]:
        return [0] * answers

    with pytest.raises(EndpointError):
        asyncio.run(in_pieces(range(2), Pieces(), ask, 5.0))


def test_limits_that_a_server_does_not_tell_are_none() -> None:
    def limit(value: object, kind: ua.VariantType) -> ua.DataValue:
        return ua.DataValue(ua.Variant(value, kind))

    found = OperationLimits.told([limit(20, ua.VariantType.UInt32), limit(0, ua.VariantType.UInt32), ua.DataValue()])
    assert [found.read.most, found.write.most, found.browse.most] == [20, 0, 0]
