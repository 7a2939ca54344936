"""The section of a report on an identified model: signs, dead times, verdicts and the structures tried."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from own_cases import two_lags

from loopwright.pipeline.report.identified_model import ANSWERS, FREE_RUN, TRIED, VARIABLES, ModelSection, model_section
from loopwright.serving.manifest import Signal


def gain(sign: str, varies: float | None, rate: bool = False) -> dict[str, Any]:
    return {"gain": 0.5, "spread": 0.3, "rate": rate, "sign": sign, "low": -0.1, "high": 0.9, "varies": varies}


def tried(error: float | None, chosen: bool) -> dict[str, Any]:
    fixed = {"start": "lagged", "order": 2, "delays": [0, 1], "hidden": 4, "spread": 0.1}
    return {**fixed, "error": error, "chosen": chosen}


PART: dict[str, Any] = {
    "structure": {"verdict": "linear is enough: it is as good"},
    "stability": {"verdict": "stable: it settles"},
    "spectral_radius": 0.9,
    "warnings": ["y0: half of the rows are elsewhere"],
    "outputs": {
        "y0": {"fit_percent": 91.27, "free_run_rmse": 0.1, "rmse_by_third": [0.2, 0.1, None], "noise_sd": 0.05},
        "y1": {"fit_percent": None, "free_run_rmse": 9.0, "rmse_by_third": [9.0, 9.0, 9.0], "noise_sd": 0.05},
    },
    "residual": {"y0": {"autocorrelated": 0.5, "input_correlated": 0.02}},
    "gains": {"y0": {"u0": gain("+", 1.4), "u1": gain("uncertain", None)}, "y1": {"u0": gain("-", 1.0, rate=True)}},
    "dead_times": {"u0": 3.0, "u1": 0.0},
    "first_answers": {"y0": {"u0": 4, "u1": None}, "y1": {"u0": 7, "u1": 1}},
    "candidates_tried": [*(tried(0.1 * k, False) for k in range(1, 20)), tried(5.0, True), tried(None, False)],
}


@pytest.fixture
def section(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModelSection:
    monkeypatch.chdir(tmp_path)
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": PART}}}}}
    found = model_section(SimpleNamespace(case=two_lags(), models=models))  # type: ignore[arg-type]
    assert found is not None
    return found


def test_verdicts_are_sentences(section: ModelSection) -> None:
    assert section.verdicts[:3] == (
        "Linear is enough: it is as good.",
        "Stable: it settles.",
        "Warning: y0: half of the rows are elsewhere.",
    )
    assert section.verdicts[3].startswith("The tests ask for y0 from ")
    assert section.verdicts[3].endswith("which the MVs can hold within the record. Nothing is known of others.")


@pytest.mark.parametrize("wanders", [True, False])
def test_both_kinds_of_model_are_told_where_a_load_wanders(
    wanders: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ahead = {"one_step": 0.12 if wanders else 0.56, "free_runs": 0.34, "rows": 30, "wanders": wanders}
    structure = {"verdict": "linear", "hidden": 0, "ahead": ahead, "rows_ahead": 30 if wanders else None}
    part = {**PART, "structure": structure}
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": part}}}}}
    found = model_section(SimpleNamespace(case=two_lags(), models=models))  # type: ignore[arg-type]
    assert found is not None
    assert all(number in found.verdicts[1] for number in ("0.12" if wanders else "0.56", "0.34"))
    assert ("model with loads is taken" in found.verdicts[1]) is wanders
    assert (found.predicted != FREE_RUN) is wanders  # the figures of the table are of that kind too


def test_the_lateness_of_an_analyser_is_told_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    part = {**PART, "late": {"y0": 0, "y1": 7}}
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": part}}}}}
    found = model_section(SimpleNamespace(case=two_lags(), models=models))  # type: ignore[arg-type]
    assert found is not None
    told = [line for line in found.verdicts if "analyser" in line]
    assert len(told) == 1
    assert told[0].startswith("y1 ")
    assert "7 periods (7 s)" in told[0]


@pytest.mark.parametrize("certain", [True, False])
def test_a_gain_that_changed_is_told_with_its_last_value(
    certain: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    trend = {"change": -0.51, "sd": 0.1, "certain": certain, "at_end": 0.3725}
    part = {**PART, "gains": {"y0": {"u0": gain("+", 1.4) | {"trend": trend}}}}
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": part}}}}}
    found = model_section(SimpleNamespace(case=two_lags(), models=models))  # type: ignore[arg-type]
    assert found is not None
    told = [line for line in found.verdicts if all(figure in line for figure in ("51", "10", "0.372", "0.5"))]
    assert len(told) == int(certain)


def test_every_variable_has_its_fit_and_its_residual(section: ModelSection) -> None:
    assert section.variables[0] == ("y0 [m]", "91.3 %", "0.1", "0.2, 0.1, –", "0.05", "50 %", "2 %")
    assert section.variables[1][1] == "the run explodes"
    assert section.variables[1][-2:] == ("–", "–")


def test_an_answer_says_its_sign_and_how_sure_that_is(section: ModelSection) -> None:
    signs = {row[:2]: row[3] for row in section.answers}
    assert signs == {("y0", "u0"): "+", ("y0", "u1"): "uncertain", ("y1", "u0"): "−"}
    assert "turns its sign" in section.answers[1][4]
    assert [row[2] for row in section.answers] == ["0.5 ± 0.3 [m/V]", "0.5 ± 0.3 [m/V]", "0.5 ± 0.3 [m/V a period]"]
    assert [row[5] for row in section.answers] == ["4", "–", "7"]  # [s], as the period is 1 s


@pytest.mark.parametrize(("hidden", "over"), [(0, {"one gain: the model is linear"}), (4, {"-0.1 … 0.9, × 1.4"})])
def test_a_linear_model_says_nothing_of_gains_over_the_range(
    hidden: int, over: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    part = {**PART, "structure": {"verdict": "linear", "hidden": hidden}, "gains": {"y0": {"u0": gain("+", 1.4)}}}
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": part}}}}}
    found = model_section(SimpleNamespace(case=two_lags(), models=models))  # type: ignore[arg-type]
    assert found is not None
    assert {row[4] for row in found.answers} == over


@pytest.mark.parametrize(("high", "lines"), [(1.0, 0), (0.4, 1)])
def test_the_report_says_on_which_side_of_a_turn_controllers_stay(
    high: float, lines: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    case: Any = two_lags()
    whole = case.plant_class.mv_signals
    ends = [replace(s, high=s.low + high * (s.high - s.low)) for s in whole]
    vars(case.plant)["mv_signals"] = tuple(ends)
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": PART}}}}}
    found = model_section(SimpleNamespace(case=case, models=models))  # type: ignore[arg-type]
    assert found is not None
    told = [line for line in found.verdicts if line.startswith("Controllers move ")]
    assert len(told) == lines * len(whole)


def test_the_best_structures_are_listed_and_the_chosen_one_whatever_its_error(section: ModelSection) -> None:
    errors = [float(row[4]) for row in section.tried]
    assert errors[:-1] == sorted(errors[:-1])
    assert section.tried[-1][-1] == "yes"
    assert len(section.tried) == 13


def test_rows_have_a_cell_a_column(section: ModelSection) -> None:
    for head, rows in ((VARIABLES, section.variables), (ANSWERS, section.answers), (TRIED, section.tried)):
        assert {len(row) for row in rows} == {len(head)}


def test_a_case_without_an_identified_model_has_no_such_section() -> None:
    models = {"nnarx": {"parts": {"a": {"kind": "nnarx"}}}}
    assert model_section(SimpleNamespace(models=models)) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("rmse", "noise", "words"),
    [
        (0.306, 0.297, "8.14 %, as good as the noise"),
        (0.33, 0.297, "8.14 %"),
        (0.306, None, "8.14 %"),
    ],
)
def test_a_fit_of_rows_that_hardly_move_is_held_against_the_noise(
    rmse: float, noise: float | None, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    part = {**PART, "outputs": {"y0": {"fit_percent": 8.142, "free_run_rmse": rmse, "noise_sd": noise}}}
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": part}}}}}
    found = model_section(SimpleNamespace(case=two_lags(), models=models))  # type: ignore[arg-type]
    assert found is not None
    assert found.variables[0][1] == words


@pytest.mark.parametrize(
    ("gain_sd", "says"), [(0.123, "by 12 % in the gain of u0,"), (1.2e4, "by more than 100 % in the gain of u0,")]
)
def test_a_share_of_a_gain_of_nearly_zero_is_no_number(
    gain_sd: float, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    part = {**PART, "open": {"gain_sd": [gain_sd, 0.1], "pace_sd": [0.05], "dead_sd": [0.3]}}
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": part}}}}}
    found = model_section(SimpleNamespace(case=two_lags(), models=models))  # type: ignore[arg-type]
    assert found is not None
    assert any(says in line for line in found.verdicts)


@pytest.mark.parametrize(("most", "asks"), [(1, False), (4, True)])
def test_the_report_asks_for_a_dead_time_that_the_record_does_not_tell(
    most: int, asks: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    certain = {"gain_sd": [0.1, 0.1], "pace_sd": [0.05], "dead_sd": [0.3]}
    part = {**PART, "open": certain | {"dead_times": {"u0": [1, 0, most], "u1": [1, 1, 1]}}}
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": part}}}}}
    found = model_section(SimpleNamespace(case=two_lags(), models=models))  # type: ignore[arg-type]
    assert found is not None
    said = [line for line in found.verdicts if "--known" in line]
    assert len(said) == asks
    assert all("y0/u0=dead" in line and "u1" not in line for line in said)


@pytest.mark.parametrize(("sd", "says"), [(0.25, "0.25 t/h of feed"), (0.0, "")])
def test_the_report_names_the_noise_of_measured_disturbances(
    sd: float, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    part = {**PART, "disturbances": {"feed": {"noise_sd": sd}}}
    case = two_lags()
    monkeypatch.setattr(case.plant_class, "dv_signals", (Signal("feed", "t/h", 0.0, 9.0),))
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": part}}}}}
    found = model_section(SimpleNamespace(case=case, models=models))  # type: ignore[arg-type]
    assert found is not None
    assert any(says in line for line in found.verdicts if "have noise" in line) == bool(says)
