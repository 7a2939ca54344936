"""What counts as a wish of the plant's own operator."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from loopwright.serving.station.requests import NodeRequests


def values(
    sp: dict[str, float] | None = None, mode: str = "", starts: int = 0, operate: dict[str, float] | None = None
) -> Any:
    return SimpleNamespace(asked_sp=sp or {}, asked_mode=mode, starts=starts, asked_operate=operate or {})


def test_a_value_that_changes_is_a_wish() -> None:
    asked = NodeRequests()
    assert asked.of(values({"T": 1.0, "p": 2.0}, "AUTO")) == ({"T": 1.0, "p": 2.0}, "", {})  # no mode of before
    assert asked.of(values({"T": 1.0, "p": 2.0}, "AUTO")) == ({}, "", {})
    assert asked.of(values({"T": 1.5, "p": 2.0}, "MANUAL")) == ({"T": 1.5}, "MANUAL", {})
    assert asked.of(values({"p": 2.0})) == ({}, "", {})  # of bad quality, or a number of no mode
    assert asked.of(values({"T": 1.5, "p": 2.0}, "MANUAL")) == ({}, "", {})


def test_defaults_of_a_server_that_started_anew_are_none() -> None:
    asked = NodeRequests()
    asked.of(values({"T": 1.0, "p": 2.0}, "AUTO"))
    assert asked.of(values({"T": 0.0}, "SHADOW", 1)) == ({}, "", {})
    assert asked.of(values({"T": 0.0, "p": 0.0}, "SHADOW", 1)) == ({}, "", {})  # p was not told at first
    assert asked.of(values({"T": 1.0, "p": 0.0}, "AUTO", 1)) == ({"T": 1.0}, "AUTO", {})
    assert asked.of(values({"T": 0.0, "p": 0.0}, "AUTO", 2)) == ({}, "", {})


def test_a_value_that_an_outage_hid_is_a_wish() -> None:
    asked = NodeRequests()
    asked.of(values({"T": 1.0}, "AUTO"))
    assert asked.of(values({"T": 3.0}, "MANUAL")) == ({"T": 3.0}, "MANUAL", {})


def test_what_stands_in_the_nodes_of_operate_is_a_wish_at_first_and_when_it_changes() -> None:
    asked = NodeRequests()
    assert asked.of(values(operate={"T.low": 1.0, "T.use": 1.0})).operate == {"T.low": 1.0, "T.use": 1.0}
    assert asked.of(values(operate={"T.low": 1.0, "T.use": 0.0})).operate == {"T.use": 0.0}
    assert asked.of(values(operate={"T.low": 0.0, "T.use": 0.0}, starts=1)).operate == {}
    assert asked.of(values(operate={"T.low": 2.0, "T.use": 0.0}, starts=1)).operate == {"T.low": 2.0}
    assert asked.of(values(operate={"T.low": 0.0, "T.use": 1.0}, starts=2)).operate == {"T.use": 1.0}  # a contact
