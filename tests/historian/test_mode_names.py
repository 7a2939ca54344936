"""Names of modes: who moves the MV."""

from __future__ import annotations

import pytest

from loopwright.pipeline.historian.cleaning.tags import automatic, by_hand


@pytest.mark.parametrize(
    "mode", ["A", "AUTO", "aut", "Automatik", "Automático", "CAS", "RCAS", "BCAS", "Kaskade", "2-AUTO", "Local Auto",
             "AUTO.CAS", " auto "],
)  # fmt: skip
def test_a_controller_is_at_work(mode: str) -> None:
    assert automatic(mode)
    assert not by_hand(mode)


@pytest.mark.parametrize("mode", ["M", "MAN", "IMAN", "Manual", "MANU", "Hand", "H", "1:MAN", "Local.Man"])
def test_a_person_moves_the_mv(mode: str) -> None:
    assert by_hand(mode)
    assert not automatic(mode)


@pytest.mark.parametrize(
    "mode", ["OOS", "TRACK", "ROUT", "0", "", "Start", "Halt", "Open", "Closed", "Not in auto", "Manual off"]
)
def test_other_names_say_neither(mode: str) -> None:
    assert not automatic(mode)
    assert not by_hand(mode)
