"""``loopwright``: every command tells what it takes, and what cannot be is one line and status 2."""

from __future__ import annotations

import dataclasses
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.commands import COMMANDS, OneLineParser, loaded
from loopwright.pipeline.commands.parameters import texts, type_of
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.models import MODELS
from loopwright.serving.arguments import write_any_text

ROOT = Path(__file__).parents[2]
COMMANDS_OF_TODAY = {
    "new", "run", "check", "results", "simulate", "stress", "certify", "inspect", "bench", "laws", "models",
    "bounds", "registry",
    "loop", "plant", "keygen", "sign", "verify", "conformance", "c", "st", "fmu", "playground",
}  # fmt: skip


def test_the_commands_are_these() -> None:
    assert set(COMMANDS) == COMMANDS_OF_TODAY
    for name in COMMANDS:
        command = loaded(name)
        assert callable(command.options)
        assert callable(command.run)


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_every_command_tells_what_it_takes(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    if name:
        with pytest.raises(SystemExit) as end:
            main([name, "--help"])
        assert end.value.code == 0
    else:
        assert main([]) == main(["--help"]) == 0
    told = capsys.readouterr().out
    assert told.startswith(f"usage: loopwright {name or 'COMMAND'}")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["simulat"], "unknown command 'simulat'; did you mean 'simulate'?"),
        (["inspect", "none.onnx"], "none.onnx: the file cannot be read"),
        (["bench", "none.onnx"], "none.onnx: the file cannot be read"),
        (["conformance", "none.onnx", "kit"], "none.onnx: the file cannot be read"),
        (["results", "--artifacts", "nowhere"], "nowhere holds no results"),
        (["laws", "pidd"], "loopwright laws: unknown law 'pidd'; did you mean 'pid'?"),
        (["models", "rbff"], "loopwright models: unknown kind of model 'rbff'; did you mean 'rbf'?"),
        (["bounds", "nowhere"], "loopwright bounds: unknown case 'nowhere'"),
        (["check"], "params.yaml is not here"),
        (["run"], "params.yaml is not here"),
    ],
)
def test_what_cannot_be_is_one_line(
    arguments: list[str],
    says: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert "Traceback" not in error


def test_options_that_cannot_be_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["results", "--nonsense"])
    assert end.value.code == 2
    assert capsys.readouterr().err == "loopwright results: unrecognized arguments: --nonsense\n"


@pytest.mark.parametrize("kind", ["laws", "models"])
def test_lists_name_every_member(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([kind]) == 0
    listed = {line.split()[0] for line in capsys.readouterr().out.splitlines()}
    assert listed == set(LAWS if kind == "laws" else MODELS)


@pytest.mark.parametrize("law", LAWS)
def test_every_parameter_of_a_law_is_shown_and_explained(law: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["laws", law]) == 0
    told, params = capsys.readouterr().out, LAWS[law].Params
    words = " ".join(texts(params))
    for field in dataclasses.fields(params):
        assert f"\n{field.name} " in told, field.name
        assert field.name in words, f"{law}: the docstring of its parameters says nothing of {field.name}"
    shown = told.partition("parts of the model set:")[2]
    assert [line.split()[0] for line in shown.splitlines()[1:]] == list(LAWS[law].parts)
    assert LAWS[law].parts or "none" in shown


@pytest.mark.parametrize("kind", MODELS)
def test_every_parameter_of_a_model_is_shown_and_explained(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models", kind]) == 0
    told, words = capsys.readouterr().out, " ".join(texts(MODELS[kind]))
    for field in dataclasses.fields(MODELS[kind]):
        assert f"\n{field.name} " in told, field.name
        assert field.name in words, f"{kind}: the docstring says nothing of {field.name}"


def test_help_loads_no_library_of_the_work() -> None:
    code = """import sys
from loopwright.pipeline.__main__ import main
main([])
sys.exit(len({'torch', 'casadi', 'mlflow'} & set(sys.modules)))
"""
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, timeout=60).returncode == 0


def test_the_type_of_a_parameter_does_not_depend_on_how_its_module_reads_annotations() -> None:
    at_once = dataclasses.make_dataclass("AtOnce", [("a", float), ("b", float | None), ("c", tuple[float, ...])])
    put_off = dataclasses.make_dataclass("PutOff", [("a", "float"), ("b", "float | None"), ("c", "tuple[float, ...]")])
    shown = [[type_of(f) for f in dataclasses.fields(cls)] for cls in (at_once, put_off)]
    assert shown[0] == shown[1] == ["float", "float | None", "tuple[float, ...]"]


def parsed(*words: str) -> dict[str, object]:
    """What a command reads in its words."""
    parser = OneLineParser(prog=words[0])
    loaded(words[0]).options(parser)
    found = vars(parser.parse_args(words[1:]))
    return {key: value for key, value in found.items() if not callable(value)}


@pytest.mark.parametrize(
    ("after", "before"),
    [
        ("new tank a.csv b.csv --pv T --mv u", "new --pv T --mv u tank a.csv b.csv"),
        ("new tank a.csv b.csv --pv T --mv u", "new tank --pv T a.csv --mv u b.csv"),
        ("new tank a.csv --period 5 --anyway", "new --anyway tank --period=5 a.csv"),
        ("new tank a.csv --time-format %d", "new --time-f %d tank a.csv"),
        ("verify pid.onnx --key a.pub", "verify --key a.pub pid.onnx"),
        ("verify pid.onnx --key a.pub b.pub", "verify --key a.pub b.pub pid.onnx"),
        ("verify pid.onnx --key a.pub --signature s", "verify --signature s --key a.pub pid.onnx"),
        ("verify pid.onnx --key a.pub --signature s", "verify --key a.pub --signature s pid.onnx"),
        ("inspect pid.onnx --json --key a.pub", "inspect --key a.pub pid.onnx --json"),
        ("registry fetch tank out --key a.pub", "registry fetch --key a.pub tank out"),
        ("registry fetch tank out --key a.pub b.pub", "registry fetch tank --key a.pub b.pub out"),
        ("loop sp T=1 F=-2 --who anna", "loop sp --who anna T=1 F=-2"),
        ("loop sp T=1 F=2 --who anna", "loop sp T=1 --who anna F=2"),
        ("loop swap pid.onnx --trial 5", "loop swap --trial 5 pid.onnx"),
        ("loop run my.toml --scans 5", "loop run --scans 5 my.toml"),
        ("loop mode AUTO --accept-unproven", "loop mode --accept-unproven AUTO"),
        ("run a b --dry", "run --dry a b"),
        ("sign a.onnx b.onnx --key k", "sign --key k a.onnx b.onnx"),
        ("sign a.onnx b.onnx --key k", "sign a.onnx --key k b.onnx"),
        ("bounds tank --scenario a --scenario b --jobs 2", "bounds --scenario a --jobs 2 --scenario b tank"),
        ("conformance pid.onnx kit --check a.json", "conformance --check a.json pid.onnx kit"),
        ("conformance pid.onnx kit --check a.json", "conformance pid.onnx --check a.json kit"),
    ],
)
def test_options_stand_before_the_files_or_behind_them(after: str, before: str) -> None:
    assert parsed(*before.split()) == parsed(*after.split())


@pytest.mark.parametrize(
    "words", ["verify --key a.pub", "new --pv", "new", "inspect --jsn x.onnx", "loop sp --who anna"]
)
def test_what_is_missing_is_one_line(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        parsed(*words.split())
    assert end.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_stream_spells_out_what_its_encoding_lacks(encoding: str) -> None:
    """The words of the product hold degrees, arrows, and whatever a signal is called."""
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding=encoding)
    write_any_text([stream])
    stream.write("T [°C] → 3 × 温度")
    stream.flush()
    assert raw.getvalue().isascii() == (encoding == "ascii")
    assert b"\\u2192" in raw.getvalue()


@pytest.mark.parametrize("module", ["pipeline", "serving"])
def test_a_command_runs_where_the_streams_are_ascii(module: str) -> None:
    command = [
        sys.executable,
        "-m",
        module,
        "inspect",
        str(ROOT / "artifacts" / "jacketed_batch_reactor" / "fuzzy_feedforward_pi.onnx"),
    ]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONPATH": str(ROOT / "tools/roots")}
    done = subprocess.run(command, env=environment, capture_output=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\xb0C" in done.stdout
