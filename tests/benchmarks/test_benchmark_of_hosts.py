"""The benchmark of the hosts: what is missing is named, what is wrong shows in the table and in the status."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pytest
from kits import ROOT, another_mv, spoilt

FILE = ROOT / "benchmarks" / "hosts.py"
PID = ROOT / "artifacts" / "reversible_cstr" / "pid.onnx"


@pytest.fixture
def hosts(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_of_hosts", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(__import__("sys").modules, spec.name, module)
    spec.loader.exec_module(module)
    monkeypatch.setattr("sys.argv", ["hosts.py", str(PID)])
    monkeypatch.setattr(module, "ROUNDS", 1)
    return module


def test_python_passes_and_a_missing_host_is_named(
    hosts: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @contextmanager
    def missing(folder: Path) -> Iterator[None]:
        raise FileNotFoundError("its parts")
        yield

    monkeypatch.setattr(hosts, "HOSTS", {"Python": hosts.python_host, "other": missing})
    assert hosts.main() == 0
    said = capsys.readouterr()
    assert "other is left out: its parts" in said.err
    rows = [line.split(" | ") for line in said.out.splitlines() if line.startswith("| Python")]
    assert rows[0][2:7] == ["1 of 1", "1", "1", "0", "0"]
    megabytes = float(rows[0][-1].strip(" |"))
    assert 50 < megabytes < 500
    assert "`reversible_cstr/pid`" in said.out


def test_a_host_that_differs_or_does_not_load_fails(
    hosts: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    wrong = json.loads((spoilt(PID, tmp_path / "kit", another_mv) / "vectors.json").read_text())

    @contextmanager
    def differs(folder: Path) -> Iterator[object]:
        def run(kit: Path, out: Path) -> None:
            steps = [row.get("gives", {"refused": row.get("refused")}) for row in wrong["steps"]]
            answers = {"sha256": wrong["sha256"], "p50_us": 1.0, "scans": wrong["scans"]}
            out.write_text(json.dumps(answers | {"steps": steps, "chained": steps}))

        yield run, 0

    @contextmanager
    def broken(folder: Path) -> Iterator[object]:
        def run(kit: Path, out: Path) -> None:
            raise RuntimeError("no such operator")

        yield run, 0

    monkeypatch.setattr(hosts, "HOSTS", {"differs": differs})
    assert hosts.main() == 1
    assert "1, 1e-03, 1e-03 FAILED" in capsys.readouterr().out
    monkeypatch.setattr(hosts, "HOSTS", {"broken": broken})
    assert hosts.main() == 1
    said = capsys.readouterr()
    assert "no such operator" in said.err
    assert "not loaded" in said.out
