"""No MV leaves its range or its rate by the plain C's guard, whatever samples, requests and states it gets."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from kits import CASES
from operated_law import ENTRIES, FASTEST, PLANT, OperatedLaw
from plain_c_fuzz import by_intervals, fuzzer, histories, jumps

from loopwright.pipeline.export.gate import export

if shutil.which("gcc") is None:
    pytest.skip("no C compiler is installed (Debian: apt install gcc)", allow_module_level=True)

SCANS = 20_000
PID = next(case / "pid.onnx" for case in CASES if (case / "pid.onnx").exists())


@pytest.fixture(scope="module")
def steered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A law that reads ``operate`` and ``fresh``, whose MVs have rates."""
    signals = replace(PLANT, mv=tuple(replace(s, max_move=FASTEST) for s in PLANT.mv))
    path = tmp_path_factory.mktemp("steered") / "law.onnx"
    export(OperatedLaw(ENTRIES, signals).eval(), path, case="plant", provenance={})
    return path


def test_random_histories_of_a_shipped_file(tmp_path: Path) -> None:
    counts, said = histories(fuzzer(PID, tmp_path / "c"), SCANS, seed=1)
    assert counts, said  # no sanitizer ended it
    assert counts["wrong"] == 0, said
    assert counts["written"] > counts["held"] > SCANS // 50  # the histories reach both


def test_random_histories_of_a_law_that_operators_steer(steered: Path, tmp_path: Path) -> None:
    counts, said = histories(fuzzer(steered, tmp_path / "c"), SCANS, seed=2)
    assert counts, said
    assert counts["wrong"] == 0, said
    assert counts["written"] > counts["held"] > SCANS // 50
    assert jumps(said) > 0


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("size_of(way) > most)", "size_of(way) > 9.0 * most)"),  # an MV by hand as fast as it likes
        ("if (!mv_may_be(k, mv[k], 0.0))", "if (!mv_may_be(k, mv[k], 0.5))"),  # an MV by hand beyond its range
        ("(good_one || !l->is_read);", "1;"),  # an MV by hand that jumps after a read-back that was bad
        ("if (!placed(l) || ", "if (!placed(l) || 0 * (int)"),  # what others command is not followed
    ],
)
def test_a_guard_without_a_check_is_found(steered: Path, tmp_path: Path, old: str, new: str) -> None:
    counts, _ = histories(fuzzer(steered, tmp_path / "c", "-O1", old, new), 10 * SCANS, seed=3)
    assert counts["wrong"] > 0


def test_the_state_does_not_drift(tmp_path: Path) -> None:
    counts, said = histories(fuzzer(PID, tmp_path / "c", "-O2"), 1_000_000, 4, "drift")
    assert counts["written"] == 1_000_000
    assert "off by 0\n" in said


@pytest.mark.skipif(shutil.which("frama-c") is None, reason="Frama-C is not installed (Debian: frama-c-base)")
def test_intervals_prove_the_range(steered: Path, tmp_path: Path) -> None:
    proven, open_, said = by_intervals(steered, tmp_path / "c")
    assert proven == 5, said
    assert open_ == 0, said
