"""The benchmark on public records: reads files in their published layout, and scores a free run."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from benchmark_modules import benchmark_script
from scipy.io import savemat


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return benchmark_script("identification")


def lag(u: np.ndarray, seed: int) -> np.ndarray:
    x, y = 0.0, np.empty(len(u))
    for k, push in enumerate(u):
        y[k] = x
        x += 0.2 * (2 * push - x)
    return y + 0.01 * np.random.default_rng(seed).normal(size=len(u))


def test_a_folder_without_records_is_no_success(
    benchmark: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert benchmark.main([str(tmp_path)]) == 1
    with pytest.raises(SystemExit) as raised:
        benchmark.main([str(tmp_path / "nothing")])
    assert raised.value.code == 2
    assert "is no folder" in capsys.readouterr().err


def test_a_short_column_of_a_csv_ends_where_its_cells_do(benchmark: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    path = tmp_path / "deep" / "databenchmark.CSV"
    path.write_text('"uEst","yEst","Ts",\n1.5,2,4,\n-1e-3,3,,\n')
    found = benchmark.found(tmp_path, "dataBenchmark")
    assert found == path
    read = benchmark.columns(found)
    assert {name: values.tolist() for name, values in read.items()} == {
        "uEst": [1.5, -0.001],
        "yEst": [2, 3],
        "Ts": [4],
    }


def test_each_record_is_cut_as_its_docstring_says(benchmark: ModuleType, tmp_path: Path) -> None:
    rows = {"DATAUNIF": 500, "WienerHammerBenchMark": 188_000, "SNLS80mV": 131_072, "DATA_EMPS": 24_841}
    names = {"DATAUNIF": ("u11", "z11", "u12", "z12"), "WienerHammerBenchMark": ("uBenchMark", "yBenchMark"),
             "SNLS80mV": ("V1", "V2"), "DATA_EMPS": ("vir", "qm")}  # fmt: skip
    tasks = {}
    for record, public in benchmark.RECORDS.items():
        if record == "tanks":
            continue
        file = public.files[0]
        savemat(tmp_path / f"{file}.mat", {n: np.arange(float(rows[file]))[:, None] for n in names[file]})
        read = benchmark.columns(benchmark.found(tmp_path, file))
        tasks[record] = public.task([read] * len(public.files))
    lengths = {name: (len(t.learn.u), *(len(p.u) for p in t.tests.values())) for name, t in tasks.items()}
    assert lengths == {
        "drives_low": (400, 100), "drives_high": (400, 100), "emps": (2485, 2485),
        "wiener_hammerstein": (100_000, 78_800), "silverbox": (65_062, 21_688, 40_475),
    }  # fmt: skip
    assert tasks["silverbox"].learn.u[0] == 40_650
    assert tasks["silverbox"].tests["arrow"].u[0] == 100


def test_a_row_shows_the_error_of_the_free_run(
    benchmark: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    u = np.repeat(np.random.default_rng(0).uniform(0, 1, (2, 60)), 10, axis=1)
    columns = np.column_stack([u[0], u[1], lag(u[0], 1), lag(u[1], 2)])
    np.savetxt(tmp_path / "dataBenchmark.csv", columns, delimiter=",", header="uEst,uVal,yEst,yVal", comments="")
    assert benchmark.main([str(tmp_path), "tanks", "emps", "--minutes", "0.01"]) == 0
    _, row, missing = capsys.readouterr().out.splitlines()
    assert row.startswith("tanks")
    assert float(row.split("test: ")[1].split(",")[0]) == pytest.approx(0.01, rel=0.2)
    assert "DATA_EMPS and DATA_EMPS_PULSES .csv or .mat not found" in missing


def test_a_velocity_is_summed_up_again(benchmark: ModuleType) -> None:
    part = benchmark.Part(np.arange(4.0), np.array([1.0, 3.0, 6.0, 10.0]))
    differences = benchmark.velocity(part)
    assert differences.y.tolist() == [2, 3, 4]
    assert differences.u.tolist() == [0, 1, 2]
