"""A real OPC UA server of a simulated plant as a process of its own, and a wire to it that can be cut."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from queue import Queue
from typing import Any, ClassVar

from processes import within

from loopwright.pipeline.simulation import opcua_server
from loopwright.serving import Command, Controller, LoopError, Mode, Sample
from loopwright.serving.journal import JournalReader, ScanEntry
from loopwright.serving.station.control import ask
from loopwright.serving.station.machine import THIS_MACHINE, Machine
from loopwright.serving.station.requests import Change
from loopwright.serving.station.settings import Settings
from loopwright.serving.station.station import Station

ROOT = Path(__file__).parents[1]
UNKNOWN = "where the MV stands is not known"  # why a loop that has just lost its plant refuses for some scans
CASE, PID = "thiosulfate_cstr", ROOT / "artifacts" / "thiosulfate_cstr" / "pid.onnx"
MARK = "read by a test"  # a text that the journal keeps
SPACE = "nsu=urn:loopwright:plant;s="
LOOP = """
controller = "{pid}"
start = "{start}"
speed = {speed}
{more}
[server]
endpoint = "{endpoint}"
security = "None"
insecure = true
[nodes]
{nodes}
[nodes.pv]
C_A = "{space}PV.C_A"
T = "{space}PV.T"
[nodes.mv]
T_j = {{ node = "{space}MV.T_j", read_back = "{space}RB.T_j" }}
"""


def loop_toml(
    folder: Path, endpoint: str, *, speed: float, start: str = "AUTO", nodes: str = "", more: str = ""
) -> Path:
    """The file of a loop of PID on a served ``CASE``; ``nodes`` are lines of [nodes], ``more`` tables of their own."""
    path = folder / "loop.toml"
    path.write_text(
        LOOP.format(pid=PID, start=start, speed=speed, endpoint=endpoint, space=SPACE, nodes=nodes, more=more)
    )
    return path


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


class Plant:
    """``loopwright plant serve`` as a process. ``actuator`` tells what the MV nodes held, period by period."""

    def __init__(self, folder: Path, case: str, speed: float, *options: str) -> None:
        self.folder, self.port = folder, free_port()
        self.endpoint, self.log = f"opc.tcp://127.0.0.1:{self.port}", folder / "mv.jsonl"
        self._command = [
            sys.executable, "-m", "loopwright.pipeline", "plant", "serve", case, "--listen", f"127.0.0.1:{self.port}",
            "--speed", f"{speed:g}", "--folder", str(folder / "server"), "--log", str(self.log), *options,
        ]  # fmt: skip
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        before = len(self.actuator())
        environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
        with (self.folder / "server.log").open("a") as said:
            self.process = subprocess.Popen(
                self._command, cwd=self.folder, env=environment, stdout=said, stderr=said, text=True
            )
        assert within(60, lambda: len(self.actuator()) > before + 1), (self.folder / "server.log").read_text()

    def send(self, number: signal.Signals) -> None:
        assert self.process is not None
        self.process.send_signal(number)

    def end(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def actuator(self) -> list[dict[str, Any]]:
        if not self.log.exists():
            return []
        return [json.loads(line) for line in self.log.read_text().splitlines() if line.endswith("}")]


class Wire:
    """Passes bytes on to a port, at once or late, until it is cut: then it neither passes on nor closes."""

    def __init__(self, to: int) -> None:
        self.to, self.delay_s, self.cut = to, 0.0, False
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listening.getsockname()[1])
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        for s in [self._listening, *self._open]:
            with suppress(OSError):
                s.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listening.accept()
                if self.cut:
                    self._open.append(near)  # accepted, as by a switch on the way, and never answered
                    continue
                try:
                    far = socket.create_connection(("127.0.0.1", self.to))
                except OSError:
                    near.close()  # refused, as it would be without this wire
                    continue
                self._open += [near, far]
                for a, b in ((near, far), (far, near)):
                    threading.Thread(target=self._pass, args=(a, b), daemon=True).start()

    def _pass(self, source: socket.socket, to: socket.socket) -> None:
        came = Queue[tuple[float, bytes]]()  # each with when it is due, so that none is kept longer for those before it
        threading.Thread(target=self._deliver, args=(came, source, to), daemon=True).start()
        with suppress(OSError):
            while data := source.recv(65_536):
                came.put((time.monotonic() + self.delay_s, data))
        came.put((0.0, b""))

    def _deliver(self, came: Queue[tuple[float, bytes]], source: socket.socket, to: socket.socket) -> None:
        with suppress(OSError):
            while (next_one := came.get())[1]:
                due, data = next_one
                time.sleep(max(due - time.monotonic(), 0.0))
                if self.cut:
                    return
                to.sendall(data)
        if not self.cut:
            for s in (source, to):
                with suppress(OSError):
                    s.close()


class RunningLoop:
    """A station in a thread, as a loop.toml or its settings say, with what it did."""

    begun: ClassVar[list[RunningLoop]] = []  # that may run still

    def __init__(self, settings: Path | Settings, machine: Machine = THIS_MACHINE) -> None:
        self.settings = Settings.read(settings) if isinstance(settings, Path) else settings
        self.told: list[str] = []
        self.commands: list[Command] = []
        self.marks = 0  # in the journal
        where = self.settings  # loaded here: no process has to try the first steps of a test's file
        loaded = Controller(where.controller, where.sha256 or None, where.trusted)
        self.station = Station(where, tell=self.told.append, controller=loaded, machine=machine)
        self.station.watch(self._seen)
        self.thread = threading.Thread(target=self.station.run, daemon=True)
        self.thread.start()
        self.begun.append(self)
        assert within(30, lambda: self.station.scans > 2), self.told

    def _seen(self, _: Sample | None, command: Command) -> None:
        self.commands.append(command)

    def ask(self, act: Callable[..., None], what: str) -> str:
        """How a change went."""
        said: list[str] = []
        self.station.ask(Change(act, what, "test", done=said.append))
        assert within(10, lambda: bool(said))
        return said[0]

    def does(self, what: str, value: object, who: str = "anna") -> str:
        """What a request at its door did; asked again while the loop has just lost its plant."""
        said: list[str] = []

        def done() -> bool:
            try:
                said.append(ask(self.settings.journal.file, {"do": what, "value": value, "who": who})["done"])
            except LoopError as refusal:
                if UNKNOWN not in str(refusal):
                    raise
            return bool(said)

        assert within(20, done)
        return said[0]

    def since(self, start: int, mode: Mode) -> list[Command]:
        """Its scans from a place on that had a mode and no fault."""
        return [c for c in self.commands[start:] if c.mode is mode and not c.fault]

    def becomes(self, mode: Mode, seconds: float = 30.0, scans: int = 1) -> int:
        """Wait until so many scans in a row have a mode; the place of the first of them from now."""
        start = len(self.commands)

        def there() -> bool:
            last = self.commands[start:][-scans:]
            return len(last) == scans and all(c.mode is mode for c in last)

        assert within(seconds, there), (mode, self.told, [(c.mode, c.fault) for c in self.commands[start:]][-10:])
        return next(i for i, c in enumerate(self.commands[start:]) if c.mode is mode)

    def _written(self) -> None:
        """Wait until the journal, which gathers for a while, has written what it was given up to now."""
        if self.thread.is_alive():
            self.marks += 1
            self.station.journal.keep(MARK, str(self.marks))
            assert within(20, lambda: self._marked() or not self.thread.is_alive()), self.told

    def _marked(self) -> bool:
        with closing(JournalReader(self.settings.journal.file)) as reader:
            return reader.learnt(MARK) == str(self.marks)

    def scans(self) -> list[ScanEntry]:
        """What its journal holds."""
        self._written()
        with closing(JournalReader(self.settings.journal.file)) as reader:
            return [scan for _, _, scan in reader.scans()]

    def events(self) -> list[str]:
        """What its journal says of changes, faults and alarms."""
        self._written()
        with closing(JournalReader(self.settings.journal.file)) as reader:
            return [f"{e.kind} {e.who}: {e.what}" for _, e in reader.events()]

    def changes(self, begin: str, who: str = "anna") -> list[str]:
        """The changes by somebody whose words begin so."""
        return [line for line in self.events() if line.startswith(f"change {who}: {begin}")]

    def end(self) -> None:
        self.station.end()
        self.thread.join(20)
        assert not self.thread.is_alive()

    @classmethod
    def end_all(cls) -> None:
        """Those, too, whose test failed: they would write to the plant of the next one."""
        while cls.begun:
            cls.begun.pop().end()


def spoil(plant: Plant, tag: str, fault: str) -> None:
    """Spoil a node of a served plant, or mend it with an empty text."""
    # In a thread of its own: a browser that is driven has a loop in this one.
    with ThreadPoolExecutor(1) as apart:
        apart.submit(asyncio.run, opcua_server.spoil(plant.endpoint, tag, fault)).result()
