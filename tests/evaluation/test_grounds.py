"""What tests on models rest on: how far values lie beyond the data, in figures and in words."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from own_cases import two_lags

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.evaluation.evidence_basis import Grounds, RecordVerdict
from loopwright.pipeline.evaluation.extrapolation import beyond, grounds_of, reached_by, widest
from loopwright.pipeline.simulation.simulate import simulate_closed

RECORDED = {"T": (20.0, 60.0), "V": (0.0, 10.0)}


def test_what_stays_within_is_left_out() -> None:
    assert beyond({"T": (25.0, 60.1), "V": (0.0, 10.0)}, RECORDED) == {}
    assert beyond({"T": (16.0, 61.0), "V": (2.0, 12.5)}, RECORDED) == {"T": 10.0, "V": 25.0}
    assert beyond({"unknown": (0.0, 1.0)}, RECORDED) == {}


def test_the_widest_range_holds_all() -> None:
    assert widest([{"T": (1.0, 2.0)}, {"T": (0.0, 1.5), "V": (3.0, 3.0)}]) == {"T": (0.0, 2.0), "V": (3.0, 3.0)}
    assert widest([]) == {}


@pytest.mark.parametrize(
    ("grounds", "said"),
    [
        (Grounds({"T": 93.21}, {}, {}), "T 93.2 %; set points stay within the data; PVs and MVs do, too"),
        (Grounds({"T": None}, {"T": 5.0}, {}), "T none; set points go T 5 % of its recorded range beyond it"),
        (Grounds({"T": 90.0}, {}, {"V": 25.0}), "in closed loop V goes 25 % of its recorded range beyond it"),
    ],
)
def test_the_sentence_says_the_fit_and_how_far_the_tests_leave_the_data(grounds: Grounds, said: str) -> None:
    assert grounds.words.startswith("on models identified from your data (free-run fit over unseen rows: T ")
    assert said in grounds.words


def test_what_the_screening_said_of_the_record_is_said_wherever_its_figures_are(tmp_path: Path) -> None:
    record = tmp_path / "record.parquet"
    assert RecordVerdict.beside(record) is None
    loop = {"pv": "T", "unit": "degC", "rows": 9, "automatic": True, "mae": 1.5, "travel": {}, "travel_units": {}}
    verdict = {"carries": "doubtful", "reasons": ["V hardly moves", "few rows"]}
    record.with_name("screening.json").write_text(json.dumps({"verdict": verdict, "operated": [loop]}))
    found = RecordVerdict.beside(record)
    assert found is not None
    assert (found.carries, found.reasons) == ("doubtful", ("V hardly moves", "few rows"))
    grounds = Grounds({"T": 90.0}, {}, {}, record=found)
    assert grounds.doubt == "a model of these data is doubtful: V hardly moves; few rows"
    assert grounds.doubt in grounds.words
    assert grounds.warning == f"A{grounds.doubt[1:]}."
    assert grounds.to_dict()["data"] == "doubtful"
    assert "1.5 degC over 9 rows in automatic" in grounds.operated[0]
    proven = Grounds({"T": 90.0}, {}, {}, record=found, proven=True)
    assert proven.doubt.startswith("the screening doubted these data (V hardly moves; few rows)")
    assert proven.to_dict()["data"] == "doubtful"
    good = Grounds({"T": 90.0}, {}, {}, record=RecordVerdict("yes"))
    assert (good.doubt, good.warning) == ("", "")


def test_who_leaves_the_record_is_named() -> None:
    assert (
        "V goes 25 % of its recorded range beyond it under fast"
        in Grounds({}, {}, {"V": 25.0}, farthest={"V": "fast"}).words
    )


def test_set_points_beyond_the_record_are_a_warning_of_their_own() -> None:
    assert Grounds({"T": 90.0}, {}, {"V": 25.0}).warning == ""
    said = Grounds({"T": 90.0}, {"T": 61.5, "L": 2.0}, {}).warning
    assert said.startswith("Set points of the tests go beyond the record, T by 61.5 % of its recorded range, L by 2 %")


def test_they_come_from_the_models_figures_and_from_the_loops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    case = two_lags()
    models = {"parts": {"identified": {"per_seed": {"0": {"outputs": {"y0": {"fit_percent": 90.0}, "y1": {}}}}}}}
    test = case.scenarios()["load"][0]
    assert test.plant is not None
    loop = simulate_closed(test.plant, lambda sp, pv, mv: (np.array([1.0, 0.0]), []), test)
    Path("data/it/screening.json").write_text(json.dumps({"verdict": {"carries": "doubtful", "reasons": ["few rows"]}}))
    found = grounds_of(case, models, {"": reached_by([loop], case)})
    assert found is not None
    assert found.fit == {"y0": 90.0, "y1": None}
    assert found.set_points == {}
    assert found.doubt == "a model of these data is doubtful: few rows"
    assert found.farthest == {}  # of one law alone nobody asks
    low, high = case.recorded["u0"]
    assert found.loops["u0"] == pytest.approx(100 * (1 - high) / (high - low), rel=0.01)
    assert grounds_of(CASES["batch_reactor"], {}, {}) is None
