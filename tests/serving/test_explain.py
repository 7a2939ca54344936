"""The explain graph beside a controller: it belongs to one file, gives what that one does, and sums."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from identified_models import random_model
from predictive_loops import law_of

from loopwright.pipeline.export.controller_file import with_evidence, withhold
from loopwright.pipeline.export.explain_graph import export_explanation
from loopwright.serving import ArtifactError, ContractError, Controller, LoopwrightError
from loopwright.serving.controller_file import controller_files
from loopwright.serving.explain import Explainer, MovePart
from loopwright.serving.explain.explain_file import explain_path
from loopwright.serving.explain.explanation import sentence_of
from loopwright.serving.operating import Operate

pytest_plugins = ["operated_laws"]
MODEL = random_model(3, n_y=2, n_mv=2, n_dv=1)  # of ``operated_file``
LAW = law_of(MODEL, horizon=20, operate={})


@pytest.fixture(scope="module")
def file(operated_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A controller with its explain graph."""
    path = tmp_path_factory.mktemp("explained") / "predictive.onnx"
    shutil.copy(operated_file, path)
    assert export_explanation(LAW, path) == explain_path(path)
    return path


@pytest.fixture
def explainer(file: Path) -> Explainer:
    return Explainer(explain_path(file))


def at_rest(explainer: Explainer, steps: int = 60) -> tuple[dict[str, Any], torch.Tensor]:
    """Inputs of a loop over the model at rest, and the model's state."""
    x, mv, state = torch.zeros(MODEL.n_x).double(), np.array([0.1, -0.1]), explainer.controller.cold_state()
    dv = np.zeros(1)
    for _ in range(300):
        x = MODEL(torch.cat([x, torch.from_numpy(mv), torch.from_numpy(dv)]))
    sp = MODEL.measured(x).detach().numpy().copy()
    for _ in range(steps):
        x, mv, state = moved(explainer, x, {"sp": sp, "dv": dv, "mv_applied": mv, "state": state})
    inputs = {"sp": sp, "pv": MODEL.measured(x).detach().numpy(), "dv": dv, "mv_applied": mv, "state": state}
    return inputs, x


def moved(explainer: Explainer, x: torch.Tensor, inputs: dict[str, Any]) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
    step = explainer.controller.step(**{**inputs, "pv": MODEL.measured(x).detach().numpy()})
    x = MODEL(torch.cat([x, torch.from_numpy(step.mv), torch.from_numpy(inputs["dv"])])).detach()
    return x, step.mv, step.state


def test_the_graph_moves_as_the_controller_does_and_its_parts_sum(explainer: Explainer) -> None:
    inputs, x = at_rest(explainer)
    rng = np.random.default_rng(0)
    places = {e.name: i for i, e in enumerate(explainer.manifest.operate)}
    operate = np.array([e.default for e in explainer.manifest.operate])
    for k in range(30):
        operate[places["u0.high"]] = 1.0 if k < 15 else 0.05
        inputs |= {"sp": inputs["sp"] + 0.05 * rng.normal(size=2), "dv": inputs["dv"] + 0.05 * rng.normal(size=1)}
        inputs |= {"pv": MODEL.measured(x).detach().numpy(), "operate": operate}
        found, step = explainer.explain(**inputs), explainer.controller.step(**inputs)
        given = np.clip(inputs["mv_applied"], -1, 1)
        for move, mv, at in zip(found.moves, step.mv, given, strict=True):
            assert sum(p.value for p in move.parts) == pytest.approx(move.move, abs=2e-9)
            assert move.move == pytest.approx(mv - at, abs=2e-12)
        x, inputs["mv_applied"], inputs["state"] = moved(explainer, x, inputs)


def test_the_courses_have_names_units_and_times(explainer: Explainer) -> None:
    inputs, _ = at_rest(explainer, 2)
    found = explainer.explain(**inputs)
    row = json.loads(found.to_json())
    assert set(row) == {"period_s", "courses", "moves"}
    assert [(c["signal"], c["group"], c["unit"]) for c in row["courses"]] == [
        ("y0", "cv", "m"), ("y1", "cv", "m"), ("u0", "mv", "V"), ("u1", "mv", "V"),
    ]  # fmt: skip
    assert row["courses"][0]["times_s"] == [float(k) for k in range(1, 21)]
    assert row["courses"][2]["times_s"] == [float(k) for k in LAW.moves.starts]
    assert all(len(c["values"]) == len(c["times_s"]) for c in row["courses"])
    assert set(row["moves"][0]) == {"mv", "unit", "move", "parts", "sentence"}
    assert set(row["moves"][0]["parts"][0]) == {"cause", "signal", "value", "in_s"}


def test_a_disturbance_is_named_with_its_direction(explainer: Explainer) -> None:
    inputs, _ = at_rest(explainer)
    rose, fell = (explainer.explain(**{**inputs, "dv": inputs["dv"] + by}).moves[0] for by in (0.3, -0.3))
    assert rose.first == MovePart("disturbance", "d0", rose.first.value)
    assert rose.sentence.startswith("100 %: d0 ")
    assert rose.sentence != fell.sentence  # it rose, it fell


# ------------------------------------------------------------------------------------------------------------- what if
@pytest.mark.parametrize(
    "change",
    [
        {"y0": 0.2},
        {"y0.track": 0, "y0.high": -0.1},
        {"u0.use": 0, "y0.track": 0, "y1": 0.15},
        {"u1.max_move": 0.02, "y1": 0.3},
    ],
)
def test_what_if_is_what_then_happens_on_the_model(explainer: Explainer, change: dict[str, float]) -> None:
    inputs, x = at_rest(explainer)
    at = {"y0": inputs["sp"][0], "y1": inputs["sp"][1], "y0.high": inputs["pv"][0]}
    changes = {name: value + at.get(name, 0.0) for name, value in change.items()}
    found = explainer.what_if(changes, **inputs)
    assert found.changes == changes
    sp, operate = explainer.changed_inputs(changes, inputs["sp"])
    begin, happened = np.concatenate([inputs["pv"], inputs["mv_applied"]]), []
    then = {**inputs, "sp": sp, "operate": operate}
    for _ in range(20):
        x, then["mv_applied"], then["state"] = moved(explainer, x, then)
        happened.append(np.concatenate([MODEL.measured(x).detach().numpy(), then["mv_applied"]]))
    real = np.array(happened)
    span = np.abs(real - begin).max()
    assert span > 0.02
    for course, of in zip(found.after.courses, real.T, strict=True):
        assert np.abs(np.array(course.values) - of).max() <= 0.05 * span


def test_what_if_without_a_change_changes_nothing(explainer: Explainer) -> None:
    inputs, _ = at_rest(explainer, 3)
    before = {name: np.array(value) for name, value in inputs.items()}
    found = explainer.what_if({}, **inputs)
    assert found.before == found.after
    assert set(json.loads(found.to_json())) == {"changes", "before", "after"}
    assert all((inputs[name] == value).all() for name, value in before.items())


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"y9": 1.0}, "y9"),
        ({"y0.hihg": 1.0}, "y0.high"),
        ({"y0": 99.0}, "y0"),
        ({"y0": "much"}, "y0"),
        ({"y0": [0.1, 0.2]}, "y0"),
        ({"u0.low": 0.5, "u0.high": 0.2}, "u0.low"),
        ({"u0.use": 0.5}, "u0.use"),
        ({"speed": 99.0}, "speed"),
    ],
)
def test_a_wrong_change_is_one_error_with_its_name(explainer: Explainer, changes: dict[str, Any], named: str) -> None:
    inputs, _ = at_rest(explainer, 1)
    with pytest.raises(LoopwrightError, match=named):
        explainer.what_if(changes, **inputs)


# ------------------------------------------------------------------------------------------------------------ the file
def test_it_belongs_to_one_file_and_goes_with_it(file: Path, tmp_path: Path) -> None:
    here = tmp_path / "predictive.onnx"
    with_evidence(file, here, {"lock_ups": 0})
    assert Controller(here).sha256 != Controller(file).sha256
    Explainer(explain_path(here), sha256=Controller(here).sha256)
    with pytest.raises(ArtifactError, match="pinned"):
        Explainer(explain_path(here), sha256=Controller(file).sha256)
    shutil.copy(explain_path(file), explain_path(here))  # of the file without that evidence
    with pytest.raises(ArtifactError, match=Controller(file).sha256):
        Explainer(explain_path(here))
    assert controller_files(tmp_path) == [here]
    withhold(here, "it locked up")
    assert not explain_path(here).exists()


def test_a_law_that_explains_nothing_leaves_no_graph_of_an_older_one(file: Path, tmp_path: Path) -> None:
    for path in (file, explain_path(file)):
        shutil.copy(path, tmp_path / path.name)
    assert export_explanation(law_of(MODEL, horizon=20), tmp_path / file.name) is None
    assert not explain_path(tmp_path / file.name).exists()


def test_a_damaged_or_foreign_file_is_refused(file: Path, tmp_path: Path) -> None:
    here = tmp_path / file.name
    shutil.copy(file, here)
    shutil.copy(file, explain_path(here))
    with pytest.raises(ArtifactError, match="explains no controller"):
        Explainer(explain_path(here))
    data = bytearray(explain_path(file).read_bytes())
    data[len(data) // 2] ^= 1
    explain_path(here).write_bytes(bytes(data))
    with pytest.raises(ArtifactError):
        Explainer(explain_path(here))
    shutil.copy(explain_path(file), explain_path(here))
    here.unlink()
    with pytest.raises(ArtifactError):
        Explainer(explain_path(here))
    with pytest.raises(ArtifactError):
        Controller(explain_path(file))  # no loop steps it


def test_inputs_are_checked_as_the_controller_does(explainer: Explainer) -> None:
    inputs, _ = at_rest(explainer, 1)
    with pytest.raises(ContractError, match="pv"):
        explainer.explain(**{**inputs, "pv": [0.0]})


# ----------------------------------------------------------------------------------------------------------- the words
def test_shares_are_of_each_side_and_small_ones_are_not_named() -> None:
    parts = [
        MovePart("range_high", "LI-1", -7.0),
        MovePart("disturbance", "FI-7", -2.0),
        MovePart("load", "TI-4", -0.1),
        MovePart("max_move", "FIC-2", 3.0),
    ]
    text = sentence_of(-6.1, 100.0, parts, {"FI-7": 1.0})
    assert "77 %: LI-1" in text
    assert "22 %: FI-7" in text
    assert "100 %: FIC-2" in text
    assert "TI-4" not in text
    assert sentence_of(0.0, 100.0, [MovePart("plan", "", 0.0)], {}) != text


def test_a_resting_value_is_never_said_to_hold_back_what_goes_to_it() -> None:
    """The plan may go to it in a roundabout way; the words then say so, of this MV alone."""
    parts = [MovePart("setpoint", "LI-1", 5.0), MovePart("rest", "FV-3", -2.0)]
    away_from_it, to_it = (sentence_of(3.0, 100.0, parts, {}, {"FV-3": far}) for far in (-20.0, 20.0))
    another = sentence_of(3.0, 100.0, parts, {})
    assert away_from_it == another != to_it
    assert "FV-3" in away_from_it
    assert "FV-3" not in to_it  # it goes there: the rest holds nothing back
    stands = sentence_of(0.0, 100.0, [MovePart("setpoint", "LI-1", 2.0), parts[1]], {}, {"FV-3": 20.0})
    assert "FV-3" in stands


def test_a_side_that_hardly_counts_is_not_named() -> None:
    parts = [MovePart("setpoint", "LI-1", 24.0), MovePart("rest", "FV-3", -0.08)]
    assert "FV-3" not in sentence_of(23.9, 100.0, parts, {})
    assert "FV-3" in sentence_of(22.0, 100.0, [parts[0], MovePart("rest", "FV-3", -2.0)], {})


def test_the_words_of_a_rest_follow_its_way(explainer: Explainer) -> None:
    """Of every explained step: the part of an MV's own rest is said plainly only where it points to the rest."""
    inputs, _ = at_rest(explainer, 20)
    operate = Operate(explainer.manifest.operate)
    plain, about = set[bool](), 0
    for rest in np.linspace(-0.9, 0.9, 13):
        for sp in (0.0, 0.4, -0.4):
            values = operate.with_values({"u0.rest": rest, "u0.rest_use": 1})
            found = explainer.explain(**{**inputs, "sp": inputs["sp"] + sp, "operate": values}).move("u0")
            part = next((p for p in found.parts if p.cause == "rest"), None)
            if part is None or "u0 to its resting value" not in found.sentence:
                continue
            about += 1
            towards = part.value * (rest - inputs["mv_applied"][0]) > 0
            assert ("u0 to its resting value, first" in found.sentence) is not towards
            plain.add(towards)
    assert about
    assert True in plain


def test_an_mv_is_at_a_limit_only_where_it_stands_there_or_its_next_move_ends_there(explainer: Explainer) -> None:
    """Of every limit that the plan meets: now or next, or later, and then when, as the planned course has it."""
    inputs, _ = at_rest(explainer, 20)
    operate, seen = Operate(explainer.manifest.operate), {"now": 0, "later": 0}
    for high in (0.15, 0.3, 0.6):
        for most in (0.02, 0.1, 1.0):
            for sp in (0.3, -0.3):
                ends = {
                    f"u{i}.{what}": v
                    for i in (0, 1)
                    for what, v in (("high", high), ("low", -high), ("max_move", most))
                }
                found = explainer.explain(**{**inputs, "sp": inputs["sp"] + sp, "operate": operate.with_values(ends)})
                for move in found.moves:
                    for part in (p for p in move.parts if p.cause in ("mv_low", "mv_high")):
                        course, limit = found.course(part.signal), high if part.cause == "mv_high" else -high
                        at = [abs(v - limit) <= 2e-6 for v in course.values]
                        stands = inputs["mv_applied"][int(part.signal[1])]
                        when = 0.0 if abs(stands - limit) <= 2e-6 else course.times_s[at.index(True)]
                        assert part.in_s == when
                        seen["later" if when else "now"] += 1
                        said = move.sentence.count(f"{part.signal} at its"), move.sentence.count(f"{part.signal} will")
                        assert said[0 if when else 1] == 0
    assert min(seen.values()) > 3, seen
