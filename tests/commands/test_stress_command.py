"""``loopwright stress``: its report, its replay, and what it refuses in one line."""

from __future__ import annotations

import shutil
from html import unescape
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from undrawn import draw_nothing

from loopwright.pipeline.__main__ import main

ROOT = Path(__file__).parents[2]
PH = ROOT / "artifacts/ph_neutralization/pid.onnx"


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / ".cache"))  # of the compiled law


def test_the_report_names_the_worst_and_how_to_run_them_again(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stress", str(PH), "--plants", "30", "--seed", "5", "--workers", "1", "--out", "out"]) == 0
    page = Path("out/report.md").read_text(encoding="utf-8")
    rows = pq.read_table("out/plants.parquet")
    assert rows.num_rows == 30
    commands = [line for line in page.splitlines() if line.startswith("loopwright stress")]
    assert len(commands) == 10
    assert all(line.endswith(" --seed 5") for line in commands)
    capsys.readouterr()
    assert main([*commands[0].split()[1:], "--out", "again"]) == 0
    index = int(commands[0].split()[4])
    said = capsys.readouterr().out
    sse = rows.to_pylist()[index]["figure.sse"]
    assert ["SSE", f"{sse:.6g}"] in [line.split() for line in said.splitlines()]
    assert f"loop {index} of seed 5" in said
    assert Path(f"again/ph_neutralization-pid-stress-{index}.png").exists()
    assert Path(f"out/figures/loop_{index}.png").exists()
    html = Path("out/report.html").read_text(encoding="utf-8")
    assert "{{" not in html
    assert html.count("loopwright stress") == 10


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--plants", "0"], "'0' is not allowed; give a whole number of at least 1"),
        (["--plants", "many"], "'many' is not allowed"),
        (["--seed", "-1"], "'-1' is not allowed"),
        (["--faults", "101"], "'101' is not allowed; give a percentage from 0 to 100"),
        (["--spread", "nan"], "'nan' is not allowed"),
        (["--law-by", "java"], "invalid choice"),
        (["--operate", "u.high"], "'u.high' is not of the form NAME=VALUE"),
    ],
)
def test_what_is_no_number_is_refused(options: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["stress", str(PH), *options])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (Debian: apt install gcc)")
def test_loops_by_plain_c_are_those_by_onnxruntime(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    draw_nothing(monkeypatch)
    rows, said = {}, {}
    for law_by in ("onnx", "c", "auto"):
        options = ["--plants", "20", "--seed", "3", "--out", law_by, "--law-by", law_by]
        assert main(["stress", str(PH), *options]) == 0
        (said[law_by],) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("law stepped by ")]
        table = pq.read_table(f"{law_by}/plants.parquet")
        stepped_by = table.schema.metadata[b"loopwright.stepped_by"].decode()
        assert said[law_by] == f"law stepped by {stepped_by}"
        pages = [unescape(Path(law_by, f"report.{kind}").read_text("utf-8")) for kind in ("md", "html")]
        assert all(stepped_by in page for page in pages)
        assert all((f" --law-by {law_by}" in page) == (law_by != "auto") for page in pages)
        rows[law_by] = table.to_pylist()
    assert said["onnx"].startswith("law stepped by onnxruntime ")
    assert said["c"] == said["auto"]
    assert said["c"].startswith("law stepped by plain C, ")
    assert rows["c"] == rows["auto"]
    assert rows["c"] != rows["onnx"]  # last digits: else onnxruntime has stepped both
    for one, other in zip(rows["c"], rows["onnx"], strict=True):
        numbers = {name for name, value in one.items() if isinstance(value, float)}
        assert {name: one[name] for name in numbers} == pytest.approx({n: other[n] for n in numbers}, rel=1e-9)
        assert {k: v for k, v in one.items() if k not in numbers} == {k: other[k] for k in other if k not in numbers}


def test_without_a_compiler_onnxruntime_steps_and_c_is_one_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    draw_nothing(monkeypatch)
    monkeypatch.setenv("CC", "no-such-compiler")
    assert main(["stress", str(PH), "--plants", "2", "--out", "out"]) == 0
    assert "law stepped by onnxruntime " in capsys.readouterr().out
    assert main(["stress", str(PH), "--plants", "2", "--out", "none", "--law-by", "c"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("loopwright stress: no C compiler is installed: CC names 'no-such-compiler'")
    assert error.count("\n") == 1
    assert not Path("none").exists()


def test_a_law_that_operators_do_not_steer_takes_no_operate(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stress", str(PH), "--operate", "u.high=1"]) == 2
    assert capsys.readouterr().err.startswith("loopwright stress: operate has no entry 'u.high'")
    assert not list(Path().iterdir())


def test_a_file_that_is_no_controller_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    Path("foreign.onnx").write_bytes(b"not a graph")
    assert main(["stress", "foreign.onnx"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("loopwright stress: foreign.onnx: ")
    assert said.count("\n") == 1
    assert main(["stress", "nowhere.onnx"]) == 2
    assert "nowhere.onnx: the file cannot be read" in capsys.readouterr().err


def test_a_controller_of_no_case_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(PH, "pid.onnx")
    monkeypatch.setattr("loopwright.pipeline.commands.arguments.all_cases", dict)
    assert main(["stress", "pid.onnx"]) == 2
    assert "the controller is for 'ph_neutralization', which is no case here" in capsys.readouterr().err


def test_a_report_takes_the_place_of_another_one_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    draw_nothing(monkeypatch)
    Path("taken").write_text("mine")
    assert main(["stress", str(PH), "--plants", "2", "--out", "taken"]) == 2
    assert capsys.readouterr().err == "loopwright stress: taken is no folder; name one by --out\n"
    Path("mine").mkdir()
    Path("mine/report.html").write_text("mine")
    assert main(["stress", str(PH), "--plants", "2", "--out", "mine"]) == 2
    assert "mine holds a report of something else; name another folder" in capsys.readouterr().err
    assert Path("mine/report.html").read_text() == "mine"
    for plants, seed in (("12", "1"), ("3", "2")):
        assert main(["stress", str(PH), "--plants", plants, "--seed", seed, "--out", "out"]) == 0
    assert {p.name for p in Path("out/figures").glob("loop_*.png")} == {f"loop_{i}.png" for i in range(3)}
