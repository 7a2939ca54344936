"""The scans of a kit show a host that forgets to begin cold, whatever the law."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from kits import name
from shipped_files import SHIPPED

from loopwright.serving import Controller
from loopwright.serving.conformance.scans import scanned
from loopwright.serving.in_charge.active_controller import ActiveController

# The first law of each case, and all of one whose MV lies at its ends over scans at random.
FIRST = [next(files) for _, files in itertools.groupby(SHIPPED, key=lambda f: f.parent.name)]
AT_ITS_ENDS = [f for f in SHIPPED if f.parent.name == "thiosulfate_cstr"]


@pytest.mark.parametrize("file", sorted({*FIRST, *AT_ITS_ENDS}), ids=name)
def test_a_cold_start_that_is_forgotten_shows(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    controller = Controller(file)
    right = [done.command.mv for done in scanned(controller)]
    monkeypatch.setattr(ActiveController, "begin_cold", lambda self, reason: None)
    wrong = [done.command.mv for done in scanned(controller)]
    span = np.array([s.high - s.low for s in controller.manifest.mv])
    differ = sum(bool(np.any(np.abs(a - b) > 1e-6 * span)) for a, b in zip(right, wrong, strict=True))
    assert (differ > 0) == bool(controller.manifest.n_state)
