"""The benchmark of identification: reads public files, makes records with known truth, and scores a free run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_modules import benchmark_modules
from scipy.io import savemat

from loopwright.pipeline.models.identified.dynamics import Dynamics

MODULES = ("_free_run", "_made_records", "_public_records", "_users_path", "identification")
NOISE = {"made_tanks": 0.02, "made_drive": 0.02, "made_friction": 0.02, "made_duffing": 0.2}  # in the unit of figures


@pytest.fixture(scope="module")
def parts() -> Any:
    return benchmark_modules(MODULES)


def lag(u: np.ndarray, seed: int = 0, noise: float = 0.0, x: float = 0.0) -> np.ndarray:
    """Output (n,) of x(k+1) = .8 x + .4 u."""
    y = np.empty(len(u))
    for k, push in enumerate(u):
        y[k] = x
        x += 0.2 * (2 * push - x)
    return y + noise * np.random.default_rng(seed).normal(size=len(u))


def steps(seed: int, rows: int = 600) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-1, 1, rows // 10), 10)


# ---------------------------------------------------------------------- public files
def test_without_a_record_there_is_no_success(parts: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert parts.identification.main(["--data", str(tmp_path), "--only", "tanks", "emps"]) == 1
    assert "emps: DATA_EMPS, DATA_EMPS_PULSES (.csv or .mat): not under" in capsys.readouterr().out
    with pytest.raises(SystemExit) as raised:
        parts.identification.main(["--data", str(tmp_path / "nothing")])
    assert raised.value.code == 2
    assert "is no folder" in capsys.readouterr().err


def test_a_short_column_of_a_csv_ends_where_its_cells_do(parts: Any, tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    path = tmp_path / "deep" / "databenchmark.CSV"
    path.write_text('"uEst","yEst","Ts",\n1.5,2,4,\n-1e-3,3,,\n')
    found = parts._public_records.file_of(tmp_path, "dataBenchmark")
    assert found == path
    read = parts._public_records.columns(found)
    assert {n: v.tolist() for n, v in read.items()} == {"uEst": [1.5, -0.001], "yEst": [2, 3], "Ts": [4]}


def test_each_record_is_cut_as_its_docstring_says(parts: Any, tmp_path: Path) -> None:
    rows = {"DATAUNIF": 500, "WienerHammerBenchMark": 188_000, "SNLS80mV": 131_072,
            "DATA_EMPS": 24_841, "DATA_EMPS_PULSES": 24_841}  # fmt: skip
    names = {"DATAUNIF": ("u11", "z11", "u12", "z12"), "WienerHammerBenchMark": ("uBenchMark", "yBenchMark"),
             "SNLS80mV": ("V1", "V2"), "DATA_EMPS": ("vir", "qm"), "DATA_EMPS_PULSES": ("vir", "qm")}  # fmt: skip
    for file, n in rows.items():
        savemat(tmp_path / f"{file}.mat", {name: np.arange(float(n))[:, None] for name in names[file]})
    wanted = {
        "drives_low": (400, 100), "drives_high": (400, 100), "emps": (2485, 2485),
        "wiener_hammerstein": (100_000, 78_800), "silverbox": (65_062, 21_688, 40_475),
    }  # fmt: skip
    tasks = {name: parts._public_records.public_task(tmp_path, name) for name in wanted}
    assert {n: (len(t.learn.u), *(len(p.u) for p in t.tests.values())) for n, t in tasks.items()} == wanted
    assert tasks["silverbox"].learn.u[0] == 40_650
    assert tasks["silverbox"].tests["arrow"].u[0] == 100
    assert parts._public_records.public_task(tmp_path, "tanks") is None


# ---------------------------------------------------------------------- made records
@pytest.mark.parametrize("name", ["made_tanks", "made_drive", "made_friction", "made_duffing", "made_bouc_wen"])
def test_a_made_record_is_its_truth_and_noise_and_the_same_seed_gives_it_again(parts: Any, name: str) -> None:
    make, _, like = parts.identification.MADE[name]
    task, again, other = (make(seed, rows=400) for seed in (1, 1, 2))
    assert like
    for part, same in zip((task.learn, *task.tests.values()), (again.learn, *again.tests.values()), strict=True):
        assert len(part.u) == len(part.y) == len(part.true) > task.begin
        np.testing.assert_array_equal(part.y, same.y)
        assert np.all(np.isfinite(part.y))
    assert not np.array_equal(task.learn.u, other.learn.u)
    for part in task.tests.values():
        error = parts.identification.error_of(part.true, part, task)
        assert error == pytest.approx(NOISE.get(name, 0.0), rel=0.25)


def test_a_record_of_the_usual_length_is_as_long_as_the_public_one(parts: Any) -> None:
    made = parts.identification.MADE
    tasks = {name: made[name][0](0) for name in ("made_tanks", "made_drive", "made_friction")}
    lengths = {name: {len(part.y) for part in (task.learn, *task.tests.values())} for name, task in tasks.items()}
    assert lengths == {"made_tanks": {1024}, "made_drive": {400, 100}, "made_friction": {2485}}
    assert np.mean(tasks["made_tanks"].learn.true == 10) > 0.02
    assert tasks["made_tanks"].learn.y.max() == 10
    assert tasks["made_drive"].learn.true.min() >= 0


def test_the_steps_of_the_oscillators_are_exact_to_the_fourth_order(parts: Any) -> None:
    u = np.zeros(101 * 8)

    def error(fine: int) -> float:
        y = parts._made_records.integrated(lambda x, u: (x[1], u - x[0]), (1.0, 0.0), u[: 101 * fine], fine, 0.4)
        return float(np.abs(y - np.cos(0.4 * np.arange(100))).max())

    assert error(2) / error(4) == pytest.approx(16, rel=0.1)


def test_friction_holds_the_sledge_where_the_force_is_small(parts: Any) -> None:
    task = parts.identification.MADE["made_friction"][0](0)
    still = np.diff(task.learn.true) == 0
    assert still.any()
    assert np.abs(task.learn.u[:-1][still] + 3.2).max() <= 20.4
    assert np.abs(task.learn.u[:-1][~still] + 3.2).max() > 60


# ---------------------------------------------------------------------- the rule
def predictor(parts: Any) -> Any:
    return parts.identification.Predictor(
        Dynamics.linear(np.array([[0.8]]), np.array([[0.4]])), (0.0, 1.0), (0.0, 1.0), False, "the plant"
    )


def test_the_plants_own_model_has_the_error_of_the_noise_and_sees_the_first_rows_alone(parts: Any) -> None:
    free, u = parts._free_run, steps(0)
    part, learn = free.Part(u, lag(u, 1, 0.01, x=0.7)), free.Part(steps(2), lag(steps(2), 3, 0.01))
    task = free.Task(learn, {"test": part}, 5, 1.0, scale=1000.0)
    run = predictor(parts).free_run(part, 5, learn)
    assert free.error_of(run, part, task) == pytest.approx(10, rel=0.15)
    later = part.y.copy()
    later[5:] = 99.0
    np.testing.assert_array_equal(predictor(parts).free_run(free.Part(u, later), 5, learn), run)


def test_rows_that_fit_the_initial_state_do_not_count(parts: Any) -> None:
    free, y = parts._free_run, np.zeros(20)
    task = free.Task(free.Part(y, y), {"test": free.Part(y, y)}, 4, 1.0)
    assert free.error_of(np.r_[np.full(4, 9.0), np.full(16, 0.5)], task.tests["test"], task) == pytest.approx(0.5)


def test_the_initial_state_is_the_most_likely_one_of_the_first_rows(parts: Any) -> None:
    """x = m + C O' (O C O' + s^2 I)^-1 (y - O m) for two rows of a model without input, m and C from learning."""
    free, a = parts._free_run, np.array([[0.5, 0.5], [-0.5, 0.8]])
    model = parts.identification.Predictor(
        Dynamics.linear(a, np.zeros((2, 1))), (0.0, 1.0), (0.0, 1.0), False, "the plant"
    )
    states = [np.array([1.0, 2.0])]
    for _ in range(30):
        states.append(a @ states[-1])
    x = np.array(states)
    learn = free.Part(np.zeros(31), x[:, 0] + 0.1 * np.random.default_rng(0).normal(size=31))
    known = np.array([model.free_run(learn, 31, learn)])[0]
    y, o = np.array([0.3, -0.2]), np.array([[1.0, 0.0], [0.5, 0.5]])
    run = model.free_run(free.Part(np.zeros(2), y), 2, learn)
    # The free run over the rows to learn begins where all of them say, near the truth.
    c, m = np.cov(x, rowvar=False), x.mean(axis=0)
    s2 = np.mean((known - learn.y) ** 2)
    expected = o @ (m + c @ o.T @ np.linalg.solve(o @ c @ o.T + s2 * np.eye(2), y - o @ m))
    np.testing.assert_allclose(run, expected, atol=0.02)


def test_the_linear_baseline_of_a_linear_plant_has_the_error_of_the_noise(parts: Any) -> None:
    free, u, v = parts._free_run, steps(5), steps(6)
    task = free.Task(free.Part(u, lag(u, 1, 0.02)), {"test": free.Part(v, lag(v, 2, 0.02), lag(v))}, 5, 1.0)
    entry = parts.identification.Entry("plant", task, "V", {"test": parts.identification.Published(".588", ".306")})
    found = parts.identification.Found("yes", {"test": [0.25, None]}, [1.0, 2.0])
    (row,) = parts.identification.rows_of(entry, found)
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:2] == ["plant", "V"]
    assert [float(cell) for cell in cells[2:4]] == pytest.approx([0.02, 0.02], rel=0.15)
    assert cells[4:] == ["0.25 / no model", "1.5", "yes", ".588", ".306", "-"]


# ---------------------------------------------------------------------- the product's words
def test_a_refusal_is_told_with_its_words_and_anyway_is_asked_next(
    parts: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []

    def run(self: Any, *words: str) -> tuple[int, list[str]]:
        asked.append(words)
        if words[1] == "run":
            return 2, ["the search found nothing"]
        said = ["can these data carry a model: no", "loopwright new: p was not added to params.yaml: too few moves"]
        return (0, said[:1]) if "--anyway" in words else (2, said)

    project_type = parts._users_path.Project
    monkeypatch.setattr(project_type, "_run", run)
    project, free = project_type(tmp_path / "project"), parts._free_run
    (tmp_path / "project" / "params.yaml").write_text(
        "models:\n  p-identified:\n    case: p\n    data: x\n    parts:\n"
    )
    rows = free.Part(steps(0), lag(steps(0)))
    entry = parts.identification.Entry("p", free.Task(rows, {"test": rows}, 5, 2.0), "V", {}, keep=True)
    found = parts.identification.found_of(entry, project, [0])
    assert found.says == "refused: too few moves"
    assert found.errors == {"test": [None]}
    assert [words[1] for words in asked] == ["new", "new", "run"]
    assert (tmp_path / "project" / "p-tags.csv").read_text() == "tag,role,ends\ny,pv,keep\nu,mv,\n"
    assert "data: work/p/records/screened/record.parquet" in (tmp_path / "project" / "params.yaml").read_text()
