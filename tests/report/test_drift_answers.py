"""The screening's alarm that a variable drifts ends in an answer of the fitted model."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from own_cases import two_lags

from loopwright.pipeline.report.identified_model import CARRIED, FOLLOWED, GONE, LEFT, drift_answers

ROWS = 400
SAID = "The screening said of y1: it wanders: what the inputs do not explain moves over 27 % of its span. "


def screening(folder: Path, tag: str) -> None:
    finding = {"kind": "drift", "tag": tag, "words": "wanders: what the inputs do not explain moves over 27 % of its "
               "span; loads that nobody measures"}  # fmt: skip
    tags = [{"tag": f"T{i}", "name": f"y{i}"} for i in (0, 1)]
    other = {"kind": "outlier", "tag": "T0", "words": "3 readings stand alone"}
    verdict = {"inputs": [{"settling_s": 40.0}, {"settling_s": 0.0}]}
    report = {"tags": tags, "findings": [other, finding], "verdict": verdict, "period_s": 1.0}
    (folder / "screening.json").write_text(json.dumps(report))


def answers(
    tag: str, left: float, *, drifts: bool = False, rows: int = ROWS, ahead: int | None = None
) -> tuple[str, ...]:
    """Of a free run that leaves a slow wave of ``left`` beside white noise."""
    case = two_lags()
    screening(Path("data/it"), tag)
    rng = np.random.default_rng(1)
    measured = rng.normal(0, 0.01, (rows, 2)) + rng.uniform(-1, 1, (rows, 2))
    wave = left * np.sin(np.arange(rows) / rows * 4 * np.pi)[:, None]
    found = {"measured": measured, "free run": measured - wave + rng.normal(0, 0.01, (rows, 2))}
    evidence: Any = SimpleNamespace(case=case, models={"identified": {}}, predictions=lambda _: found)
    return drift_answers(evidence, {"structure": {"drifts": drifts, "rows_ahead": ahead}})


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("left", "drifts", "verdict"), [(0.0, False, GONE), (0.3, False, LEFT), (0.3, True, FOLLOWED)])
def test_the_model_says_what_is_left_of_a_drift(left: float, drifts: bool, verdict: str) -> None:
    (sentence,) = answers("T1", left, drifts=drifts)
    assert sentence.startswith(f"{SAID}The fitted model's free run over unseen rows leaves levels that move over ")
    assert sentence.endswith(f"{verdict}.")
    percent = float(sentence.partition("leaves levels that move over ")[2].partition(" % of the span")[0])
    span = np.ptp(np.quantile(two_lags().record.pv[:, 1], [0.01, 0.99]))
    assert percent == pytest.approx(100 * 2 * left / span, rel=0.1, abs=1.0)


def test_a_model_with_loads_has_no_free_run_to_tell_of() -> None:
    assert answers("T1", 0.3, ahead=30) == (f"{SAID}{CARRIED}",)


def test_each_of_several_tags_has_its_answer() -> None:
    first, second = answers("T0, T1", 0.0)
    assert first.startswith("The screening said of y0")
    assert second.startswith(SAID)


def test_too_few_unseen_rows_leave_the_verdict_of_the_fit() -> None:
    assert answers("T1", 0.3, rows=100) == (f"{SAID}The fitted model: no drift was found in what its free run leaves.",)
    assert answers("T1", 0.3, rows=100, drifts=True) == (f"{SAID}The fitted model: {FOLLOWED}.",)


def test_without_an_alarm_or_a_screening_nothing_is_said() -> None:
    assert answers("FI-7", 0.3) == ()
    Path("data/it/screening.json").unlink()
    evidence: Any = SimpleNamespace(case=two_lags(), models={})
    assert drift_answers(evidence, {}) == ()
