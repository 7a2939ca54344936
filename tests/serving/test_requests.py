"""What several people ask of a loop within one period."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from serving import Controller, ControlLoop, LoopError, Mode
from serving.station.requests import Change, Request, change

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
