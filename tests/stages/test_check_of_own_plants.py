"""Settings of an own plant's laws that its signals refuse: found before any model is trained."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from own_cases import section, two_lags

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.stages.check import mistakes, notes

SET = {"kind": "identified"}


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """params.yaml of a plant with two CVs and two MVs, and its record; its models are not trained yet."""
    monkeypatch.chdir(tmp_path)
    two_lags()
    shutil.rmtree("work")
    own = {"case": "it", "model": "identified"}
    parts = {"identified": SET, "plant1": SET, "plant2": SET}
    return {
        "plants": {"it": section(2, 2)},
        "records": {},
        "cases": {"it": {"held_out_seeds": [9001]}},
        "models": {"it-identified": {**own, "data": "data/it/record.parquet", "parts": parts}},
        "controllers": {
            "it-predictive": {**own, "name": "predictive", "law": "predictive"},
            "it-pid": {**own, "name": "pid", "law": "pid"},
        },
    }


def found_in(tree: dict[str, Any], law: str, settings: dict[str, Any]) -> list[str]:
    tree["controllers"][f"it-{law}"] |= settings
    Path("params.yaml").write_text(yaml.safe_dump(tree))
    return mistakes()


@pytest.mark.parametrize(
    ("law", "settings", "said"),
    [
        ("predictive", {"weights": [1.0]}, "has 1 weights; give one for each set point (y0, y1)"),
        ("predictive", {"cv_low": [0.5]}, "has 1 limits in cv_low; give one for each set point (y0, y1)"),
        ("predictive", {"cv_high": [None, 9.0]}, "cv_high of y1 is 9.0, outside the signal's range [-3, 3] m"),
        ("predictive", {"mv_rate": [0.1, 0.1, 0.1]}, "mv_rate has 3 entries; give one number for all MVs"),
        ("predictive", {"preview": "slope"}, "preview"),
        ("predictive", {"wieghts": [1.0, 1.0]}, "unknown key 'wieghts'"),
        ("pid", {"mv_rate": [-0.1, 0.1]}, "mv_rate is [-0.1, 0.1]; give the largest MV change a sample, above 0"),
        ("pid", {"tuning": "simc"}, "law 'pid' controls one variable by one; got 2 set points and 2 MVs"),
        ("pid", {"tuning": "simple"}, "tuning"),
    ],
)
def test_a_mistake_is_found_before_anything_is_trained(
    tree: dict[str, Any], law: str, settings: dict[str, Any], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (line,) = found_in(tree, law, settings)
    assert line.startswith(f"controllers.it-{law}")
    assert said in line
    assert main(["run", "it"]) == 2
    assert said in capsys.readouterr().err
    assert not Path("work").exists()


def test_a_manual_pid_needs_its_numbers(tree: dict[str, Any]) -> None:
    tree["plants"]["it"] = section(1, 1)
    (line,) = found_in(tree, "pid", {"tuning": "manual", "kc": 1.0})
    assert "PID tuning `manual` needs kc and ti_s" in line


def test_right_settings_are_no_mistake(tree: dict[str, Any]) -> None:
    given = {"weights": [1.0, 2.0], "cv_high": [None, 2.0], "mv_rate": [0.1, None], "preview": "ramp"}
    assert found_in(tree, "predictive", given) == []
    assert not [line for line in notes() if "withheld" in line]


def test_what_the_models_do_not_allow_is_a_note_and_no_mistake(tree: dict[str, Any]) -> None:
    """The run goes on without the law, as it did when the models were first trained."""
    two_lags()
    singular = Path("work/it/models/identified/seed0/identified.npz")
    assert found_in(tree, "pid", {}) == []
    assert not [line for line in notes() if "withheld" in line]
    with np.load(singular) as file:
        arrays = dict(file)
    arrays["b"] = np.tile(arrays["b"][:, :1], (1, arrays["b"].shape[1]))  # both MVs do the same
    np.savez(singular, **arrays)
    assert mistakes() == []
    (line,) = [line for line in notes() if "it-pid" in line]
    assert line.startswith("controllers.it-pid: law 'pid' is withheld: ")
