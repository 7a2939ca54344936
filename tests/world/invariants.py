"""What must hold in a world, whatever happens: by what a server was asked to write, and what stations say they did."""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np

from loopwright.serving import Mode
from loopwright.serving.opcua.endpoint import ANSWER_PART, LONGEST_OPC_ANSWER_S
from loopwright.serving.station.settings import MAX_AGE, TRANSFER
from world.plant_server import SLOWEST_S, PlantServer, Written
from world.stations import ScanSeen, Side

MOST_WAITING = 8  # MVs that wait for a connection
AFTER_TAKING = 2  # periods in which a loop that has lost the lease finds that out
TURN = 3  # periods in which no loop writes, another one, and the first again
ROUNDING = 1e-6  # of a range: of a node that holds a Float


@dataclass(slots=True)
class _Of:
    """What is known of one side between two scans."""

    last: ScanSeen | None = None
    held: np.ndarray | None = None  # what HOLD has written
    commands: deque[tuple[float, np.ndarray | None]] = field(default_factory=lambda: deque(maxlen=400))  # by scan
    lives: int = 0


@dataclass(eq=False)
class Judge:
    """Looks at all scans and writes since it looked last. ``broken`` has the rules that were broken, with the time."""

    sides: list[Side]
    server: PlantServer
    broken: list[str] = field(default_factory=list)
    scans: int = 0
    wrote: int = 0
    faults: int = 0

    def __post_init__(self) -> None:
        self._of = {side.name: _Of() for side in self.sides}
        self._owners: dict[str, str] = {}
        self._turns: list[Written] = []  # the last three
        self._digest = hashlib.sha256()
        m = self.server.manifest
        self._low, self._high = (np.array([getattr(s, end) for s in m.mv]) for end in ("low", "high"))
        self._period_s = m.period_s
        # After a scan, a write that it sent has come: the lease is taken first, by two requests.
        self._late_s = 3 * min(ANSWER_PART * m.period_s, LONGEST_OPC_ANSWER_S) + SLOWEST_S + 1.0

    def digest(self) -> int:
        """A number of all that was written and when: equal histories have the same."""
        return int.from_bytes(self._digest.digest()[:6], "big")

    def breaks(self, time_s: float, rule: str) -> None:
        """Note a broken rule once."""
        if rule.partition(" (")[0] not in (line.partition(": ")[2].partition(" (")[0] for line in self.broken):
            self.broken.append(f"{time_s:.1f} s: {rule}")

    # ------------------------------------------------------------------------------------------------- as time goes on
    def look(self) -> None:
        """Judge what has happened."""
        for side in self.sides:
            scans, side.scans = side.scans, []
            for scan in scans:
                self._scan(side, scan)
            if side.alive and len(side.station.endpoint.sender.outbox) > MOST_WAITING:
                self.breaks(side.world.now_s, "few MVs wait to be sent")
        written, self.server.written[:] = list(self.server.written), []
        for one in written:
            self._write(one)

    def _scan(self, side: Side, seen: ScanSeen) -> None:
        of, command, sample = self._of[side.name], seen.command, seen.sample
        self.scans += 1
        self.faults += bool(command.fault)
        if of.lives != side.lives:
            of.last, of.held, of.lives = None, None, side.lives
        time_s, mv = seen.time_s, np.asarray(command.mv)
        of.commands.append((time_s, mv if command.writes else None))
        if not command.writes:
            of.held = None
        else:
            if not np.all(np.isfinite(mv)) or np.any(mv < self._low) or np.any(mv > self._high):
                self.breaks(time_s, "a commanded MV lies within its range")
            if command.mode is Mode.HOLD:
                if of.held is not None and not seen.asked and not np.array_equal(of.held, mv):
                    self.breaks(time_s, "HOLD holds")
                of.held = None if seen.lost else mv
            else:
                of.held = None
            entered = of.last is not None and of.last.command.mode is not Mode.AUTO
            if command.mode is Mode.AUTO and entered and sample is not None and sample.mv_applied is not None:
                moved = np.abs(mv - sample.mv_applied) / (self._high - self._low)
                continuous = np.array([s.values is None for s in self.server.manifest.mv])
                if np.any(moved[continuous] > 1 / TRANSFER + ROUNDING):
                    self.breaks(time_s, "the first move in AUTO is a step of the transfer")
            if command.mode is Mode.AUTO and command.law_mv is None:
                self.breaks(time_s, "in AUTO the law was stepped")
        if command.mode is Mode.AUTO and seen.told_s > MAX_AGE * self._period_s + 1.0:
            self.breaks(time_s, "in AUTO the values are young")
        if command.mode is Mode.AUTO and command.fault:
            self.breaks(time_s, "a fault in AUTO changes the mode to HOLD")
        of.last = seen

    def _write(self, one: Written) -> None:
        self.wrote += one.taken
        self._digest.update(repr((round(one.time_s, 6), one.by, sorted(one.mv.items()))).encode())
        m, time_s = self.server.manifest, one.time_s
        for s in m.mv:
            value, room = one.mv.get(s.name, s.middle), ROUNDING * (s.high - s.low)
            if not s.low - room <= value <= s.high + room:
                self.breaks(time_s, "an MV that comes to the server lies within its range")
        if not one.shown:
            self.breaks(time_s, "nothing is written before a reading has told where the MV stands")
        self._turns = [*self._turns[-2:], one]
        first, other, again = (self._turns[0], self._turns[len(self._turns) // 2], one)
        if first.by == one.by != other.by and again.time_s - first.time_s <= TURN * self._period_s:
            self.breaks(time_s, "two loops do not write in turns")
        side = next(side for side in self.sides if side.name == one.by)
        recent = [mv for at, mv in self._of[side.name].commands if time_s - self._late_s <= at <= time_s]
        value = np.array([one.mv.get(s.name, np.nan) for s in m.mv])
        room = ROUNDING * (self._high - self._low)
        if not any(mv is not None and np.all(np.abs(mv - value) <= room) for mv in recent):
            self.breaks(time_s, "what comes to the server was commanded just now, and nothing in SHADOW")
        self._owners |= {other.station.endpoint.sender.lease.owner: other.name for other in self.sides}
        had_s = [s for owner, s in one.lost_s.items() if self._owners.get(owner) == one.by]
        just_lost = time_s - max(had_s, default=-np.inf) <= AFTER_TAKING * self._period_s + self._late_s
        if self._owners.get(one.owner) != one.by and not just_lost:
            self.breaks(time_s, "who writes has the lease, or lost it just now")

    # ------------------------------------------------------------------------------------------- after a quiet time
    def at_rest(self) -> None:
        """After a time without a fault: no loop has one, and no alarm is active."""
        owner = str(self.server.items["lease"].value).partition(" ")[0]
        for side in self.sides:
            loop, now = side.station.loop, side.world.now_s
            if not side.alive or loop is None:
                self.breaks(now, "a loop that is started runs")
                continue
            if len(self.sides) > 1 and self._owners.get(owner, side.name) != side.name:
                continue  # the other loop has the plant
            if loop.fault:
                self.breaks(now, f"a loop goes back to AUTO once its faults are over (it says: {loop.fault})")
            active = {e.alarm: e.raised for e in side.events() if e.kind in ("fault", "connection") and e.alarm}
            for alarm in (name for name, raised in active.items() if raised):
                self.breaks(now, f"an alarm ends with its fault ({alarm})")
            if side.station.journal.trouble:
                self.breaks(now, "the journal writes again")

    def at_end(self) -> None:
        """After the end of all stations: what they did stands in their journals."""
        for side in self.sides:
            now = side.world.now_s
            if side.alive:
                self.breaks(now, "a loop that is ended ends")
                continue
            rows, lost, scans = side.rows(), side.unwritten, side.scanned - side.before
            if not scans - lost <= rows <= scans:
                self.breaks(now, f"each scan is in the journal, or counted as lost ({rows} of {scans}, lost {lost})")
            noted = Counter(e.what for e in side.events() if e.who == "anna")
            missing = Counter(side.asked) - noted
            if missing.total() > lost:
                self.breaks(now, f"each change stands in the journal with who made it ({next(iter(missing))})")
