"""The store and the registry, on made-up stage results in a folder of their own."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import made_up_case as made_up
import numpy as np
import pytest
from made_up_case import CASE

from pipeline.errors import TrackingError
from pipeline.evaluation.validation import Validation
from pipeline.tracking.__main__ import main
from pipeline.tracking.gate import Gate
from pipeline.tracking.lock import dataset_hash, is_current, read_lock
from pipeline.tracking.publish import publish
from pipeline.tracking.registry import file_digest, versions
from pipeline.tracking.store import store

pytestmark = [
    # SQLAlchemy's complaint about a loader that mlflow's own tables use
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:sqlalchemy.exc.SADeprecationWarning"),
    # mlflow's complaint, at import, about its own type hints
    pytest.mark.filterwarnings("ignore:.*Any type hint is inferred as AnyType:UserWarning"),
]

LAWS = {"pid": {"kind": "pid"}, "inverse_dob": {"kind": "inverse_dob", "gain": 0.7}}
SCORES = {"pid": 1.4, "inverse_dob": 1.1}


def write_evidence(root: Path, *args, **kwargs) -> None:
    made_up.write_json(root / "artifacts" / CASE / "validation.json", made_up.evidence(*args, **kwargs))


@pytest.fixture(scope="module")
def empty_store(tmp_path_factory) -> Path:
    """A store made from nothing, once: mlflow takes seconds to lay its tables."""
    folder = tmp_path_factory.mktemp("store")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        with store() as client:
            assert not client.search_registered_models()
    return folder / "mlflow.db"


@pytest.fixture
def root(tmp_path, monkeypatch, empty_store) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    shutil.copy(empty_store, tmp_path)
    made_up.write_case(tmp_path, {law: made_up.QUALITY[law] for law in LAWS})
    made_up.write_lock(tmp_path, LAWS)
    write_evidence(tmp_path, SCORES)
    evidence = tmp_path / "artifacts" / CASE / "validation.json"
    tree = json.loads(evidence.read_text())
    analysis = {"base": {"figures": {"spectral_radius": 0.93}, "notes": ["Not <proved>."]}}
    tree["laws"]["inverse_dob"]["analysis"] = analysis
    made_up.write_json(evidence, tree)
    picture = tmp_path / "artifacts" / CASE / "figures" / "closed_loop_pid.png"
    picture.parent.mkdir()
    picture.write_bytes(b"\x89PNG made up")
    return tmp_path


def holders(client, alias: str) -> dict[str, str]:
    """Registered model -> version that holds the alias."""
    names = [m.name for m in client.search_registered_models()]
    return {n: v.version for n in names for v in versions(client, n) if alias in v.aliases}


def test_a_store_is_filled_once_and_rebuilt_from_nothing(root, empty_store, monkeypatch, capsys):
    first = publish(root)
    assert set(first["stages"]) == {s.name for s in read_lock(root)}
    assert set(first["controllers"]) == {f"{CASE}-pid", f"{CASE}-inverse_dob"}
    capsys.readouterr()
    assert publish(root) == first
    assert "0 new runs of 4, 0 new versions" in capsys.readouterr().err

    with store() as client:
        experiment = client.get_experiment_by_name(CASE)
        runs = {r.data.tags["dvc_stage"]: r for r in client.search_runs([experiment.experiment_id])}
        assert len(runs) == 4
        fit = runs[f"fit@{CASE}-one_step"]
        assert fit.data.params == {f"models.{CASE}-one_step.kind": "rbf", f"models.{CASE}-one_step.c": "88"}
        assert fit.data.metrics["parts.inverse.median.centres"] == 725
        sweep = client.get_metric_history(fit.info.run_id, "sweep.validation.rmse")
        assert [m.step for m in sweep] == list(range(4, 101, 8))
        history = client.get_metric_history(fit.info.run_id, "parts.inverse.per_seed.0.history")
        assert [m.value for m in history] == [30.0, 22.0, 18.0]
        validate = runs[f"validate@{CASE}-inverse_dob"]
        assert validate.data.metrics["scenarios.sp_a.median.mae"] == pytest.approx(0.064 * 1.12)
        assert validate.data.tags["case"] == CASE
        assert validate.data.tags["stage"] == "validate"
        assert validate.data.tags["dataset_sha256"] == fit.data.tags["dataset_sha256"] != "none"
        assert runs[f"validate@{CASE}-pid"].data.tags["dataset_sha256"] == "none"
        assert {f.path for f in client.list_artifacts(validate.info.run_id)} >= {"inverse_dob.onnx", "metrics.json"}

        version = versions(client, f"{CASE}-inverse_dob")[0]
        assert version.tags["sha256"] == first["controllers"][f"{CASE}-inverse_dob"]
        assert version.tags["gate_score"] == "1.1"
        assert "<table>" in version.description
        assert "|" not in version.description
        assert version.tags["analysis_spectral_radius"] == "0.93"
        assert "spectral radius" in version.description
        assert "Not &lt;proved&gt;." in version.description
        pid = versions(client, f"{CASE}-pid")[0]
        assert f'src="get-artifact?path=closed_loop.png&run_uuid={pid.run_id}"' in pid.description
        assert "<img" not in version.description  # no picture was drawn of it
        assert holders(client, "champion") == {f"{CASE}-pid": 1, f"{CASE}-inverse_dob": 1}
        assert holders(client, "case_champion") == {f"{CASE}-inverse_dob": 1}

        import mlflow.pyfunc

        loaded = mlflow.pyfunc.load_model(f"models:/{CASE}-inverse_dob@champion")
        out = loaded.predict({"sp": np.array([0.7]), "pv": np.array([0.5, 300.0])})
        assert out["mv"] == pytest.approx([20.0])

    shutil.copy(empty_store, root / "rebuilt.db")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{root / 'rebuilt.db'}")
    assert publish(root) == first
    with store() as client:
        assert holders(client, "case_champion") == {f"{CASE}-inverse_dob": 1}

    # a run that was being written when its publisher was killed is written again
    with store() as client:
        experiment = client.get_experiment_by_name(CASE)
        run = client.search_runs([experiment.experiment_id], "tags.stage = 'fit'")[0]
        client.update_run(run.info.run_id, status="RUNNING")
    publish(root)
    with store() as client:
        again = client.search_runs([experiment.experiment_id], "tags.stage = 'fit'")
        assert [r.info.status for r in again] == ["FINISHED"]


def next_version(root: Path, gain: float, **evidence) -> None:
    made_up.write_validation(root, "inverse_dob", made_up.QUALITY["inverse_dob"], gain=gain)
    made_up.write_lock(root, {**LAWS, "inverse_dob": {"kind": "inverse_dob", "gain": gain}})
    write_evidence(root, **evidence)
    publish(root)


def test_the_champion_falls_only_to_better_evidence(root, capsys):
    name = f"{CASE}-inverse_dob"
    publish(root)
    next_version(root, 101.0, scores={"pid": 1.4, "inverse_dob": 1.2})
    with store() as client:
        assert holders(client, "candidate")[name] == 2
        assert holders(client, "champion")[name] == 1
        assert "does not beat the champion's 1.1" in versions(client, name)[0].tags["verdict"]
    next_version(root, 102.0, scores={"pid": 1.4, "inverse_dob": 0.9}, gate_id="another test")
    next_version(root, 103.0, scores={"pid": 1.4, "inverse_dob": 1.0}, lock_ups={"inverse_dob": 1})
    next_version(root, 104.0, scores={"pid": 1.0, "inverse_dob": 1.05})
    with store() as client:
        assert holders(client, "champion")[name] == 1
    next_version(root, 105.0, scores={"pid": 1.4, "inverse_dob": 1.05})
    with store() as client:
        assert holders(client, "champion")[name] == 6

    # by hand, and out again
    assert main(["promote", name, "2"]) == 0
    with store() as client:
        assert holders(client, "champion")[name] == 2
        assert client.get_model_version(name, "2").tags["promoted_by"] == "hand"
    capsys.readouterr()
    assert main(["fetch", f"{name}/6", "out"]) == 0
    assert main(["fetch", CASE, "best"]) == 0
    assert file_digest(root / "out" / "inverse_dob.onnx") == file_digest(root / "artifacts" / CASE / "inverse_dob.onnx")
    assert json.loads((root / "out" / "inverse_dob.json").read_text())["law"] == "inverse_dob"
    assert (root / "best" / "inverse_dob.onnx").exists()
    assert main(["list"]) == 0
    assert "@candidate" in capsys.readouterr().out

    def refused(*argv: str) -> str:
        assert main(argv) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    assert f"did you mean '{name}'" in refused("fetch", f"{CASE}-inverse_dop", "out")
    assert "has no version 9" in refused("promote", name, "9")
    assert "has no alias 'best'" in refused("fetch", f"{name}@best", "out")
    assert "refused" in refused("promote", name, "1", "--alias", "latest")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert f"port {port} of 127.0.0.1 is taken" in refused("serve", "--port", port)
    with store() as client:
        run = client.get_model_version(name, "6").run_id
    stored = root / "mlruns" / CASE / run / "artifacts" / "inverse_dob.onnx"
    stored.write_bytes(b"tampered")
    assert "is not the file that was registered" in refused("fetch", f"{name}/6", "out")


@pytest.mark.parametrize(
    ("law", "scores", "lock_ups", "reason"),
    [
        ("inverse_dob", {"pid": 1.4, "inverse_dob": 1.1}, {}, None),
        ("pid", {"pid": 1.4}, {}, None),
        ("inverse_dob", {"pid": 1.4, "inverse_dob": 1.4}, {}, "does not beat the PID's"),
        ("inverse_dob", {"inverse_dob": 1.1}, {}, "no PID"),
        ("inverse_dob", {"pid": 1.4, "inverse_dob": 1.1}, {"inverse_dob": 2}, "locked up in 2"),
        ("pid", {"pid": 1.4}, {"pid": 1}, "locked up"),
        ("incad", {"pid": 1.4}, {}, "no gate score"),
    ],
)
def test_who_may_become_champion(law, scores, lock_ups, reason, tmp_path):
    path = tmp_path / "validation.json"
    made_up.write_json(path, made_up.evidence(scores, lock_ups))
    refusal = Gate.of(Validation.read(path), law).refusal()
    assert (refusal is None) if reason is None else (reason in refusal)


def test_a_result_is_known_by_its_inputs_only(root):
    before = {s.name: s for s in read_lock(root)}
    made_up.write_lock(root, {**LAWS, "inverse_dob": {"kind": "inverse_dob", "gain": 0.8}})
    after = {s.name: s for s in read_lock(root)}
    changed = {name for name in before if before[name].key != after[name].key}
    assert changed == {f"validate@{CASE}-inverse_dob"}
    assert all(s.case == CASE for s in after.values())
    fit = after[f"fit@{CASE}-one_step"]
    (root / "work" / CASE / "records" / "steps" / "seed0.csv").write_text("other")
    made_up.write_lock(root, LAWS)
    results = read_lock(root)
    assert dataset_hash(next(s for s in results if s.name == fit.name), results) != dataset_hash(fit, after.values())


def test_files_that_are_not_the_locks_are_left_out(root, capsys):
    (root / "work" / CASE / "validation" / "inverse_dob" / "metrics.json").write_text("{half")
    stage = next(s for s in read_lock(root) if s.name.endswith("inverse_dob"))
    assert not is_current(stage, root)
    receipt = publish(root)
    assert stage.name not in receipt["stages"]
    assert f"left out {stage.name}" in capsys.readouterr().err


def test_outputs_are_hashed_as_dvc_does(tmp_path):
    write = "from pathlib import Path; p = Path('out/b'); p.mkdir(parents=True); (p / 'x').write_text('1'); "
    write += "Path('out/b.txt').write_text('2'); Path('out/B').write_text('3'); Path('single').write_text('4')"
    (tmp_path / "make.py").write_text(write)
    stage = {"cmd": f'"{sys.executable}" make.py', "deps": ["make.py"], "outs": ["out", {"single": {"cache": False}}]}
    (tmp_path / "dvc.yaml").write_text(json.dumps({"stages": {"make": stage}}))
    for command in (["init", "-q", "--no-scm"], ["repro", "-q"]):
        subprocess.run([sys.executable, "-m", "dvc", *command], cwd=tmp_path, check=True, timeout=120)
    (result,) = read_lock(tmp_path)
    assert set(result.outs) == {"out", "single"}
    assert is_current(result, tmp_path)
    (tmp_path / "out" / "b" / "x").write_text("5")
    assert not is_current(result, tmp_path)


def test_what_is_wrong_with_the_store_takes_one_line_and_seconds(root, monkeypatch):
    (root / "mlflow.db").write_bytes(b"this is no database, whatever its name says" * 100)
    with pytest.raises(TrackingError, match="move it away"):
        publish(root)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    with pytest.raises(TrackingError, match="is its server running"):
        publish(root)
    (root / "dvc.lock").unlink()
    with pytest.raises(TrackingError, match="run `dvc repro` first"):
        publish(root)
    (root / "dvc.lock").write_text("- not a lock")
    with pytest.raises(TrackingError, match="not a lock file"):
        publish(root)
