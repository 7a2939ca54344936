"""The table that a run ends with, and what is said below it."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from loopwright.pipeline.evaluation.leaderboard import CaseStanding
from loopwright.pipeline.report.results import REMARK_RATIO, show_results

ARTIFACTS = Path(__file__).parents[2] / "artifacts"


def test_a_ratio_below_the_bound_has_a_remark_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fresh user saw .64 of what no controller is expected to beat, without a word."""
    said = {}
    for ahead in (REMARK_RATIO, 0.0, 1e9):
        monkeypatch.setattr("loopwright.pipeline.report.results.REMARK_RATIO", ahead)
        show_results(ARTIFACTS, Console(file=(terminal := io.StringIO()), width=200))
        said[ahead] = "below 1" in terminal.getvalue()
    standings = [CaseStanding.read(path.parent) for path in ARTIFACTS.glob("*/validation.json")]
    ratios = [law.ratio for of in standings for law in of.laws if of.times == "× NMPC"]
    assert said == {REMARK_RATIO: min(r for r in ratios if r is not None) < REMARK_RATIO, 0.0: False, 1e9: True}
