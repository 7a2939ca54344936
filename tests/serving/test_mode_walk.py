"""Modes, hold, hand and transfer of a loop: no sequence of acts breaks a rule, and each planted bug breaks one."""

from __future__ import annotations

import random

import pytest
from world.acts import ACTS, World
from world.planted import PLANTED
from world.rules import Known
from world.walk import broken_by, drawn, shortened, starts, walked, wandered

HISTORIES = 1_500  # random ones, of twelve periods; ``python -m tests.world`` plays any number
SHORTEST = 7  # acts that a planted bug needs at most


def test_every_act_from_every_start_keeps_the_rules() -> None:
    walk = walked(1, starts())
    assert walk.periods == len(ACTS) * len(starts())
    assert walk.broken == {}


def test_two_acts_in_a_row_keep_the_rules() -> None:
    walk = walked(2, starts(), [act for act in ACTS if not act.moved and not act.lost])
    assert walk.states > 300
    assert walk.broken == {}


@pytest.mark.parametrize("seed", [0, 1])
def test_random_histories_keep_the_rules(seed: int) -> None:
    rule, path, ran = wandered(seed, HISTORIES)
    assert rule == "", path
    assert ran == 12 * HISTORIES


@pytest.mark.parametrize("bug", PLANTED)
def test_a_planted_bug_is_found_and_its_history_is_short(bug: str) -> None:
    with PLANTED[bug]():
        rule, path, _ = wandered(0, 20 * HISTORIES)
        assert rule
        start, *acts = path
        assert len(acts) <= SHORTEST
        assert broken_by(starts()[str(start)], acts) == (rule, len(acts) - 1)  # type: ignore[arg-type]
    assert broken_by(starts()[str(start)], acts) == ("", -1)  # type: ignore[arg-type]


def test_a_history_is_shortened_to_the_acts_that_break_the_rule() -> None:
    rng = random.Random(4)
    with PLANTED["a lost write is not noted"]():
        start = starts()["AUTO, MV known"]
        acts, rule = next(
            (acts[: last + 1], rule)
            for acts in ([drawn(rng) for _ in range(12)] for _ in range(500))
            for rule, last in [broken_by(start, acts)]
            if last > 4
        )
        short = shortened(start, acts, rule)
        assert len(short) < len(acts)
        assert broken_by(start, short)[0] == rule
        for k in range(len(short)):
            assert broken_by(start, short[:k] + short[k + 1 :])[0] != rule


@pytest.mark.parametrize("start", starts())
def test_a_loop_that_was_put_away_goes_on_as_one_that_was_not(start: str) -> None:
    """What the walk takes for equal is equal: else it would leave out histories."""
    rng = random.Random(7)
    for _ in range(40):
        kept, known = World.thawed(starts()[start].frozen()), Known()
        for act in (drawn(rng) for _ in range(15)):
            again = World.thawed(kept.frozen())
            one, other = kept.do(act), again.do(act)
            assert (one.written, one.mode, one.accepted, bool(one.fault)) == (
                other.written,
                other.mode,
                other.accepted,
                bool(other.fault),
            )
            assert known.after(one)[0] == known.after(other)[0]
