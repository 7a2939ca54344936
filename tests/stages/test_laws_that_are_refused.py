"""Laws that cannot be designed for an own plant: which errors withhold a law, and what the case then shows."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from own_cases import controllers_of_a_lag

from pipeline.errors import LawError, ModelError, ParamsError, PlantError, RecordError
from pipeline.laws.pid.pid import PID
from pipeline.stages.design import design
from pipeline.stages.validate import validate

GIVEN = {"law": "pid", "tuning": "manual", "kc": 0.2, "ti_s": 3.0}


@pytest.fixture
def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    controllers_of_a_lag({"pid": GIVEN})


def reason_of(law: str) -> str:
    return str(json.loads(Path(f"artifacts/it/{law}.json").read_text())["withheld"])


@pytest.mark.parametrize("kind", [LawError, ModelError, PlantError, ParamsError, RecordError])
def test_every_error_of_ours_in_a_design_withholds_the_law(
    plant: None, monkeypatch: pytest.MonkeyPatch, kind: type[Exception]
) -> None:
    def refuses(*_: object) -> None:
        raise kind("the valve is stuck")

    monkeypatch.setattr(PID, "design", refuses)
    design("it-pid")
    validate("it-pid")
    assert reason_of("pid") == "law 'pid' is withheld: the valve is stuck"


def test_equations_without_a_solution_withhold_the_law_in_words(plant: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PID, "design", lambda *_: np.linalg.inv(np.zeros((2, 2))))
    design("it-pid")
    validate("it-pid")
    assert reason_of("pid") == (
        "law 'pid' is withheld: its equations have no single solution over the model of the plant (Singular matrix)"
    )


@pytest.mark.parametrize("error", [TypeError("a bug"), KeyError("a bug"), ZeroDivisionError("a bug")])
def test_a_mistake_in_the_program_ends_the_run(plant: None, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(PID, "design", fails)
    with pytest.raises(type(error)):
        design("it-pid")
    assert not Path("work/it/controllers/pid/metrics.json").exists()


def test_models_that_cannot_be_read_end_the_run(plant: None) -> None:
    """They are not the law's: no other law could be designed on them either."""
    Path("work/it/models/identified/seed0/plant1.npz").write_bytes(b"cut off")
    with pytest.raises(ModelError):
        design("it-pid")
