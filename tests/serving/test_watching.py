"""The loop looks at its monitor's verdicts by scans: a clock that is set must not stop it from looking."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from serving import Command, Controller, Mode
from serving.monitor import Verdict
from serving.station.recorder import Recorder
from serving.station.watching import Watching

FILE = Path(__file__).parents[2] / "artifacts" / "ph_neutralization" / "pid.onnx"


@pytest.mark.parametrize("set_by_s", [0.0, -3_600.0, 86_400.0])
def test_an_alarm_is_written_down_within_one_look_whatever_the_clock_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, set_by_s: float
) -> None:
    notes, kept = list[str](), list[str]()
    journal = SimpleNamespace(path=tmp_path / "none.journal", keep=lambda name, text: kept.append(name))
    recorder = SimpleNamespace(journal=journal, note=lambda *words, **_: notes.append(words[2]))
    controller = Controller(FILE)
    m = controller.manifest
    watching = Watching(controller, cast(Recorder, recorder))

    def scan(k: int, time_s: float) -> None:
        mv, sp = np.array([s.middle for s in m.mv]), np.array([s.middle for s in m.sp])
        command = Command(k, Mode.HOLD, sp, mv, None, None, reason="lost")
        watching.seen(controller, (None, command, time_s))

    scan(0, 1e9)
    verdicts = [Verdict("HOLD", "watch", "the loop holds")]
    monkeypatch.setattr(type(watching.monitor), "verdicts", lambda self: verdicts)
    scan(1, 1e9 + set_by_s + m.period_s)
    assert notes == ["HOLD: watch: the loop holds"]
    for k in range(2, 11):
        scan(k, 1e9 + set_by_s + k * m.period_s)
    assert len(notes) == 1
    assert kept
