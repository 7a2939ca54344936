"""What validate ships, and what it refuses to ship: real files of the repository over short tests of a real plant."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.thiosulfate_cstr.case import TJ, ThiosulfateCstrCase
from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.errors import LawError, PlantError
from loopwright.pipeline.evaluation.law_evidence import LawMetrics
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.scenario import Scenario, held
from loopwright.pipeline.stages import validate as stage
from loopwright.serving import Controller
from loopwright.serving.certificate import certificate_of

CASE, LAW = "thiosulfate_cstr", "pid"
FILE = Path(__file__).parents[2] / "artifacts" / CASE / f"{LAW}.onnx"


@dataclass(frozen=True)
class ShortCase(ThiosulfateCstrCase):
    """One step that the PID follows; ``hard`` adds a set point out of the plant's reach."""

    hard: bool = False

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        levels = {"step": [0.9872, 0.9]} | ({"beyond": [-0.3]} if self.hard else {})
        return {n: (self._test(n, sp),) for n, sp in levels.items()}

    def unscored(self) -> dict[str, Scenario]:
        return {"longer": self._test("longer", [0.9872, 0.9], 80)}

    def development(self) -> tuple[Scenario, ...]:
        return (self._test("development", [0.9872]),)

    def _test(self, name: str, levels: list[float], hold: int = 40) -> Scenario:
        return Scenario(name, name, held(levels, hold), self._steady["cold"], np.array([TJ]), hold=hold)


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Puts a designed controller, of two data seeds, and its section of params.yaml into a folder of its own."""

    def make(hard: bool, **section: Any) -> None:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setitem(CASES, CASE, ShortCase(hard=hard))
        designed = tmp_path / "work" / CASE / "controllers" / LAW
        for form in ("base", *section.get("variants", {})):
            (designed / form).mkdir(parents=True)
            for seed in (0, 4):
                shutil.copy(FILE, designed / form / f"seed{seed}.onnx")
        (designed / "metrics.json").write_text(json.dumps({"title": "PID", "controllers": []}))
        tree = {
            "cases": {CASE: {"held_out_seeds": [9001], "noise_seed": 0}},
            "controllers": {f"{CASE}-{LAW}": {"case": CASE, "name": LAW, "law": LAW, "model": "linearized", **section}},
        }
        (tmp_path / "params.yaml").write_text(yaml.safe_dump(tree))

    return make


SHIPPED = Path("artifacts") / CASE / f"{LAW}.onnx"
MEASURED = Path("work") / CASE / "validation" / LAW / "metrics.json"


def test_a_law_that_locked_up_is_not_shipped(made: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    made(hard=True)
    with pytest.raises(
        LawError, match=r"locked up on beyond \(seeds 0, 4\), beyond_noise \(seeds 0, 4\), so nothing is"
    ):
        stage.validate(f"{CASE}-{LAW}")
    assert not SHIPPED.exists()
    assert run_stage(stage.validate, ["validate", f"{CASE}-{LAW}"], "CONTROLLER") == 2
    *progress, line = capsys.readouterr().err.splitlines()
    assert "as_printed: true" in line
    assert all(": files in closed loop" in said for said in progress)  # a slow machine says how far it is


def test_a_reproduction_is_shipped_and_says_so(made: Callable[..., None]) -> None:
    made(hard=True, as_printed=True)
    stage.validate(f"{CASE}-{LAW}")
    evidence = Controller(SHIPPED).manifest.evidence
    assert evidence["lock_ups"] == 4
    assert evidence["locked_up"] == {"beyond": {"0": 1, "4": 1}, "beyond_noise": {"0": 1, "4": 1}}
    assert evidence["as_printed"] is True
    measured = LawMetrics.read(MEASURED)
    assert (measured.lock_ups, measured.as_printed) == (4, True)
    assert measured.locked_up == evidence["locked_up"]


def test_settings_of_variants_are_kept_as_data(made: Callable[..., None]) -> None:
    variants = {"slow": {"kc": 0.5, "tuning": "manual", "examined_cv": [0.1, 0.2]}}
    made(hard=False, ti_s=3.0, variants=variants)
    stage.validate(f"{CASE}-{LAW}")
    forms = LawMetrics.read(MEASURED).forms
    assert {name: form.setting for name, form in forms.items()} == {
        "base": {"ti_s": 3.0},
        "slow": {"kc": 0.5, "tuning": "manual", "examined_cv": [0.1, 0.2]},
    }
    assert list(forms["slow"].tests) == ["step"]


def test_a_sound_law_is_shipped_without_a_word(made: Callable[..., None]) -> None:
    made(hard=False)
    stage.validate(f"{CASE}-{LAW}")
    evidence = Controller(SHIPPED).manifest.evidence
    assert evidence["lock_ups"] == 0
    assert not {"locked_up", "as_printed"} & set(evidence)
    measured = LawMetrics.read(MEASURED)
    assert measured.locked_up == {}
    # What is not scored leaves its curve, and no figure.
    assert list(measured.forms["base"].tests) == ["step", "step_noise"]
    with np.load(MEASURED.with_name("trajectories.npz")) as curves:
        assert curves[f"longer/base/{measured.shipped_seed}/pv"].shape == (160, 2)


def test_a_shipped_law_has_a_certificate_of_few_loops(made: Callable[..., None]) -> None:
    made(hard=False)
    stage.validate(f"{CASE}-{LAW}")
    controller = Controller(SHIPPED)
    found = certificate_of(controller.manifest, controller.law_sha256).certificate
    assert found is not None
    assert (found.loops, found.confidence, found.small) == (90, 0.99, True)
    assert LawMetrics.read(MEASURED).certificate == found
    plan = json.loads(MEASURED.with_name("certificate_plan.json").read_text())
    assert (plan["plan"], plan["seed"], plan["loops"]) == (found.plan, found.seed, 90)


def test_params_yaml_asks_for_other_certificates_or_for_none(made: Callable[..., None]) -> None:
    made(hard=False)
    tree = yaml.safe_load(Path("params.yaml").read_text())
    for asked, loops in (({"loops": 12, "spread": 1.0}, 12), ({"loops": 0}, None)):
        tree["cases"][CASE]["certificate"] = asked
        Path("params.yaml").write_text(yaml.safe_dump(tree))
        stage.validate(f"{CASE}-{LAW}")
        found = LawMetrics.read(MEASURED).certificate
        assert (None if found is None else found.loops) == loops
    assert "certificate" not in Controller(SHIPPED).manifest.evidence


def test_a_plant_without_parameters_is_shipped_without_a_certificate(
    made: Callable[..., None], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object) -> dict[str, tuple[float, float]]:
        raise PlantError("plant 'bare' has no parameters")

    made(hard=False)
    monkeypatch.setattr("loopwright.pipeline.evaluation.stress.draws.Drawing.ranges", none)
    stage.validate(f"{CASE}-{LAW}")
    assert "no certificate: plant 'bare' has no parameters" in capsys.readouterr().err
    assert "certificate" not in Controller(SHIPPED).manifest.evidence


@pytest.mark.parametrize("same_row", [True, False])
def test_the_replay_takes_the_row_convention_of_the_law_s_model(same_row: bool, tmp_path: Path) -> None:
    rng, signals = np.random.default_rng(0), ShortCase().plant.signals
    pv, mv = (
        rng.uniform([s.low for s in group], [s.high for s in group], (50, len(group)))
        for group in (signals.pv, signals.mv)
    )
    record = Record.of(signals, pv, mv)
    case: Any = SimpleNamespace(replayed=(record, 5), plant=ShortCase().plant)
    seeds = {"0": {"structure": {"same_row": same_row}}}
    models = {"parts": {"identified": {"kind": "identified", "per_seed": seeds}}}
    figures = stage._replayed(case, models, FILE, tmp_path / "replay.npz")
    assert figures[signals.mv[0].name]["refused"] == 0
    with np.load(tmp_path / "replay.npz") as rows:
        np.testing.assert_array_equal(rows["done"], record.mv[41:] if same_row else record.mv[40:])
