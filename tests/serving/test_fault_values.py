"""Which faults are the same one: by what is wrong and with what, and never by the words that say it."""

from __future__ import annotations

import copy
import pickle
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from loopwright.serving import Controller, ControlLoop, EndpointError, Fresh, InRange, Mode, Rate, Sample, Signal
from loopwright.serving.guard import Fault, kind_of, lasting, reworded, told_by
from loopwright.serving.journal import Journal
from loopwright.serving.station.recorder import Recorder

pytest_plugins = ["small_laws"]
TAGS = tuple(Signal(name, "K", 0.0, 100.0) for name in ("TIC-101", "TIC 102", "3"))


def sample(*pv: float, **more: Any) -> Sample:
    return Sample(np.array(pv), **more)


def test_a_fault_of_another_signal_is_another_one_though_only_a_number_differs() -> None:
    guard, rate = InRange(TAGS), Rate(TAGS, (1.0, 1.0, 1.0))
    high = [guard.check(sample(*(200.0 * (i == k) for i in range(3))), ()) or "" for k in range(3)]
    fast = [rate.check(sample(*(9.0 * (i == k) for i in range(3))), [sample(0.0, 0.0, 0.0)]) or "" for k in range(3)]
    assert len({kind_of(f) for f in (*high, *fast)}) == 6
    assert kind_of(guard.check(sample(300.0, 0.0, 0.0), ()) or "") == kind_of(high[0])
    assert kind_of("PV T-1: BadSensorFailure") != kind_of("PV T-2: BadSensorFailure")  # a plant of a user's own
    assert kind_of("PV T = 400.1 is high") == kind_of("PV T = -3.5e-07 is high")


def test_a_fault_is_its_words_and_stays_the_same_in_others() -> None:
    late = Fresh(0.5).check(sample(1.0, age_s=2.0, late="PV T"), ()) or ""
    assert (late, lasting(late)) == (
        "the sample of PV T is 2 s old; allowed are 0.5 s",
        "the sample of PV T is older than 0.5 s",
    )
    fault = Fault("MV u, written: its unit is m now", "unit", "MV u, written")
    for copied in (copy.deepcopy(fault), pickle.loads(pickle.dumps(fault))):  # as a command is, in a host of others
        assert (copied, kind_of(copied)) == (fault, kind_of(fault))
    said = told_by(EndpointError(fault), f"the plant cannot be written: {fault}")
    assert (kind_of(said), said) == (kind_of(fault), f"the plant cannot be written: {fault}")
    assert (lasting("a text"), reworded("a text", "other words")) == ("a text", "other words")
    assert told_by(OSError(5, "I/O"), "it fails") == told_by(EndpointError(), "it fails") == "it fails"


@dataclass(frozen=True)
class Odd:
    """A guard of a user's own: its reason is no text."""

    memory: int = 0

    def check(self, _: Sample, __: object) -> Any:
        return 17


def test_the_reason_of_a_command_is_a_text_as_ever(controller: Controller) -> None:
    m = controller.manifest
    loop = ControlLoop(controller, sp=[s.middle for s in m.sp], mv=[s.middle for s in m.mv], guards=[Odd()])
    assert loop.scan(sample(*(s.middle for s in m.pv))).fault == "17"
    loop = ControlLoop(controller, sp=[s.middle for s in m.sp], mv=[s.middle for s in m.mv])
    assert loop.scan(sample(*(s.middle for s in m.pv), fault="my own words")).fault == "my own words"
    reason = loop.scan(sample(*(1e6 for _ in m.pv), dv=np.array([s.middle for s in m.dv]))).fault
    assert isinstance(reason, Fault)
    assert (reason.kind, reason.subject) == ("range", f"PV {m.pv[0].name}")


@pytest.mark.parametrize(
    "make", [lambda tag: Fault(f"PV {tag}: Bad", "quality", f"PV {tag}"), lambda tag: f"PV {tag}: Bad"]
)
def test_a_fault_that_passes_from_one_signal_to_another_is_told(make: Any, tmp_path: Path) -> None:
    journal, said = Journal(tmp_path / "loop.journal"), list[str]()
    recorder = Recorder(journal, said.append)
    signals = SimpleNamespace(sp=(), pv=(), mv=(), dv=(), info=())
    controller: Any = SimpleNamespace(manifest=signals)
    recorder._controller = controller
    loop: Any = SimpleNamespace(controller=controller, successor=None, courses=SimpleNamespace(finished=()))
    for reason in (make("TIC-101"), make("TIC-101"), make("TIC-102"), ""):
        command: Any = SimpleNamespace(
            sp=(),
            mv=(),
            writes=False,
            law_mv=None,
            successor_mv=None,
            info=None,
            fault=reason,
            mode=Mode.HOLD,
            local={},
        )
        recorder.scan(loop, None, command)
    journal.close()
    assert said == ["loop: PV TIC-101: Bad", "loop: PV TIC-102: Bad", "loop: over: PV TIC-102: Bad"]


def test_no_words_change_the_mode(tmp_path: Path) -> None:
    journal, said = Journal(tmp_path / "loop.journal"), list[str]()
    recorder = Recorder(journal, said.append)
    recorder.note("change", "anna", "mode AUTO", mode=Mode.AUTO)
    recorder.note("change", "anna", "mode of the pump: SHADOW")
    command: Any = SimpleNamespace(mode=Mode.HOLD, fault="a fault")
    recorder._changed(command)
    journal.close()
    assert said[-1] == "loop: mode AUTO -> HOLD (a fault)"
