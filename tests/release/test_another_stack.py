"""A loop on node-opcua, a server of another stack than the client's: signed, encrypted, with a password, in REAL.

`npm ci` in tests/node_opcua brings it; without it these tests are skipped.
"""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from plant_servers import RunningLoop, free_port
from processes import within

from loopwright.pipeline.__main__ import main
from loopwright.serving import Mode
from loopwright.serving.journal import JournalReader
from loopwright.serving.opcua.certificates import APPLICATION, make, valid_until

HERE = Path(__file__).parents[1] / "node_opcua"
PID = Path(__file__).parents[2] / "artifacts" / "thiosulfate_cstr" / "pid.onnx"
NODE = shutil.which("node")
if NODE is None or not (HERE / "node_modules").is_dir():
    pytest.skip("node or its packages are missing (npm ci in tests/node_opcua)", allow_module_level=True)

LIFETIME_MS = 2_500  # of a secure channel: the shortest that node-opcua grants
PERIOD_MS = 100
SPEED = 1.0  # of the loops: periods of .5 s, of which an answer may take .4 s
PATIENT_SPEED = 0.4  # periods of 1.25 s: a busy machine loses no connection to a loop that waits .8 of it for an answer


class NodeServer:
    """The server as a process; ``lines`` is what it has said of its MV node."""

    def __init__(self, folder: Path, *more: str) -> None:
        self.folder, self.port, self.more = folder, free_port(), more
        self.log = folder / "node.log"
        self.process: subprocess.Popen[str] | None = None

    @property
    def endpoint(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port}"

    def start(self) -> None:
        assert NODE is not None
        before = self.log.read_text().count('"ready"') if self.log.exists() else 0
        with self.log.open("a") as said:
            self.process = subprocess.Popen(
                [NODE, str(HERE / "server.js"), str(self.port), str(self.folder), str(PERIOD_MS), *self.more],
                stdout=said,
                stderr=said,
            )
        assert within(60, lambda: self.log.read_text().count('"ready"') > before), self.log.read_text()

    def end(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def rows(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.log.read_text().splitlines() if line.startswith('{"asked"')]

    def moves(self) -> int:
        """How often the MV's node has changed."""
        asked = [row["asked"] for row in self.rows()]
        return sum(a != b for a, b in pairwise(asked))

    def spoil(self, number: int) -> None:
        """1: the temperature's quality is bad."""

        async def write() -> None:
            client = Client(self.endpoint)
            client.application_uri = APPLICATION
            client.set_user("loopwright")
            client.set_password("a secret")
            await client.set_security(
                SecurityPolicyBasic256Sha256,
                str(self.folder / "loop-certificate.der"),
                str(self.folder / "loop-key.pem"),
            )
            async with client:
                index = await client.get_namespace_index("urn:loopwright:plant")
                value = ua.Variant(number, ua.VariantType.Int32)
                await client.get_node(f"ns={index};s=Faults.T").write_value(value)

        asyncio.run(write())


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeServer]:
    made = NodeServer(tmp_path_factory.mktemp("node"))
    made.start()
    yield made
    made.end()


@pytest.fixture
def settings(server: NodeServer, monkeypatch: pytest.MonkeyPatch) -> Path:
    return settings_of(server, monkeypatch, SPEED)


def settings_of(server: NodeServer, monkeypatch: pytest.MonkeyPatch, speed: float) -> Path:
    monkeypatch.setenv("LOOP_PASSWORD", "a secret")
    path = server.folder / "loop.toml"
    path.unlink(missing_ok=True)
    assert main(["loop", "init", str(PID), "--endpoint", server.endpoint, "--out", str(path)]) == 0
    text = path.read_text()
    for old, new in (
        ('page = "127.0.0.1:8080"', f"speed = {speed}"),
        ('# user = "loopwright"', 'user = "loopwright"'),
        ('# password_env = "LOOP_PASSWORD"', 'password_env = "LOOP_PASSWORD"'),
        ("s=Control.Heartbeat", "s=Heartbeat"),
        ("s=Control.Watchdog", "s=Watchdog"),
    ):
        assert old in text
        text = text.replace(old, new)
    path.write_text(re.sub("max_age_s = .*", "max_age_s = 5", text))  # this machine has other work beside it
    return path


def test_check_reads_what_this_server_says(settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["loop", "check", str(settings)]) == 0
    said = capsys.readouterr().out
    assert "nothing would stop the loop" in said
    row = next(line for line in said.splitlines() if line.startswith("PV T"))
    assert "Float" in row
    assert "200 .. 600" in row


def test_a_wrong_password_is_one_line(
    settings: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LOOP_PASSWORD", "a guess")
    capsys.readouterr()
    assert main(["loop", "check", str(settings)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "refuses" in said
    assert "a guess" not in said


def test_a_loop_from_the_shadow_through_a_fault_and_a_killed_server_that_trusts_a_user_by_then(
    settings: Path, server: NodeServer, capsys: pytest.CaptureFixture[str]
) -> None:
    """The server looks as it starts for the certificates of users that its operator trusts."""
    by_certificate = _refused_user(settings, server, capsys)
    _fault_and_restart(settings, server)
    assert main(["loop", "check", str(by_certificate)]) == 0
    said = capsys.readouterr().out
    assert "nothing would stop the loop" in said
    assert f"certificate of the user: valid until {valid_until(server.folder / 'user.der')}" in said


def _refused_user(settings: Path, server: NodeServer, capsys: pytest.CaptureFixture[str]) -> Path:
    """The settings of a user by certificate, whom the server refuses until it starts anew."""
    user, key = server.folder / "user.der", server.folder / "user-key.pem"
    make(user, key)
    text = settings.read_text()
    for line in ('user = "loopwright"', 'password_env = "LOOP_PASSWORD"'):
        assert f"\n{line}" in text
        text = text.replace(f"\n{line}", f"\n# {line}")
    by_certificate = server.folder / "by-certificate.toml"
    by_certificate.write_text(
        text.replace("[server]", '[server]\nuser_certificate = "user.der"\nuser_key = "user-key.pem"')
    )
    capsys.readouterr()
    assert main(["loop", "check", str(by_certificate)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"let the server trust {user}" in said
    users = server.folder / "users"
    (rejected,) = (users / "rejected").iterdir()
    rejected.rename(users / "trusted" / "certs" / rejected.name)  # as its operator would
    return by_certificate


def _fault_and_restart(settings: Path, server: NodeServer) -> None:
    """A loop on the server from its first scan on."""
    loop = RunningLoop(settings)
    journal = loop.settings.journal.file

    def becomes(mode: Mode) -> bool:
        return within(40, lambda: (seen := loop.station.snapshot) is not None and seen.command.mode is mode)

    try:
        assert not server.moves()  # a shadow writes nothing
        assert loop.does("mode", "AUTO").startswith("mode SHADOW -> AUTO")
        assert loop.does("sp", {"C_A": 0.55})
        # Moves, not values: this PID swings this plant from one end of the MV's range to the other.
        assert within(60, lambda: server.moves() > 5)
        for row in server.rows():
            assert row["type"] == "Float"
            assert row["asked"] == float(np.float32(row["asked"]))
            assert 0 <= row["asked"] <= 500
        server.spoil(1)
        assert within(40, lambda: any("PV T: BadSensorFailure" in event for event in loop.events()))
        assert becomes(Mode.HOLD)
        server.spoil(0)
        assert becomes(Mode.AUTO)
        server.end()
        assert becomes(Mode.HOLD)
        server.start()
        assert becomes(Mode.AUTO)
        assert loop.station.endpoint.connections >= 2
    finally:
        loop.end()
    with closing(JournalReader(journal)) as reader:
        scans = list(reader.scans())
        events = [event.what for _, event in reader.events()]
    assert [id_ for id_, _, _ in scans] == list(range(1, len(scans) + 1))
    assert {"AUTO", "HOLD", "SHADOW"} == {scan.mode for _, _, scan in scans}
    assert any("BadSensorFailure" in what for what in events)
    assert sum(what.startswith("connected to") for what in events) >= 2


def test_a_channel_that_lasts_some_seconds_is_renewed_under_the_loop(
    server: NodeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This server forgets a token after five quarters of its lifetime, and takes nothing more under it."""
    shutil.copytree(server.folder / "pki", tmp_path / "pki")  # its keys, which take seconds to make
    server = NodeServer(tmp_path, str(LIFETIME_MS))
    server.start()
    loop = RunningLoop(settings_of(server, monkeypatch, PATIENT_SPEED))
    try:
        link = loop.station.endpoint._link
        assert link is not None
        assert link.client.secure_channel_timeout == LIFETIME_MS
        assert loop.does("mode", "AUTO")
        lifetimes = 3
        period_ms = 1000 * loop.station.manifest.period_s / PATIENT_SPEED
        assert within(60, lambda: len(loop.commands) > lifetimes * LIFETIME_MS / period_ms)
        assert loop.station.endpoint.connections == 1
        written = server.rows()[-1]["asked"]
        loop.does("sp", {"C_A": 0.8 if written > 200 else 0.2})  # to the other end of the MV's range
        assert within(20, lambda: server.rows()[-1]["asked"] != written)  # it is written, too
    finally:
        loop.end()
        server.end()
