"""The page's table of modes says what a loop does; the walk of ``tests/world`` says that it is right."""

from __future__ import annotations

import pytest
from manual.modes import FAULT, HAPPENS, STATES, after

WITHOUT_A_REQUEST = [what for what in HAPPENS if not what.startswith("asked")]


@pytest.mark.parametrize("state", STATES)
def test_a_request_leads_from_any_mode_to_any(state: str) -> None:
    for what in HAPPENS:
        if what.startswith("asked for "):
            assert after(state, what) == what.removeprefix("asked for ")


def test_nothing_but_a_fault_and_its_end_changes_a_mode_without_a_request() -> None:
    found = {(state, now) for what in WITHOUT_A_REQUEST for state in STATES if (now := after(state, what)) != state}
    assert found == {("AUTO", FAULT), (FAULT, "AUTO"), (FAULT, "SHADOW"), ("AUTO", "SHADOW")}
