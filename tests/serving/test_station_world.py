"""Stations with connections, journals and leases in a world of its own time: no history breaks a rule."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest
from world.planted_stations import PLANTED_STATIONS
from world.story import Happening, Setting, Told, drawn, found_in, played, rules, shortened
from world.virtual_time import HangsError, VirtualTime

PERIODS, HAPPENINGS = 300, 25  # of a history here; ``python -m tests.world --years`` plays longer ones
SEEDS = range(1000, 1012)
MOST = 8  # histories that a planted bug takes at most
MEANWHILE = "an MV goes out though the one before it was refused meanwhile"  # hardly ever by chance: played on purpose
SHORTEST = 6  # happenings that a planted bug needs at most


def history(seed: int) -> Told:
    return played(*drawn(seed, PERIODS, HAPPENINGS))


@pytest.mark.parametrize("seed", SEEDS)
def test_no_history_breaks_a_rule(seed: int) -> None:
    told = history(seed)
    assert told.broken == ()
    assert told.scans >= PERIODS / 2
    assert told.faults > 0


def test_a_history_is_the_same_when_it_is_played_again() -> None:
    one, other = history(1), history(1)
    assert (one.digest, one.scans, one.wrote) == (other.digest, other.scans, other.wrote)
    assert one.digest != history(4).digest


@pytest.mark.parametrize("bug", [bug for bug in PLANTED_STATIONS if bug != MEANWHILE])
def test_a_planted_bug_of_a_station_is_found(bug: str) -> None:
    with PLANTED_STATIONS[bug]():
        seed, told = found_in(0, MOST, PERIODS, HAPPENINGS)
        assert told.broken
    assert history(seed).broken == ()


def refused_slowly(seed: int) -> Told:
    """A server that refuses MVs and takes seconds to say so: the next scan comes before that."""
    setting = Setting(seed, "jacketed_batch_reactor/fuzzy_feedforward", ("AUTO",), PERIODS, False, True, False)
    return played(setting, [Happening(500.0, "refuses", 0, 2000.0, 0.0), Happening(500.0, "slow", 0, 2000.0, 0.0)])


def test_an_mv_does_not_go_out_where_the_one_before_it_was_refused_meanwhile() -> None:
    with PLANTED_STATIONS[MEANWHILE]():
        found = [refused_slowly(seed).broken for seed in range(3)]
    assert any(found)
    assert [refused_slowly(seed).broken for seed in range(3)] == [()] * 3


def test_a_history_that_breaks_a_rule_is_shortened() -> None:
    with PLANTED_STATIONS["the alarm of a fault has no end"]():
        setting, happenings = drawn(0, PERIODS, HAPPENINGS)
        rule = rules(played(setting, happenings).broken)[0]
        few = shortened(setting, happenings, rule)
        assert len(few) <= SHORTEST
        assert rule in rules(played(setting, few).broken)


# ----------------------------------------------------------------------------------------------------- the world's time
def test_what_is_due_is_called_in_its_order_and_nobody_waits() -> None:
    world, seen = VirtualTime(), list[tuple[float, str]]()

    def slow() -> None:
        for _ in range(3):
            world.wait(3600.0)
            seen.append((world.now_s, "slow"))

    def begin() -> None:
        seen.append((world.now_s, "begin"))
        world.act(lambda: seen.append((world.now_s, "at once")))

    async def task() -> None:
        await asyncio.sleep(5400.0)
        seen.append((world.now_s, "task"))

    world.act(slow)
    world.later(4000.0, begin)
    world.loop.create_task(task())
    world.pass_until(8000.0)
    assert seen == [(3600.0, "slow"), (4000.0, "begin"), (4000.0, "at once"), (5400.0, "task"), (7200.0, "slow")]
    assert world.now_s == 8000.0
    world.close()


def test_an_actor_that_is_left_is_called_no_more() -> None:
    world, seen = VirtualTime(), list[float]()

    def work() -> None:
        while True:
            world.wait(10.0)
            seen.append(world.now_s)

    leave = world.act(work)
    world.pass_until(25.0)
    leave()
    world.pass_until(100.0)
    assert seen == [10.0, 20.0]
    world.close()


def in_a_task(world: VirtualTime, act: Callable[[], object]) -> None:
    async def task() -> None:
        act()

    world.loop.create_task(task()).add_done_callback(world.task_ended)


@pytest.mark.parametrize("begin", [VirtualTime.act, lambda world, act: world.later(1.0, act), in_a_task])
def test_what_an_actor_or_a_task_raises_ends_the_world(begin: Callable[..., object]) -> None:
    world = VirtualTime()

    def fails() -> None:
        raise HangsError("on purpose")

    begin(world, fails)
    with pytest.raises(HangsError):
        world.pass_until(10.0)
    world.close()
