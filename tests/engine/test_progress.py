"""Lines of progress: few, with the share that is done, and the time left once it can be known."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from loopwright.pipeline.engine import progress
from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.engine.progress import LINE_EVERY_S, Lines, WorkPiece, steps, within


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Iterator[Clock]:
    """The time of the lines of this thread; enough has passed for a first one."""
    found = Clock()
    token = progress._lines.set(Lines(found))
    found.now += LINE_EVERY_S
    yield found
    progress._lines.reset(token)


def test_a_piece_says_what_is_done_and_how_long_the_rest_takes(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    piece = WorkPiece("fit a: networks", 40.0, Lines(clock))
    assert capsys.readouterr().err == ""
    for after, done in ((15.0, 4.0), (20.0, 8.0), (30.0, 10.0), (200.0, 38.0)):
        clock.now = 100.0 + after
        piece.show(done, f"{done / 4:.0f} of 10")
    assert capsys.readouterr().err.splitlines() == [
        "fit a: networks: 1 of 10, 10 % done",  # too early for the time left
        "fit a: networks: 2 of 10, 25 % done, about 2 min left",
        "fit a: networks: 10 of 10, 95 % done, about 10 s left",
    ]


@pytest.mark.parametrize(("left", "words"), [(7.0, "5 s"), (33.0, "35 s"), (100.0, "2 min"), (1800.0, "30 min")])
def test_the_time_left_has_no_more_digits_than_an_estimate(left: float, words: str) -> None:
    assert progress._rounded(left) == words


def test_the_steps_of_a_single_item_are_shown_under_its_label(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    def item(_: int) -> None:
        show = steps("tuning", 4)
        for done in (1, 2):
            clock.now += LINE_EVERY_S
            show(done)

    steps("of nobody", 1)(1)
    parallel_map(item, [0], "design a: controllers")
    assert capsys.readouterr().err.splitlines() == [
        *("design a: tuning", "design a: tuning: 25 % done, about 30 s left"),
        "design a: tuning: 50 % done, about 20 s left",
    ]
    with within(""):
        item(0)
    assert capsys.readouterr().err == ""


def test_several_items_are_counted_by_their_weights(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    def item(value: float) -> float:
        clock.now += LINE_EVERY_S
        return math.sqrt(value)

    assert parallel_map(item, [4.0, 9.0], "roots", [1.0, 3.0]) == [2.0, 3.0]
    assert capsys.readouterr().err.splitlines() == [
        *("roots", "roots: 1 of 2, 25 % done, about 30 s left", "roots: 2 of 2, 100 % done"),
    ]
