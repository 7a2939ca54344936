"""When a PV answers first: right within a row, as a range where the noise hides it, and no feedback taken for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dirty_plant import PERIOD_S, Clean, clean, screen_of, steps

from loopwright.pipeline.historian.answers import first_answer
from loopwright.pipeline.historian.cleaning.findings import RecordJudgement
from loopwright.pipeline.report.screening import sayings

N, DEAD, FIRST = 4000, 3, 4  # u(k-3) acts on y(k+1)


def plant(seed: int, noise: float, tau: float = 10.0) -> tuple[np.ndarray, np.ndarray]:
    """Two lags, of tau and 3 rows, behind a dead time, and a valve that stands for 10 to 60 rows."""
    random = np.random.default_rng(seed)
    u, y, inner, now = steps(random, N, 20, 80), np.empty(N), 0.0, 0.0
    for k in range(N):
        y[k] = now
        inner += (0.45 * u[max(k - DEAD, 0)] - inner) / tau
        now += 0.3 * (inner - now)
    return y + noise * random.standard_normal(N), u


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.2])
@pytest.mark.parametrize("seed", range(4))
def test_the_first_row_is_found_where_the_data_can_tell(seed: int, noise: float) -> None:
    y, u = plant(seed, noise)
    found = first_answer(y, u, np.zeros(N, np.int64))
    assert found is not None
    assert abs(found.last - FIRST) <= 1
    assert found.last - found.first <= 1
    assert not found.feedback


@pytest.mark.parametrize("shift", [-5, -3, -1, 5, 8])
def test_a_shift_moves_the_first_answer_by_as_many_rows(shift: int) -> None:
    y, u = plant(1, 0.2)
    found = first_answer(y[20:-20], np.roll(u, shift)[20:-20], np.zeros(N - 40, np.int64))
    assert found is not None
    assert (found.first, found.last) == (FIRST - shift, FIRST - shift)


@pytest.mark.parametrize(("noise", "tau"), [(0.5, 10.0), (1.0, 10.0), (2.0, 10.0), (0.2, 100.0), (1.0, 30.0)])
def test_noise_gives_a_range_that_holds_the_truth(noise: float, tau: float) -> None:
    held = 0
    for seed in range(10):
        y, u = plant(seed, noise, tau)
        found = first_answer(y, u, np.zeros(N, np.int64))
        held += found is None or found.first - 1 <= FIRST <= found.last + 1
    assert held >= 9


@pytest.mark.parametrize("seed", range(5))
def test_what_has_nothing_to_do_with_an_input_does_not_answer(seed: int) -> None:
    _, u = plant(seed, 0.0)
    other, _ = plant(seed + 100, 0.2)
    walk = np.cumsum(np.random.default_rng(seed).standard_normal(N))
    for y in (other, walk):
        assert first_answer(y, u, np.zeros(N, np.int64)) is None


def test_an_integrator_answers_at_its_first_row() -> None:
    _, u = plant(0, 0.0)
    y = np.r_[np.zeros(FIRST), np.cumsum(0.01 * (u[: N - FIRST] - 50))]
    found = first_answer(y + 0.02 * np.random.default_rng(0).standard_normal(N), u, np.zeros(N, np.int64))
    assert found is not None
    assert found.first - 1 <= FIRST <= found.last + 1


def by_hand() -> Clean:
    """A level whose operator corrects the valve every eight rows, and another one who moves it now and then."""
    random = np.random.default_rng(3)
    n = 3000
    out, u, y, x, now = steps(random, n, 30, 70), np.zeros(n), np.zeros(n), 50.0, 50.0
    for k in range(n):
        y[k] = x + 0.3 * random.standard_normal()
        now = out[k] + 1.5 * (50.0 - y[k]) if k % 8 == 0 else now
        u[k] = round(float(np.clip(now + 8 * np.sign(np.sin(k / 13)), 0, 100)), 1)
        x += 0.05 * (u[max(k - DEAD, 0)] - out[k])
    return Clean(1_709_532_000.0 + PERIOD_S * np.arange(n), y.round(2), u, out)


def test_a_proportional_hand_is_feedback_and_no_late_column(tmp_path: Path) -> None:
    verdict = screen_of(by_hand(), tmp_path).report.verdict
    valve = verdict.inputs[0]
    assert valve.against == ("TIC-101.PV",)
    words = " ".join(verdict.reasons)
    assert "TIC-101.OP is moved against what TIC-101.PV did before: feedback" in words
    assert "its column is late" not in words
    assert valve.first_answer_s["TIC-101.PV"] > 0


def test_a_late_column_is_no_feedback(tmp_path: Path) -> None:
    data = clean(2500)
    verdict = screen_of(data.with_(mv=np.roll(data.mv, 8)), tmp_path).report.verdict
    assert verdict.inputs[0].against == ()
    assert "its column is late" in " ".join(verdict.reasons)


@pytest.mark.parametrize(
    ("noise", "words"), [(0.1, "first answer after 18 s,"), (2.0, " to 18 s,"), (6.0, " s at most,")]
)
def test_a_range_is_printed_where_the_noise_hides_it(noise: float, words: str, tmp_path: Path) -> None:
    verdict: RecordJudgement = screen_of(clean(2500, noise=noise), tmp_path).report.verdict
    assert words in sayings(verdict, {})[0]
