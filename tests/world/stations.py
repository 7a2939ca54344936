"""Stations in a world: their machines, what they do scan by scan, and their deaths."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from loopwright.serving import Command, Mode, Sample
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.journal import Journal, JournalReader
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.link import Link
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.station.machine import Machine
from loopwright.serving.station.requests import Request, change
from loopwright.serving.station.settings import Hold, JournalSettings, Settings
from loopwright.serving.station.station import Station
from loopwright.serving.trust import Controller
from loopwright.serving.words import first_line
from world.plant_server import HEARTBEAT, LEASE, SPACE, WATCHDOG, PlantClient, PlantServer
from world.virtual_time import VirtualTime

RECOVER_AFTER = 3  # good samples that end a fault
TENDED_S = 60.0  # between two looks after locks


class SteppedJournal(Journal):
    """Written by the world's time in place of a thread; a disk that is ``stuck`` takes nothing until then."""

    world: VirtualTime

    def _start(self) -> None:
        self._due, self.stuck_until_s, self.dead = False, 0.0, False

    def _put(self, kind: str, row: Any) -> None:
        super()._put(kind, row)
        self._schedule()

    def _schedule(self) -> None:
        if not self._due:
            self._due = True
            wait_s = max(self.gathers_s, self.stuck_until_s - self.world.now_s)
            self._writing_s = self.world.now_s if self.stuck_until_s > self.world.now_s else None
            self.world.later(wait_s, self._comes)

    def _comes(self) -> None:
        self._due = False
        if self.dead:
            return
        if self.stuck_until_s > self.world.now_s:
            self._schedule()
            return
        self._turn()
        if len(self._queue):
            self._schedule()

    def _finished(self) -> bool:
        while not self._turn():
            pass
        self.dead = True
        return True


class WorldEndpoint(OpcUaEndpoint):
    """Its connection is a task of the world's loop."""

    world: VirtualTime
    refused = False  # whether the last MV was not taken

    def start(self) -> None:
        self.task = self.world.loop.create_task(self._keep_connected())
        self.task.add_done_callback(self.world.task_ended)

    def write(self, mv: Any) -> None:
        try:
            super().write(mv)
        except BaseException:
            self.refused = True
            raise

    def close(self) -> None:
        self._closed.set()
        self._stir()
        while not self.task.done():  # only actors wait
            self.world.wait(1.0)


class _Door:
    """Nobody knocks: what is asked for comes by ``Side.ask``."""

    path = Path("no.door")

    def __init__(self, *_: Any) -> None: ...

    def tend(self) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""


@dataclass(frozen=True, slots=True)
class ScanSeen:
    """One scan: what the station made of it, and the mode before it."""

    time_s: float
    sample: Sample | None
    command: Command
    before: Mode
    asked: bool  # whether somebody asked for something before it
    lost: bool  # whether its MV, or the one before, is known not to have come to the plant
    told_s: float  # how long ago the machine was told the plant's values


@dataclass(eq=False)
class Side:
    """A machine with a station on it; after a death the next one begins on the same files."""

    name: str
    world: VirtualTime
    server: PlantServer
    controller: Controller
    folder: Path
    start: str
    numbered: bool = False  # nodes by the number of their namespace
    heartbeat: bool = True
    rewrite_s: float = 0.0
    watchdog: bool = False
    station: Station = field(init=False)
    scans: list[ScanSeen] = field(default_factory=list)  # taken away by whoever judges them
    told: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)  # what the station was asked for and took, as the journal has it
    lives: int = 0
    alive: bool = False
    scanned: int = 0  # of all lives
    before: int = 0  # of those, in a journal that was lost as a whole
    unwritten: int = 0  # scans and events that a death or the disk may have taken

    def settings(self) -> Settings:
        m = self.controller.manifest

        def ids(signals: Any) -> dict[str, str]:
            return {s.name: f"ns=2;s={s.name}" if self.numbered else f"nsu={SPACE};s={s.name}" for s in signals}

        nodes = Nodes(
            ids(m.pv),
            ids(m.mv),
            dv=ids(m.dv),
            lease=LEASE,
            heartbeat=HEARTBEAT if self.heartbeat else "",
            watchdog=WATCHDOG if self.watchdog else "",
        )
        server = Server("opc.tcp://plant:4840", security="None", insecure=True, rewrite_s=self.rewrite_s)
        return Settings(
            self.controller.path, server, nodes, start=self.start, accept_unproven=True,
            hold=Hold(recover_after=RECOVER_AFTER), journal=JournalSettings(self.journal),
        )  # fmt: skip

    @property
    def journal(self) -> Path:
        return self.folder / "loop.journal"

    def begin(self) -> None:
        """A station on this machine's files."""
        self.folder.mkdir(exist_ok=True)
        endpoint = type("Endpoint", (WorldEndpoint,), {"world": self.world})
        journal = type("Journal", (SteppedJournal,), {"world": self.world})
        machine = Machine(
            time=self.world, endpoint=self._endpoint(endpoint), journal=journal, door=_Door, tended=self._tended,
            locks=self.folder / "locks",
        )  # fmt: skip
        self.station = Station(self.settings(), tell=self.told.append, controller=self.controller, machine=machine)
        self.station.watch(self._seen)
        self.lives, self.alive, self._mode = self.lives + 1, True, Mode(self.start)
        self._leave = self.world.act(self._run)

    def _endpoint(self, kind: type[OpcUaEndpoint]) -> Callable[..., OpcUaEndpoint]:
        async def connect(server: Server, period_s: float) -> Link:
            return await Link.opened(server, period_s, lambda *_, **__: PlantClient(self.server, self.name))

        return lambda *given, **named: kind(*given, connect=connect, **named)

    def _tended(self, act: Callable[[], object], trouble: Callable[[str], None]) -> Any:
        of = self.lives

        def tend() -> None:
            if self.alive and self.lives == of:
                try:
                    act()
                    trouble("")
                except LoopwrightError as error:
                    trouble(first_line(error))
                self.world.later(TENDED_S, tend)

        self.world.later(TENDED_S, tend)
        return _Door()

    def _run(self) -> None:
        mine = self.station
        mine.run()
        self.unwritten += mine.journal.lost
        self.alive = False

    def _seen(self, sample: Sample | None, command: Command) -> None:
        if not self.alive:
            return
        self.scanned += 1
        asked, self._asked = getattr(self, "_asked", False), False
        endpoint: Any = self.station.endpoint
        lost, endpoint.refused = endpoint.refused, False
        told_s = self.world.now_s - self.server.answered_s.get(self.name, -1e9)
        self.scans.append(ScanSeen(self.world.now_s, sample, command, self._mode, asked, lost, told_s))
        assert self.station.loop is not None
        self._mode = self.station.loop.mode

    def ask(self, do: str, value: Any, who: str = "anna") -> str:
        """Ask the station for something; why it is refused at once, or empty."""
        loop = self.station.loop
        if loop is None:
            return "not begun"
        try:
            wanted = change(
                Request.read({"do": do, "value": value, "who": who, "accept_unproven": True}), loop, _nothing
            )
        except LoopwrightError as error:
            return first_line(error)

        def done(refused: str) -> None:
            self._asked = True
            if not refused:
                self.asked.append(wanted.what)

        self.station.ask(replace(wanted, done=done))
        return ""

    def die(self) -> None:
        """As a process is killed: nothing more is written, its locks and connections are gone."""
        station, self.alive = self.station, False
        journal: Any = station.journal
        journal.dead = True
        self.unwritten += len(journal._queue) + journal.lost
        if not self.journal.exists():
            self.forget()  # taken away in the moment before
        station.printer.end()
        with suppress(sqlite3.Error):
            journal._base.close()
        os.close(journal._lock)
        while station.lease._held:
            os.close(station.lease._held.popitem()[1])
        endpoint: Any = station.endpoint
        endpoint._closed.set()
        endpoint.task.cancel()
        if endpoint._link is not None:
            endpoint._link.abort()
        self._leave()

    def forget(self) -> None:
        """All that was written down is gone with the journal, which nobody had open who could make it again."""
        self.before, self.unwritten = self.scanned, 0
        self.asked.clear()

    def events(self) -> list[Any]:
        """All events of the journal."""
        with closing(JournalReader(self.journal)) as reader:
            return [event for _, event in reader.events()]

    def rows(self) -> int:
        """Scans in the journal."""
        with closing(sqlite3.connect(self.journal)) as base:
            (loose,) = base.execute("select count(*) from scan").fetchone()
            (packed,) = base.execute("select coalesce(sum(last - first + 1), 0) from block").fetchone()
        return int(loose) + int(packed)


def _nothing(*_: Any) -> Any:
    raise LoopwrightError("no other controller is here")
