"""Lines of a loop reach whoever reads them, and stop nobody where they cannot."""

from __future__ import annotations

import threading

from processes import within

from loopwright.serving.station.housekeeping import WAITING_LINES, LinePrinter


def test_lines_come_in_their_order_and_an_end_waits_for_them() -> None:
    told: list[str] = []
    printer = LinePrinter(told.append)
    for k in range(100):
        printer.say(str(k))
    printer.end()
    printer.say("after the end")
    assert told == [*map(str, range(100)), "after the end"]


def test_a_reader_that_raises_stops_nothing() -> None:
    """A disk that is full under a log, a pipe whose reader is gone."""
    told: list[str] = []

    def tell(line: str) -> None:
        if line == "bad":
            raise OSError(28, "No space left on device")
        told.append(line)

    printer = LinePrinter(tell)
    for line in ("one", "bad", "two"):
        printer.say(line)
    printer.end()
    printer.say("bad")
    assert told == ["one", "two"]


def test_a_reader_that_stands_still_holds_nobody_up_and_is_told_what_it_missed() -> None:
    """A terminal that was halted: lines beyond those that wait are dropped, and counted."""
    told: list[str] = []
    began, go_on = threading.Event(), threading.Event()

    def tell(line: str) -> None:
        began.set()
        go_on.wait(30)
        told.append(line)

    printer = LinePrinter(tell)
    printer.say("first")
    assert began.wait(10)
    for k in range(WAITING_LINES + 7):
        printer.say(str(k))
    go_on.set()
    assert within(10, lambda: len(told) == WAITING_LINES + 2)
    printer.end()
    assert told[:2] == ["first", "0"]
    assert told[-2:] == [str(WAITING_LINES - 1), "7 more lines were not said here: nobody read them in time"]


def test_what_was_never_used_has_no_thread() -> None:
    before = threading.active_count()
    printer = LinePrinter(print)
    printer.end()
    assert threading.active_count() == before
