"""What several people ask of a loop within one period."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from loopwright.serving import Controller, ControlLoop, LoopError, Mode
from loopwright.serving.controller_file import manifest_in
from loopwright.serving.station.requests import Change, Request, change
from loopwright.serving.trust import Proof, judged

FILE = Path(__file__).parents[2] / "artifacts" / "jacketed_batch_reactor" / "fuzzy_feedforward_observer.onnx"


def asked(loop: ControlLoop, do: str, value: Any, who: str) -> Change:
    return change(Request.read({"do": do, "value": value, "who": who}), loop, lambda file, sha256: Controller(FILE))


@pytest.fixture
def loop() -> ControlLoop:
    """Two MVs by hand, each at the first of its values or at its lower end."""
    m = Controller(FILE).manifest
    mv = [s.low if s.values is None else s.values[0] for s in m.mv]
    return ControlLoop(Controller(FILE), sp=[s.middle for s in m.sp], mv=mv, mode=Mode.MANUAL)


def test_two_changes_of_one_period_both_stand(loop: ControlLoop) -> None:
    first, second = loop.manifest.mv
    high = [s.high if s.values is None else s.values[-1] for s in (first, second)]
    changes = [asked(loop, "mv", {first.name: high[0]}, "anna"), asked(loop, "mv", {second.name: high[1]}, "bert")]
    for one in changes:
        one.act(loop)
    assert loop.mv.tolist() == high
    assert first.name in changes[0].what
    assert second.name not in changes[0].what


def test_a_change_is_judged_when_it_is_asked_for_and_when_it_is_carried_out(loop: ControlLoop) -> None:
    name = loop.manifest.mv[0].name
    with pytest.raises(LoopError, match=name):
        asked(loop, "mv", {name: 1e9}, "anna")
    late = asked(loop, "mv", {name: loop.manifest.mv[0].low}, "anna")
    loop.set_mode(Mode.SHADOW)
    with pytest.raises(LoopError, match="in MANUAL only"):
        late.act(loop)


GOOD = {"lock_ups": 0, "scenarios": {"up": {"mae": 1.0}}}
MISSES = {**GOOD, "on": {"words": "on models", "unproven": ["not proven: the model misses most of what y does"]}}


@pytest.mark.parametrize(
    ("evidence", "proof"),
    [
        (GOOD, Proof.PROVEN),
        ({"scenarios": {"up": {"mae": 1.0}}}, Proof.NONE),  # nobody counted
        ({"lock_ups": 0, "scenarios": {"up": {}}}, Proof.NONE),
        ({"lock_ups": 0, "scenarios": {"up": {"mae": None, "ok": True, "ise": "1"}, "down": 1.0}}, Proof.NONE),
        ({"lock_ups": 0, "scenarios": {"up": {"mae": float("inf")}}}, Proof.NONE),
        ({"lock_ups": 0, "scenarios": {"up": {}, "down": {"mae": 0}}}, Proof.PROVEN),
        ({"lock_ups": 1, "scenarios": {"up": {"mae": None}}}, Proof.LOCKED_UP),
        ({**GOOD, "on": {"words": "on models", "fit": {"y": 80.0}}}, Proof.PROVEN),
        ({}, Proof.NONE),
        ({"lock_ups": 0, "scenarios": {}}, Proof.NONE),
        ({**GOOD, "lock_ups": "0"}, Proof.NONE),
        ({**GOOD, "lock_ups": True}, Proof.NONE),
        ({**GOOD, "lock_ups": -1}, Proof.NONE),
        ({**GOOD, "lock_ups": 2, "as_printed": True}, Proof.LOCKED_UP),
        (MISSES, Proof.MODEL),
    ],
)
def test_the_verdict_on_what_a_file_says_of_itself(evidence: dict[str, Any], proof: Proof) -> None:
    verdict = judged(replace(Controller(FILE).manifest, evidence=evidence))
    assert verdict.proof is proof
    assert bool(verdict.words) == (proof is not Proof.PROVEN)


def test_what_is_shipped_is_proven_but_for_the_law_that_locks_up_as_printed() -> None:
    files = sorted(FILE.parents[1].glob("*/*.onnx"))
    verdicts = {file.stem: judged(manifest_in(file.read_bytes())).proof for file in files}
    assert {name: proof for name, proof in verdicts.items() if proof is not Proof.PROVEN} == {
        "incadec": Proof.LOCKED_UP
    }


def to_auto(accept: bool) -> dict[str, Any]:
    return {"do": "mode", "value": "AUTO", "who": "anna", "accept_unproven": accept}


def swapped(accept: bool) -> dict[str, Any]:
    return {"do": "swap", "value": {"file": "new.onnx"}, "who": "anna", "accept_unproven": accept}


@pytest.fixture
def unproven() -> Controller:
    """A file as its `design` left it, but for its digest."""
    made = Controller(FILE)
    made.manifest, made.sha256 = replace(made.manifest, evidence={}), "0" * 64
    return made


@pytest.mark.parametrize(
    ("in_charge", "on_trial", "mode", "wanted", "asks"),
    [
        (False, False, Mode.MANUAL, to_auto, False),
        (True, False, Mode.MANUAL, to_auto, True),
        (False, True, Mode.MANUAL, to_auto, True),  # it would take over in AUTO
        (False, False, Mode.AUTO, swapped, True),
        (False, False, Mode.HOLD, swapped, True),  # which leads back to AUTO
        (False, False, Mode.MANUAL, swapped, False),
        (False, False, Mode.SHADOW, swapped, False),
    ],
)
def test_auto_with_a_controller_that_is_not_proven_needs_a_word(
    loop: ControlLoop,
    unproven: Controller,
    in_charge: bool,
    on_trial: bool,
    mode: Mode,
    wanted: Callable[[bool], dict[str, Any]],
    asks: bool,
) -> None:
    if in_charge:
        m = loop.manifest
        mv = [s.low if s.values is None else s.values[0] for s in m.mv]
        loop = ControlLoop(unproven, sp=[s.middle for s in m.sp], mv=mv, mode=Mode.MANUAL)
    if on_trial:
        loop.swap(unproven, 10)
    loop.set_mode(mode)

    def made(accept: bool) -> Change:
        return change(Request.read(wanted(accept)), loop, lambda file, sha256: unproven)

    if asks:
        with pytest.raises(LoopError, match="accept_unproven"):
            made(False)
        accepted = made(True)
        assert "not proven" in accepted.reason  # the journal keeps it
        accepted.act(loop)
        return
    asked_before = made(False)
    assert asked_before.reason == ""
    if wanted is swapped:  # AUTO came between the question and the scan
        loop.set_mode(Mode.AUTO)
        with pytest.raises(LoopError, match="accept_unproven"):
            asked_before.act(loop)
