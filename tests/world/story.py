"""A history of a world: what happens to stations, servers, networks and disks, drawn from a seed, played, shortened."""

from __future__ import annotations

import random
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from asyncua import ua

from loopwright.serving.trust import Controller
from world.invariants import Judge
from world.plant_server import BAD, DOUBLE, GOOD, OTHER, PlantServer
from world.stations import Side
from world.virtual_time import VirtualTime

PERIODS, HAPPEN = 1_200, 40  # of a history: periods, and what happens
SHORTEST_S, LONGEST = 2.0, 60.0  # of a fault: seconds, and periods
QUIET = 70  # periods without a fault at the end, in which all must come right
ARTIFACTS = Path(__file__).parents[2] / "artifacts"
LAWS = ("ph_neutralization/pid", "batch_reactor/pid", "reversible_cstr/pid", "jacketed_batch_reactor/fuzzy_feedforward")


@dataclass(frozen=True, slots=True)
class Happening:
    """Something that happens at a time: its name, the machine or the plant that it happens to, and its numbers."""

    time_s: float
    what: str
    side: int
    lasts_s: float
    number: float  # of 0..1

    def __str__(self) -> str:
        return f"{self.time_s:.0f} s: {self.what} ({'ab'[self.side]}, {self.lasts_s:.0f} s, {self.number:.3f})"


@dataclass(frozen=True, slots=True)
class Setting:
    """What a history begins with."""

    seed: int
    law: str
    starts: tuple[str, ...]  # of each side
    periods: int
    numbered: bool
    heartbeat: bool
    rewrite: bool


@dataclass(frozen=True, slots=True)
class Told:
    """What came of a history: rules that were broken, each with when; and how much was played."""

    broken: tuple[str, ...]
    scans: int
    virtual_s: float
    wrote: int
    faults: int
    digest: int


@cache
def _controller(law: str) -> Controller:
    return Controller(ARTIFACTS / f"{law}.onnx")


class World:
    """One plant and up to two machines beside it."""

    def __init__(self, setting: Setting, folder: Path) -> None:
        self.controller = _controller(setting.law)
        self.time = VirtualTime()
        self.server = PlantServer(self.controller.manifest, self.time, random.Random(setting.seed))
        period_s = self.period_s = self.controller.manifest.period_s
        self.sides = [
            Side(
                name, self.time, self.server, self.controller, folder / name, start, setting.numbered,
                setting.heartbeat and name == "a", 10 * period_s * setting.rewrite,
            )
            for name, start in zip("ab", setting.starts, strict=False)
        ]  # fmt: skip
        self.judge = Judge(self.sides, self.server)
        self.healing: list[Callable[[], None]] = []

    def ends(self, h: Happening, heal: Callable[[], None]) -> None:
        """The happening is over after its time, or when all is healed."""
        self.healing.append(heal)
        self.time.later(h.lasts_s, heal)

    def do(self, h: Happening) -> None:
        """Let it happen."""
        side = self.sides[h.side % len(self.sides)]
        HAPPENINGS[h.what](self, side, h)

    def heal(self) -> None:
        """All faults are over; whoever is dead lives again."""
        for heal in self.healing:
            heal()
        self.healing.clear()
        net = self.server.network
        net.silent_until_s = net.slow_until_s = net.refused_until_s = self.time.now_s
        for side in self.sides:
            if not side.alive:
                side.begin()


# ------------------------------------------------------------------------------------------------------ what may happen
def _mode(world: World, side: Side, h: Happening) -> None:
    modes = ("AUTO", "AUTO", "AUTO", "MANUAL", "SHADOW", "HOLD")
    side.ask("mode", modes[int(h.number * len(modes))])


def _set_point(world: World, side: Side, h: Happening) -> None:
    side.ask("sp", {s.name: s.low + h.number * (s.high - s.low) for s in world.controller.manifest.sp})


def _by_hand(world: World, side: Side, h: Happening) -> None:
    side.ask("mv", {s.name: s.low + h.number * (s.high - s.low) for s in world.controller.manifest.mv if not s.values})


def _sensor(world: World, side: Side, h: Happening) -> None:
    """A reading is bad, no number, or far beyond its range."""
    m = world.controller.manifest
    signals = m.pv if h.number < 0.8 else m.mv
    s = signals[int(h.number * 97) % len(signals)]
    item = world.server.items[s.name]
    if int(h.number * 1000) % 2 or s in m.mv:
        item.status = BAD
        world.ends(h, lambda: setattr(item, "status", GOOD))
    else:
        item.shown = float("nan") if h.number < 0.4 else s.high + (s.high - s.low)
        world.ends(h, lambda: setattr(item, "shown", None))


def _others_move(world: World, side: Side, h: Happening) -> None:
    s = world.controller.manifest.mv[0]
    world.server.items[s.name].value = s.low + h.number * (s.high - s.low)


def _silent(world: World, side: Side, h: Happening) -> None:
    world.server.network.silent_until_s = world.time.now_s + h.lasts_s


def _slow(world: World, side: Side, h: Happening) -> None:
    world.server.network.slow_until_s = world.time.now_s + h.lasts_s


def _down(world: World, side: Side, h: Happening) -> None:
    world.server.network.refused_until_s = world.time.now_s + h.lasts_s
    world.server.start_anew()


def _anew(world: World, side: Side, h: Happening) -> None:
    """The server begins anew, and is slow for a while or not."""
    if h.number < 0.5:
        world.server.network.slow_until_s = world.time.now_s + h.lasts_s
    world.server.start_anew()


def _renumbered(world: World, side: Side, h: Happening) -> None:
    world.server.renumber(OTHER)
    world.ends(h, world.server.renumber)


def _type(world: World, side: Side, h: Happening) -> None:
    if not all(side.alive and side.station.endpoint.connected for side in world.sides):
        return  # a loop that begins meanwhile would take the type for the right one
    item = world.server.items[world.controller.manifest.mv[0].name]
    item.kind = ua.VariantType.Float
    world.ends(h, lambda: setattr(item, "kind", DOUBLE))


def _refuses(world: World, side: Side, h: Happening) -> None:
    world.server.refuses = True
    world.ends(h, lambda: setattr(world.server, "refuses", False))


def _stuck(world: World, side: Side, h: Happening) -> None:
    journal: Any = side.station.journal
    journal.stuck_until_s = world.time.now_s + h.lasts_s
    world.healing.append(lambda: setattr(journal, "stuck_until_s", 0.0))


def _read_only(world: World, side: Side, h: Happening) -> None:
    """The disk takes nothing."""
    journal: Any = side.station.journal
    if not side.alive:
        return
    journal._base.execute("pragma query_only = 1")

    def back() -> None:
        if not journal.dead and side.alive and side.station.journal is journal:
            journal._base.execute("pragma query_only = 0")

    world.ends(h, back)


def _deleted(world: World, side: Side, h: Happening) -> None:
    """Somebody takes the journal away."""
    side.journal.unlink(missing_ok=True)
    if not side.alive:
        side.forget()


def _dies(world: World, side: Side, h: Happening) -> None:
    if side.alive and not side.station.ended and side.station.loop is not None:
        side.die()

        world.ends(h, lambda: _again(world, side))


def _again(world: World, side: Side) -> None:
    """A loop begins; not while a node has another type, which it would take for the right one."""
    if any(item.kind is ua.VariantType.Float for item in world.server.items.values()):
        world.time.later(10 * world.period_s, lambda: _again(world, side))
    elif not side.alive:
        side.begin()


def _restarts(world: World, side: Side, h: Happening) -> None:
    """An orderly end, and a start after a while."""
    if not side.alive or side.station.ended or side.station.loop is None:
        return
    side.station.end()
    world.ends(replace(h, lasts_s=h.lasts_s + 5 * world.period_s), lambda: _again(world, side))


def _clock(world: World, side: Side, h: Happening) -> None:
    """Somebody sets the clocks of the machines."""
    world.time.set_by_s += 7200 * (h.number - 0.5)


HAPPENINGS: dict[str, Callable[[World, Side, Happening], None]] = {
    "mode": _mode,
    "set point": _set_point,
    "by hand": _by_hand,
    "sensor": _sensor,
    "others move": _others_move,
    "silent": _silent,
    "slow": _slow,
    "down": _down,
    "started anew": _anew,
    "renumbered": _renumbered,
    "type": _type,
    "refuses": _refuses,
    "disk stuck": _stuck,
    "disk read-only": _read_only,
    "journal deleted": _deleted,
    "dies": _dies,
    "restarts": _restarts,
    "clock set": _clock,
}
OFTEN = {"mode": 5, "set point": 2, "by hand": 3, "sensor": 3}


# ------------------------------------------------------------------------------------------------------------ histories
def drawn(seed: int, periods: int = PERIODS, happenings: int = HAPPEN) -> tuple[Setting, list[Happening]]:
    """The history of a seed: so many happenings in so many periods."""
    rng = random.Random(seed)
    law = rng.choice(LAWS)
    starts = tuple(rng.choice(("AUTO", "AUTO", "MANUAL", "SHADOW")) for _ in range(rng.choice((1, 1, 2))))
    setting = Setting(seed, law, starts, periods, rng.random() < 0.3, rng.random() < 0.7, rng.random() < 0.3)
    period_s = _controller(law).manifest.period_s
    names, weights = zip(*[(name, OFTEN.get(name, 1)) for name in HAPPENINGS], strict=True)
    found = [
        Happening(
            rng.uniform(2, periods) * period_s, rng.choices(names, weights)[0], rng.randrange(2),
            SHORTEST_S + LONGEST * period_s * rng.random() ** 3, rng.random(),
        )
        for _ in range(happenings)
    ]  # fmt: skip
    return setting, sorted(found, key=lambda h: h.time_s)


def played(setting: Setting, happenings: Sequence[Happening]) -> Told:
    """Play a history to its end, and a quiet time after it in which all must come right."""
    base = Path("/dev/shm") if Path("/dev/shm").is_dir() else None
    folder = Path(tempfile.mkdtemp(prefix="loopwright-world-", dir=base))
    world = World(setting, folder)
    try:
        for side in world.sides:
            side.begin()
        for h in happenings:
            world.time.pass_until(h.time_s)
            world.judge.look()
            world.do(h)
        world.time.pass_until(max(setting.periods * world.period_s, world.time.now_s))
        world.heal()
        world.time.pass_until(world.time.now_s + QUIET * world.period_s + 60.0)
        world.judge.look()
        world.judge.at_rest()
        for side in world.sides:
            side.station.end()
        world.time.pass_until(world.time.now_s + 10 * world.period_s + 60.0)
        world.judge.at_end()
        judge = world.judge
        return Told(tuple(judge.broken), judge.scans, world.time.now_s, judge.wrote, judge.faults, judge.digest())
    finally:
        world.time.close()
        shutil.rmtree(folder, ignore_errors=True)


def played_from(seed: int) -> Told:
    """The history of a seed, in a worker; what ends it by an exception counts as a broken rule."""
    try:
        return played(*drawn(seed))
    except Exception as error:
        return Told((f"0 s: a history comes to its end ({type(error).__name__}: {error})",), 0, 0.0, 0, 0, 0)


def rules(broken: Sequence[str]) -> list[str]:
    """The broken rules, without the times and figures that are told with them."""
    return [line.partition(": ")[2].partition(" (")[0] for line in broken]


def found_in(seed: int, most: int, periods: int = PERIODS, happenings: int = HAPPEN) -> tuple[int, Told]:
    """The first of ``most`` histories from a seed on that breaks a rule, by its seed, or the last one."""
    for k in range(seed, seed + most):
        told = played(*drawn(k, periods, happenings))
        if told.broken:
            break
    return k, told


def shortened(setting: Setting, happenings: Sequence[Happening], rule: str) -> list[Happening]:
    """The history without what the broken rule does not need: halves first, then one by one."""
    kept, size = list(happenings), len(happenings)
    while size >= 1:
        k = 0
        while k < len(kept):
            fewer = kept[:k] + kept[k + size :]
            if rule in rules(played(setting, fewer).broken):
                kept = fewer
            else:
                k += size
        size //= 2
    return kept
