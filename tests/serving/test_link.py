"""Deadlines of a connection, against a library that raises what it should not."""

from __future__ import annotations

import asyncio

import pytest
from processes import within

from serving import Controller
from serving.opcua.endpoint import OpcUaEndpoint
from serving.opcua.link import Link, in_time
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
