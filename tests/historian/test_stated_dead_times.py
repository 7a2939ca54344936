"""A stated dead time beside the record: true ones are not objected to, wrong ones are where the record is clear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from closed_loop_records import MIDDLE, SIGNALS, OperatedLoop

from loopwright.pipeline.config.known import stated
from loopwright.pipeline.historian.stated_answers import Beside, DeadTimeBounds, beside_record, dead_times_left
from loopwright.pipeline.records.record import Record

DEAD = 12  # rows of 1 s
LOOP = OperatedLoop(gain=2.0, lags=(8.0, 3.0), dead=DEAD, kc=0.15, ti=12.0, hold=60, load=1.0)
WANDERING = replace(LOOP, load=4.0)
NOISE = 2.0  # degC: 10 % of what the MV moves the PV


def by_hand(seed: int, lags: tuple[float, ...] = LOOP.lags, load: float = 0.0, noise: float = NOISE) -> Record:
    """A record of 2,000 rows in which an operator moves the MV at random, ``load`` [%] wandering at the MV."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-20, 20, 100), 20)
    wander = np.zeros(len(u))
    for k in range(1, len(u)):
        wander[k] = 0.99 * wander[k - 1] + 0.14 * rng.normal()
    y = replace(LOOP, lags=lags).answer(u + load * wander)
    return Record.of(SIGNALS, (MIDDLE + y + noise * rng.normal(size=len(u)))[:, None], (MIDDLE + u)[:, None])


def beside(record: Record, words: str) -> Beside:
    (found,) = beside_record([stated("y", "u", words)], record)
    return found


RECORDS = {
    "by hand": lambda seed: by_hand(seed),
    "by hand, loads": lambda seed: by_hand(seed, load=4.0),
    "by hand, three lags": lambda seed: by_hand(seed, lags=(10.0, 10.0, 10.0)),
    "by hand, a slow lag": lambda seed: by_hand(seed, lags=(60.0,)),
    "closed loop": lambda seed: LOOP.record(2_400, seed),
    "closed loop, clear": lambda seed: replace(LOOP, load=0.3).record(2_400, seed),
    "closed loop, loads": lambda seed: WANDERING.record(2_400, seed),
    "closed loop, noise": lambda seed: replace(LOOP, noise=0.8).record(2_400, seed),
}


@pytest.mark.parametrize("name", RECORDS)
@pytest.mark.parametrize("words", ["dead 12..12", "dead 10..15"])
def test_a_true_dead_time_is_not_objected_to(name: str, words: str) -> None:
    for seed in range(4):
        found = beside(RECORDS[name](seed), words)
        assert found.dead is not None
        assert found.dead.least <= DEAD + 1
        assert found.dead.most is None or found.dead.most >= DEAD - 1
        assert not found.dead_objects
        assert found.questions == []


@pytest.mark.parametrize("name", ["by hand", "by hand, loads", "closed loop, clear"])
@pytest.mark.parametrize("words", ["dead 30..36", "gain 1..3, dead 40..60"])
def test_an_answer_before_the_least_is_a_question(name: str, words: str) -> None:
    for seed in range(3):
        found = beside(RECORDS[name](seed), words)
        assert found.dead is not None
        assert found.dead.most is not None
        assert found.dead_s[1] == found.dead.most + 1
        assert (found.objection, found.dead_objects) == (None, True)
        assert found.questions == [found.dead_question]


@pytest.mark.parametrize("words", ["dead 0..2", "+, dead 1..3"])
def test_no_answer_up_to_the_most_is_a_question(words: str) -> None:
    for seed in range(3):
        found = beside(by_hand(seed, noise=0.2), words)
        assert found.dead is not None
        assert found.dead.least > 4
        assert (found.objection, found.dead_objects) == (None, True)


def test_a_slow_start_of_three_lags_is_no_dead_time() -> None:
    for seed in range(3):
        record = by_hand(seed, lags=(10.0, 10.0, 10.0), noise=0.2)
        assert not beside(record, "dead 10..12").dead_objects


@pytest.mark.parametrize(("lags", "words"), [((4.0,) * 4, "dead 17..20"), ((20.0, 3.0, 3.0), "dead 15..17")])
def test_a_dead_time_off_a_step_test_holds_some_of_the_lags(lags: tuple[float, ...], words: str) -> None:
    for seed in range(3):
        assert not beside(by_hand(seed, lags=lags, noise=0.2), words).dead_objects


def test_the_part_of_a_statement_that_nothing_contradicts_stays() -> None:
    record = by_hand(0)
    late, turned = beside(record, "+, gain 1..3, dead 60..80"), beside(record, "-, dead 10..14")
    assert late.unopposed == stated("y", "u", "+, gain 1..3")
    assert turned.unopposed == stated("y", "u", "dead 10..14")
    assert beside(record, "-, dead 60..80").unopposed is None
    assert beside(record, "+, dead 10..14").unopposed == stated("y", "u", "+, dead 10..14")


def test_the_record_agrees_where_it_leaves_nothing_else() -> None:
    found = beside(by_hand(0, noise=0.2), "dead 8..16")
    assert found.dead_agrees
    assert not beside(WANDERING.record(2_400, 0), "dead 8..16").dead_agrees


def test_a_pv_that_stands_still_or_few_rows_say_nothing() -> None:
    record = by_hand(0)
    assert dead_times_left(np.ones(2_000), record.mv, record.run, 0, (3, 4)) == DeadTimeBounds()
    assert dead_times_left(record.pv[:150, 0], record.mv[:150], record.run[:150], 0, (3, 4)) is None
    assert dead_times_left(record.pv[:, 0], record.mv, record.run, 0, (300, 400)) is None
    assert not Beside(stated("y", "u", "dead 3..4")).dead_objects


@pytest.mark.parametrize(
    ("bounds", "objects", "within"),
    [
        (DeadTimeBounds(), False, False),
        (DeadTimeBounds(5, 8), False, True),
        (DeadTimeBounds(4, 9), False, True),  # a period more or less
        (DeadTimeBounds(0, 12), False, False),
        (DeadTimeBounds(9, None), False, False),
        (DeadTimeBounds(10, None), True, False),
        (DeadTimeBounds(0, 4), False, False),
        (DeadTimeBounds(0, 3), True, False),
        (DeadTimeBounds(0, 3, slow=1), False, False),
        (DeadTimeBounds(0, 2, slow=1), True, False),
    ],
)
def test_bounds_beside_what_is_said(bounds: DeadTimeBounds, objects: bool, within: bool) -> None:
    assert (bounds.object_to(5, 8), bounds.within(5, 8)) == (objects, within)
