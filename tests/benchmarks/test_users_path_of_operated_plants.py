"""The users' path of the plants under ranges and costs: the file, the table of tags, and what is made of an outcome."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_modules import FOLDER, benchmark_modules

from loopwright.pipeline.commands.own_plant.operator_ranges import OperatorDefaults
from loopwright.pipeline.historian.cleaning.tags import named, read_tags, safe_name

MODULES = (
    "_project", "operated_plant", "pid_blocks", "figures", "separating", "mixing", "heating", "moving", "from_record",
    "perfect_economic", "contest", "users_run",
)  # fmt: skip
PLANTS = {
    "separating": ("COLUMN", "EVAPORATOR"), "mixing": ("TANK", "BLENDER"), "heating": ("FURNACE", "EXCHANGER"),
    "moving": ("PUMPS", "REACTOR"),
}  # fmt: skip
EIGHT = [(module, name) for module, names in PLANTS.items() for name in names]


@pytest.fixture(scope="module")
def own() -> Any:
    return benchmark_modules(MODULES, FOLDER / "operated_plants")


@pytest.mark.parametrize(("module", "name"), EIGHT)
def test_the_table_says_what_operators_have_set(own: Any, tmp_path: Path, module: str, name: str) -> None:
    plant = getattr(getattr(own, module), name)
    own.users_run.write_tags(plant, tmp_path / "tags.csv")
    tags = read_tags(tmp_path / "tags.csv")  # raises for a mistake
    of_pv, of_mv = ([t for t in tags if t.role == role] for role in ("pv", "mv"))
    assert [t.tag for t in of_pv] == [s.name for s in plant.pv]
    assert [t.constraint for t in of_pv] == [i >= len(plant.sp) for i in range(len(plant.pv))]
    assert [t.analyser for t in of_pv] == [i in plant.every for i in range(len(plant.pv))]
    for tag, signal in zip(of_mv, plant.mv, strict=True):
        assert tag.max_move_per_min * own.operated_plant.PERIOD_S / 60 == pytest.approx(signal.max_move)
    # Operators' limits of an MV are its range of commands; all else is a default of `operate`.
    limits = {f"{s.name}.{end}" for s in plant.mv for end in ("low", "high")}
    record = own.from_record.record_of(plant, 300)
    found = OperatorDefaults.of(record, named(tags)).defaults
    assert found is not None
    wanted = {safe_name(key): value for key, value in plant.operate.items() if key not in limits}
    assert {key: found[key] for key in wanted} == wanted
    ends = {safe_name(f"{s.name}.{end}"): getattr(s, end) for s in plant.pv for end in ("low", "high")}
    assert all(value == ends[key] for key, value in found.items() if key not in wanted)
    for tag, low, high in zip(of_mv, *plant.mv_ends(), strict=True):
        assert (tag.command_low, tag.command_high) in {(low, high), (None, None)}
    limited = {key.split(".")[0] for key in limits & set(plant.operate)}
    assert {t.tag for t in of_mv if t.command_high is not None} == limited


def test_an_analysers_number_stands_until_the_next(own: Any, tmp_path: Path) -> None:
    plant, rows = own.mixing.BLENDER, 130
    own.users_run.write_rows(plant, rows, tmp_path / "x" / "blender.csv")
    with (tmp_path / "x" / "blender.csv").open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert [*table[0]] == ["Timestamp", "QI", "FI", "VP", "best", "middle", "cheap"]
    seldom, often = (np.array([float(row[name]) for row in table]) for name in ("QI", "FI"))
    assert (np.flatnonzero(np.diff(seldom)) + 1).tolist() == [20, 40, 60, 80, 100, 120]
    assert (np.diff(often) != 0).mean() > 0.9
    np.testing.assert_allclose(seldom[::20], own.from_record.record_of(plant, rows).pv[::20, 0], rtol=1e-5)


@pytest.fixture
def made(own: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Any]]:
    """Stands in for `new` and `run`: what they said and shipped, and the calls that were made."""

    def put(**outcome: Any) -> list[Any]:
        calls: list[Any] = []

        def new_and_run(project: Path, name: str, files: Any, options: Any) -> Any:
            calls.append((project, name, [f.name for f in files], options))
            (project / "artifacts" / name).mkdir(parents=True)
            return own._project.UsersRun(
                **{"said": [], "files": {}, "seconds": 60.0, "added": True, "ended": True, **outcome}
            )

        monkeypatch.setattr(own.users_run, "new_and_run", new_and_run)
        return calls

    return put


def test_a_plant_that_is_refused_says_why(own: Any, made: Any, tmp_path: Path) -> None:
    plant = own.heating.EXCHANGER
    made(said=["$ new", "a", "b", "the record has no moves"], added=False, ended=False)
    found = own.users_run.users_result(plant, 40, [1], 60, tmp_path)
    assert found.figures is None
    assert found.why == ["a", "b", "the record has no moves"]
    bound = own.figures.Figures(1.0, 100.0, 0.0, 0.0, 0.5, 2.0)
    lines = own.users_run.users_row(plant, found, bound).splitlines()
    assert sum("the record has no moves" in line for line in lines) == 1
    assert [line.split()[0] for line in lines[-1:]] == ["NMPC"]


def test_what_came_is_kept_until_the_product_changes(
    own: Any, made: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant, steps = own.heating.EXCHANGER, []
    calls = made(files={"pid": tmp_path / "pid.onnx", "predictive": tmp_path / "predictive.onnx"})
    figures = own.figures.Figures(1.0, 100.0, 0.0, 0.0, 0.5, 2.0)

    def stepped(of: Any, file: Path, days: Any) -> Any:
        steps.append((of.name, file, len(days), len(days[0].sp)))
        return figures

    monkeypatch.setattr(own.users_run, "users_figures", stepped)
    for _ in range(2):
        found = own.users_run.users_result(plant, 40, [1, 2], 60, tmp_path)
        assert found.figures == figures
    assert len(calls) == 1
    project, name, files, options = calls[0]
    assert files == ["exchanger.csv", "exchanger-tags.csv"]
    assert options == ["--tags", "exchanger-tags.csv", "--period", "180"]
    assert steps[0] == ("exchanger", project / "artifacts" / name / "predictive.onnx", 2, 60)
    monkeypatch.setattr(own.users_run, "product_digest", lambda: "another")
    own.users_run.users_result(plant, 40, [1], 60, tmp_path)
    assert len(calls) == 2
    assert calls[1][0] != project


def test_a_file_of_other_signals_is_not_stepped(own: Any) -> None:
    other = FOLDER.parent / "artifacts" / "thiosulfate_cstr" / "pid.onnx"
    with pytest.raises(RuntimeError, match="pv is"):
        own.users_run.users_figures(own.heating.EXCHANGER, other, [])


def test_a_project_takes_no_folder_that_is_one(own: Any, tmp_path: Path) -> None:
    (tmp_path / ".dvc").mkdir()
    (tmp_path / "mine.txt").write_text("kept")
    with pytest.raises(FileExistsError):
        own._project.fresh_project(tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "kept"
