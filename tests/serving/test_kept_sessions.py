"""A session and a secure channel that last for a shorter time than lies between two scans."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from asyncua import Server, ua
from asyncua.common.connection import SecureConnection
from asyncua.crypto.cert_gen import setup_self_signed_certificate
from asyncua.server.internal_session import InternalSession
from cryptography.x509.oid import ExtendedKeyUsageOID
from plant_servers import RunningLoop, free_port, loop_toml
from processes import within

from loopwright.serving import Mode
from loopwright.serving.opcua.certificates import make
from loopwright.serving.opcua.link import Link
from loopwright.serving.opcua.settings import Server as ServerSettings
from loopwright.serving.station.settings import Hold, Settings

SPACE = "urn:loopwright:plant"
GRANTED_S = 4.0  # of a session and of a channel, which are renewed a second before: a busy machine needs some
PERIOD_S = 5.0  # of the loop, by the machine's clock
SPEAKS_S = 1.5  # of a loop that speaks all the time: a machine that stands still for a moment loses no connection


class ShortServer:
    """A server with the nodes of the thiosulfate reactor that keeps a session for ``GRANTED_S``."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.endpoint = folder, f"opc.tcp://127.0.0.1:{free_port()}"
        self._ready, self._ended = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=asyncio.run, args=(self._serve(),), daemon=True)

    def start(self) -> None:
        self._thread.start()
        assert self._ready.wait(30)

    def end(self) -> None:
        self._ended.set()
        self._thread.join(20)

    async def _serve(self) -> None:
        server = Server()
        await server.init()
        server.set_endpoint(self.endpoint)
        server.iserver.min_session_timeout_ms = server.iserver.max_session_timeout_ms = 1000 * GRANTED_S
        key, certificate = self.folder / "key.pem", self.folder / "certificate.der"
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
        await server.set_application_uri("urn:short")
        await setup_self_signed_certificate(key, certificate, "urn:short", "127.0.0.1", uses, {})
        await server.load_certificate(str(certificate))
        await server.load_private_key(str(key))
        server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
        index = await server.register_namespace(SPACE)
        values = {"PV.C_A": 0.95, "PV.T": 320.0, "MV.T_j": 250.0, "RB.T_j": 250.0}
        nodes = {}
        for tag, value in values.items():
            nodes[tag] = await server.nodes.objects.add_variable(f"ns={index};s={tag}", f"{index}:{tag}", value)
            await nodes[tag].set_writable()
        async with server:
            self._ready.set()
            while not self._ended.is_set():
                await asyncio.sleep(0.02)
                for tag in ("PV.C_A", "PV.T"):
                    await nodes[tag].write_value(values[tag])  # with a new source time
                await nodes["RB.T_j"].write_value(await nodes["MV.T_j"].read_value())


@pytest.fixture
def opens(monkeypatch: pytest.MonkeyPatch) -> list[ua.SecurityTokenRequestType]:
    """The requests for a channel, which is granted for ``GRANTED_S``."""
    asked: list[ua.SecurityTokenRequestType] = []
    granted = SecureConnection.open

    def shorter(self: SecureConnection, params: Any, server: Any) -> Any:
        asked.append(params.RequestType)
        params.RequestedLifetime = int(1000 * GRANTED_S)
        return granted(self, params, server)

    monkeypatch.setattr(SecureConnection, "open", shorter)
    return asked


@pytest.fixture
def sessions(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The timeouts that were asked for, session by session [s]."""
    asked: list[float] = []
    created = InternalSession.create_session

    async def noted(self: InternalSession, params: Any, sockname: Any = None) -> Any:
        asked.append(params.RequestedSessionTimeout / 1000)
        return await created(self, params, sockname)

    monkeypatch.setattr(InternalSession, "create_session", noted)
    return asked


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ShortServer]:
    """One for all tests: its address space takes a second to make."""
    made = ShortServer(tmp_path_factory.mktemp("server"))
    made.start()
    yield made
    made.end()


@pytest.fixture
def server(started: ShortServer, opens: list[Any], sessions: list[float]) -> ShortServer:
    """Counted from here on."""
    return started


def settings(folder: Path, server: ShortServer, period_s: float) -> Settings:
    """Of a loop of this period; its controller's is half a second."""
    make(folder / "loop.der", folder / "loop.pem")
    found = Settings.read(loop_toml(folder, server.endpoint, speed=0.5 / period_s, start="AUTO"))
    secured = replace(
        found.server,
        security="Basic256Sha256",
        insecure=False,
        certificate=folder / "loop.der",
        private_key=folder / "loop.pem",
    )
    return replace(found, server=secured, hold=Hold(recover_after=1))


def test_a_session_outlives_periods_that_are_longer_than_it(
    server: ShortServer, sessions: list[float], opens: list[ua.SecurityTokenRequestType], tmp_path: Path
) -> None:
    running = RunningLoop(settings(tmp_path, server, PERIOD_S))  # which waits for three scans
    running.end()
    assert [(c.mode, c.fault) for c in running.commands[:3]] == [(Mode.AUTO, "")] * 3
    assert running.station.endpoint.connections == 1
    assert sessions == [60.0]
    assert opens.count(ua.SecurityTokenRequestType.Renew) >= 2


def test_a_channel_is_renewed_under_a_loop_that_speaks_all_the_time(
    server: ShortServer, opens: list[ua.SecurityTokenRequestType], tmp_path: Path
) -> None:
    patient = settings(tmp_path, server, SPEAKS_S)
    running = RunningLoop(replace(patient, guards=replace(patient.guards, max_age_s=5.0)))
    assert within(60, lambda: opens.count(ua.SecurityTokenRequestType.Renew) >= 3)
    n = running.station.scans
    assert within(20, lambda: running.station.scans > n + 2)
    running.end()
    assert running.station.endpoint.connections == 1


@pytest.mark.parametrize(("period_s", "wanted_s"), [(0.5, 60.0), (60.0, 180.0), (80.0, 240.0), (7200.0, 3600.0)])
def test_a_session_is_asked_for_that_lasts_some_periods(
    server: ShortServer, sessions: list[float], tmp_path: Path, period_s: float, wanted_s: float
) -> None:
    where: ServerSettings = settings(tmp_path, server, 0.5).server

    async def act() -> None:
        await (await Link.opened(where, period_s)).close()

    asyncio.run(act())
    assert sessions == [wanted_s]
