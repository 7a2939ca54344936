"""Changes in operators' words: each signal once, nothing that did not change, no name of a program."""

from __future__ import annotations

import pytest

from loopwright.serving.manifest import OperateEntry, Signal, What
from loopwright.serving.operating import unit_words
from loopwright.serving.station.change_words import by_hand_words, operate_words


def entry(group: str, signal: str, what: What, unit: str = "") -> OperateEntry:
    return OperateEntry(group, signal, what, unit, 0.0, -1e6, 1e6)  # type: ignore[arg-type]


CV = [entry("cv", "LIC-2", w, "%" if w in ("low", "high") else "") for w in ("use", "track", "low", "high", "rank")]
MV = [entry("mv", "FV-3", w) for w in ("use", "rest_use")]
MV += [entry("mv", "FV-3", w, "%") for w in ("max_move", "rest")]
ENTRIES = [*CV, *MV, entry("mv", "FV-3", "cost", "1/%"), entry("law", "", "speed")]
BEFORE = {e.name: 0.0 for e in ENTRIES} | {"LIC-2.use": 1.0, "LIC-2.track": 1.0, "FV-3.use": 1.0, "speed": 1.0}


def words(**wanted: float) -> str:
    named = {name.replace("LIC2_", "LIC-2.").replace("FV3_", "FV-3."): value for name, value in wanted.items()}
    return operate_words(ENTRIES, BEFORE, named, 10.0)


def test_a_signal_that_is_taken_out_and_back_has_a_word_each() -> None:
    out, back = words(LIC2_use=0), operate_words(ENTRIES, {**BEFORE, "LIC-2.use": 0.0}, {"LIC-2.use": 1.0}, 10.0)
    assert out == "LIC-2 taken out"
    assert back.startswith("LIC-2 ")
    assert out != back


def test_a_signal_is_named_once_and_only_with_what_changes() -> None:
    said = words(LIC2_track=0, LIC2_low=20, LIC2_high=0, LIC2_rank=0, FV3_max_move=4)
    assert said.count("LIC-2") == said.count("FV-3") == 1
    assert "0 -> 20 %" in said
    assert "high" not in said
    assert "priority" not in said
    assert "LIC-2." not in said


@pytest.mark.parametrize(("wanted", "kept", "left"), [((1, 55), "55", "with"), ((0, 55), "without", "55")])
def test_a_resting_value_is_told_once(wanted: tuple[float, float], kept: str, left: str) -> None:
    before = {**BEFORE, "FV-3.rest_use": 1.0 - wanted[0]}
    said = operate_words(ENTRIES, before, {"FV-3.rest_use": wanted[0], "FV-3.rest": wanted[1]}, 10.0)
    assert kept in said
    assert left not in said


def test_what_stands_already_and_what_no_law_has_are_told_as_such() -> None:
    assert "->" not in words(LIC2_low=0)
    assert "LIC-2" in words(LIC2_low=0)
    assert "what.ever 3" in operate_words(ENTRIES, BEFORE, {"what.ever": 3.0}, 10.0)


def test_a_cost_and_a_largest_move_say_of_which_time_they_are() -> None:
    for what, unit in (("cost", "1/%"), ("max_move", "%")):
        said = unit_words(entry("mv", "FV-3", what, unit), 10.0)  # type: ignore[arg-type]
        assert "%" in said
        assert "10 s" in said
        assert "1/" not in said
    assert "10 s" in words(FV3_cost=2)


def test_an_mv_by_hand_is_named_once() -> None:
    valve = Signal("FV-2", "%", 0.0, 100.0)
    taken, again, there = (
        by_hand_words([33.0], [to], [valve], out) for to, out in ((30.0, ["FV-2"]), (30.0, []), (33.0, ["FV-2"]))
    )
    assert [line.count("FV-2") for line in (taken, again, there)] == [1, 1, 1]
    assert ["taken out" in line for line in (taken, again, there)] == [True, False, True]
    assert ["33 -> 30 %" in line for line in (taken, again, there)] == [True, True, False]
