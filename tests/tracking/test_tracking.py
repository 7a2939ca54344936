"""The store and the registry, on made-up stage results in a folder of their own."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import tomllib
from html import unescape
from pathlib import Path

import made_up_case as made_up
import numpy as np
import pytest
from made_up_case import CASE
from mlflow.entities import Run

from loopwright import pipeline
from loopwright.pipeline.__main__ import main as loopwright
from loopwright.pipeline.commands.registry import CHAMPIONS
from loopwright.pipeline.engine.start import DOOR, receipt_path
from loopwright.pipeline.errors import TrackingError
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.files import sha256
from loopwright.pipeline.tracking.gate import Gate
from loopwright.pipeline.tracking.registry import REQUIREMENTS, versions
from loopwright.pipeline.tracking.runs import publish
from loopwright.pipeline.tracking.stage_results import StageResult, StageTimes, dataset_hash, datasets, read_lock
from loopwright.pipeline.tracking.store import store

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


def main(arguments: list[str]) -> int:
    """One of the registry's commands."""
    return loopwright(["registry", *arguments])


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


def test_a_registered_model_asks_for_what_the_package_asks_for() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert sorted(REQUIREMENTS) == sorted(project["dependencies"])


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
        assert [e.name for e in client.search_experiments()] == [CASE]
        experiment = client.get_experiment_by_name(CASE)
        runs = {r.data.tags["dvc_stage"]: r for r in client.search_runs([experiment.experiment_id])}
        assert len(runs) == 4
        fit = runs[f"fit@{CASE}-one_step"]
        assert fit.data.params == {f"models.{CASE}-one_step.kind": "rbf", f"models.{CASE}-one_step.c": "88"}
        assert fit.data.metrics["centres"] == 725
        sweep = client.get_metric_history(fit.info.run_id, "sweep/validation_rmse")
        assert [m.step for m in sweep] == list(range(4, 101, 8))
        history = client.get_metric_history(fit.info.run_id, "training/inverse")
        assert [m.value for m in history] == [30.0, 22.0, 18.0]
        validate = runs[f"validate@{CASE}-inverse_dob"]
        assert validate.data.metrics["mae/sp_a"] == pytest.approx(0.064 * 1.12)
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
        assert holders(client, "best") == {f"{CASE}-pid": 1, f"{CASE}-inverse_dob": 1}
        assert holders(client, "champion") == {f"{CASE}-inverse_dob": 1}

        import mlflow.pyfunc

        loaded = mlflow.pyfunc.load_model(f"models:/{CASE}-inverse_dob@champion")
        out = loaded.predict({"sp": np.array([0.7]), "pv": np.array([0.5, 300.0])})
        assert out["mv"] == pytest.approx([20.0])

    shutil.copy(empty_store, root / "rebuilt.db")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{root / 'rebuilt.db'}")
    assert publish(root) == first
    with store() as client:
        assert holders(client, "champion") == {f"{CASE}-inverse_dob": 1}

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


def test_the_best_version_falls_only_to_better_evidence(root, capsys):
    name = f"{CASE}-inverse_dob"
    publish(root)
    next_version(root, 101.0, scores={"pid": 1.4, "inverse_dob": 1.2})
    with store() as client:
        assert holders(client, "candidate")[name] == 2
        assert holders(client, "best")[name] == 1
        assert "does not beat the best version's 1.1" in versions(client, name)[0].tags["verdict"]
    next_version(root, 102.0, scores={"pid": 1.4, "inverse_dob": 0.9}, gate_id="another test")
    next_version(root, 103.0, scores={"pid": 1.4, "inverse_dob": 1.0}, lock_ups={"inverse_dob": 1})
    next_version(root, 104.0, scores={"pid": 1.0, "inverse_dob": 1.05})
    with store() as client:
        assert holders(client, "best")[name] == 1
    next_version(root, 105.0, scores={"pid": 1.4, "inverse_dob": 1.05})
    with store() as client:
        assert holders(client, "best")[name] == 6

    # by hand, and out again
    assert main(["promote", name, "2", "--alias", "best"]) == 0
    with store() as client:
        assert holders(client, "best")[name] == 2
        assert client.get_model_version(name, "2").tags["promoted_by"] == "hand"
    capsys.readouterr()
    assert main(["fetch", f"{name}/6", "out"]) == 0
    assert main(["fetch", CASE, "best"]) == 0
    assert sha256(root / "out" / "inverse_dob.onnx") == sha256(root / "artifacts" / CASE / "inverse_dob.onnx")
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
    assert "has no alias 'newest'" in refused("fetch", f"{name}@newest", "out")
    assert "refused" in refused("promote", name, "1", "--alias", "latest")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert f"port {port} of 127.0.0.1 is taken" in refused("serve", "--port", port)
    with store() as client:
        run = client.get_model_version(name, "6").run_id
    stored = root / "mlruns" / CASE / run / "artifacts" / "inverse_dob.onnx"
    manifest = stored.with_suffix(".json")
    text = manifest.read_text()
    row = json.loads(text)
    row["mv"][0]["high"] = 450.0
    for forged in (json.dumps(row), text.replace('"high":', '"high": 450.0, "high":', 1), "{}", "no JSON"):
        manifest.write_text(forged)
        assert "is not the manifest of inverse_dob.onnx" in refused("fetch", f"{name}/6", "forged")
    assert not (root / "forged").exists()
    manifest.write_text(text)
    assert main(["fetch", f"{name}/6", "forged"]) == 0
    capsys.readouterr()
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
def test_who_passes_the_gate(law, scores, lock_ups, reason, tmp_path):
    path = tmp_path / "validation.json"
    made_up.write_json(path, made_up.evidence(scores, lock_ups))
    refusal = Gate.of(Validation.read(path), law).refusal()
    assert (refusal is None) if reason is None else (reason in refusal)


def test_without_a_baseline_the_best_other_law_is_champion_and_its_page_says_why(root, capsys):
    name = f"{CASE}-inverse_dob"
    folder = root / "artifacts" / CASE
    (folder / "pid.onnx").unlink()
    made_up.write_json(folder / "pid.json", {"withheld": "its <gains> have no inverse"})
    made_up.write_json(folder / "validation.json", made_up.evidence({"inverse_dob": 1.1}))
    publish(root)
    with store() as client:  # it is missing, and nothing says why
        assert holders(client, "champion") == {}
    tree = made_up.evidence({"inverse_dob": 1.1, "incad": 1.0}, {"incad": 1})
    tree["gate"]["no_baseline"] = "its <gains> have no inverse"
    made_up.write_json(folder / "validation.json", tree)
    publish(root)
    with store() as client:
        assert holders(client, "champion") == {name: 1}
        model, (version,) = client.get_registered_model(name), versions(client, name)
        assert version.description.startswith(
            "Gate score 1.100 (1 = perfect-model NMPC), no lock-up. "
            "There was no PID to beat, because its &lt;gains&gt; have no inverse.\n"
        )
        assert "There was no PID to beat, because its &lt;gains&gt; have no inverse." in model.description
        assert version.tags["gate_no_baseline"] == "its <gains> have no inverse"
    # All else is still asked of it.
    validation = Validation.read(folder / "validation.json")
    assert Gate.of(validation, "incad").refusal() == "it locked up in 1 of its closed loops"
    assert Gate.of(validation, "rest").refusal() == "its validation has no gate score"


def test_a_score_over_the_pid_s_error_is_never_called_one_over_the_bound(root, capsys):
    folder = root / "artifacts" / CASE
    tree = made_up.evidence({"inverse_dob": 0.8, "pid": 1.0})
    tree["gate"]["relative_to"], tree["bounds"] = "baseline", {}
    made_up.write_json(folder / "validation.json", tree)
    publish(root)
    name = f"{CASE}-inverse_dob"
    with store() as client:
        said = unescape(client.get_registered_model(name).description + versions(client, name)[0].description)
        run = runs_of(client)[f"validate@{CASE}-inverse_dob"].data
        assert run.metrics["ratio_to_baseline"] == 0.8
        assert "ratio_to_bound" not in run.metrics
        note = run.tags["mlflow.note.content"]
    assert "0.800 times the PID's error" in said
    assert "Gate score 0.800 (1 = the PID's error, PID 1.000)" in said
    assert "**0.800 times the PID's error.**" in note
    assert "`ratio_to_baseline` is the figure that decides: the error divided by that of the PID" in note
    for text in (said, note):
        assert "the bound" not in text
        assert "perfect" not in text
    capsys.readouterr()
    assert main(["list"]) == 0
    assert "gate 0.8 × PID" in capsys.readouterr().out


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
    now = next(s for s in results if s.name == fit.name)
    assert dataset_hash(datasets(now, results)) != dataset_hash(datasets(fit, after.values()))


def test_files_that_are_not_the_locks_are_left_out(root, capsys):
    (root / "work" / CASE / "validation" / "inverse_dob" / "metrics.json").write_text("{half")
    stage = next(s for s in read_lock(root) if s.name.endswith("inverse_dob"))
    assert not stage.is_current(root)
    receipt = publish(root)
    assert stage.name not in receipt["stages"]
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("left out")]
    assert said == [
        f"left out, their files are not those of dvc.lock (`loopwright run` makes them anew): stages, 1 of {CASE}"
    ]


def test_a_clone_without_results_says_so_in_one_line(root, capsys):
    shutil.rmtree(root / "work")
    assert publish(root)["controllers"] == {}
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].endswith("`loopwright run` makes them")


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
    assert result.is_current(tmp_path)
    (tmp_path / "out" / "b" / "x").write_text("5")
    assert not result.is_current(tmp_path)


def test_what_is_wrong_with_the_store_takes_one_line_and_seconds(root, monkeypatch):
    (root / "mlflow.db").write_bytes(b"this is no database, whatever its name says" * 100)
    with pytest.raises(TrackingError, match="move it away"):
        publish(root)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    with pytest.raises(TrackingError, match="is its server running"):
        publish(root)
    (root / "dvc.lock").unlink()
    with pytest.raises(TrackingError, match="run `loopwright run` first"):
        publish(root)
    (root / "dvc.lock").write_text("- not a lock")
    with pytest.raises(TrackingError, match="not a lock file"):
        publish(root)


def runs_of(client) -> dict[str, Run]:
    """Stage -> its run."""
    experiment = client.get_experiment_by_name(CASE)
    return {r.data.tags["dvc_stage"]: r for r in client.search_runs([experiment.experiment_id])}


def test_a_run_has_the_times_of_its_stage(root):
    fit, excite = f"fit@{CASE}-one_step", f"excite@{CASE}-steps"
    start = 1_700_000_000
    for out in next(s for s in read_lock(root) if s.name == fit).outs:
        for file in (root / out).rglob("*"):
            os.utime(file, (start + 80, start + 80))
    for stage in (fit, excite):  # the files of excite were written after that receipt: it is of another run
        made_up.write_json(receipt_path(root, stage), {"stage": stage, "started": start + 0.5, "seconds": 90.0})
    record = root / "work" / CASE / "records" / "steps" / "seed0.csv"
    publish(root)
    with store() as client:
        runs = runs_of(client)
    assert runs[fit].info.start_time == 1000 * start + 500
    assert runs[fit].info.end_time - runs[fit].info.start_time == 90_000
    assert runs[excite].info.start_time == runs[excite].info.end_time == round(1000 * record.stat().st_mtime)
    assert "duration is not known" in runs[excite].data.tags["mlflow.note.content"]
    assert "duration is not known" not in runs[fit].data.tags["mlflow.note.content"]


def test_a_stage_under_dvc_leaves_a_receipt_that_fits_its_files(tmp_path):
    package, sources = tmp_path / "loopwright" / "pipeline", Path(pipeline.__file__).parent
    for room in ("stages", "engine"):
        (package / room).mkdir(parents=True)
        (package / room / "__init__.py").touch()
    (package / "__init__.py").touch()
    for name in ("start.py", "stage_files.py"):
        shutil.copy(sources / "engine" / name, package / "engine")
    probe = (
        "from pathlib import Path\nimport sys\nPath(sys.argv[1]).write_text('made')\nsys.exit(sys.argv[1] == 'bad')\n"
    )
    (package / "stages" / "probe.py").write_text(probe)
    command = f'"{sys.executable}" -m loopwright.pipeline.engine.start probe'
    stages = {out: {"cmd": f"{command} {out}", "outs": [out]} for out in ("good", "bad")}
    (tmp_path / "dvc.yaml").write_text(json.dumps({"stages": stages}))
    environment = {k: v for k, v in os.environ.items() if k not in {DOOR, "PYTHONPATH"}}
    before = time.time()
    for argv, status in ((["init", "-q", "--no-scm"], 0), (["repro", "-q", "good"], 0), (["repro", "-q", "bad"], 255)):
        done = subprocess.run([sys.executable, "-m", "dvc", *argv], cwd=tmp_path, env=environment, timeout=120)
        assert done.returncode == status
    assert [p.name for p in (tmp_path / "receipts").iterdir()] == ["good.json"]  # none of a stage that failed
    (result,) = read_lock(tmp_path)
    times = StageTimes.of(result, tmp_path)
    assert times.measured
    assert before * 1000 <= times.start_ms <= times.end_ms <= time.time() * 1000


def test_a_run_shows_the_figures_that_matter_and_keeps_all(root):
    publish(root)
    evidence = json.loads((root / "artifacts" / CASE / "validation.json").read_text())
    evidence["gate"]["laws"]["inverse_dob"]["score"] = 1.05
    with store() as client:
        run = runs_of(client)[f"validate@{CASE}-inverse_dob"]
        shown = run.data.metrics
        assert len(shown) <= 12
        assert (shown["data_seeds"], shown["lock_ups"], shown["step_us"]) == (
            len(made_up.SEEDS),
            0,
            evidence["laws"]["inverse_dob"]["step_us"],
        )
        assert shown["ratio_to_bound"] == SCORES["inverse_dob"]
        rows = dict(json.loads(Path(client.download_artifacts(run.info.run_id, "figures.json")).read_text())["data"])
        stored = made_up.spread(0.064 * made_up.QUALITY["inverse_dob"])
        assert rows["forms.base.tests.sp_a.per_seed.2.masse"] == stored["per_seed"]["2"]["masse"]
        assert json.loads(run.data.tags["mlflow.loggedArtifacts"]) == [{"path": "figures.json", "type": "table"}]

        note = run.data.tags["mlflow.note.content"]
        assert "**1.100 times the bound.** It passes the gate." in note
        assert "`mae/…`" in note

    # the report's score of a run that stands in the store already
    made_up.write_json(root / "artifacts" / CASE / "validation.json", evidence)
    publish(root)
    with store() as client:
        assert runs_of(client)[f"validate@{CASE}-inverse_dob"].data.metrics["ratio_to_bound"] == 1.05


def test_a_run_names_the_data_it_learnt_from(root):
    publish(root)
    made = next(md5 for s in read_lock(root) if s.kind == "excite" for md5 in s.outs.values())
    with store() as client:
        inputs = {name: run.inputs.dataset_inputs for name, run in runs_of(client).items()}
    for name, context in ((f"excite@{CASE}-steps", "made here"), (f"validate@{CASE}-inverse_dob", "training")):
        (used,) = inputs[name]
        assert (used.dataset.name, used.dataset.digest) == ("steps", made.removesuffix(".dir"))
        assert [tag.value for tag in used.tags] == [context]
    assert not inputs[f"validate@{CASE}-pid"]  # from no data


def test_a_run_is_named_by_its_stage_whatever_the_order_of_its_outputs():
    outs = {"artifacts/plant/pid_2.json": "1", "artifacts/plant/pid_2.onnx": "2", "work/plant/validation/pid_2": "3"}
    for order in (outs, dict(reversed(outs.items()))):
        assert StageResult("validate@plant-pid_2", "", {}, {}, order).item == "pid_2"


def test_a_stage_that_depends_on_a_folder_descends_from_what_was_made_inside():
    record = StageResult("excite@c-steps", "", {}, {}, {"work/c/records/steps": "1.dir"})
    fit = StageResult("fit@c-net", "", {"work/c/records/steps": "1.dir"}, {}, {"work/c/models/net": "2.dir"})
    report = StageResult("report@c", "", {"work/c/models": "3.dir"}, {}, {"artifacts/c/report.md": "4"})
    assert datasets(report, [record, fit, report]) == {"work/c/records/steps": "1.dir"}


def test_a_case_has_one_champion_and_every_controller_says_where_it_stands(root, capsys):
    pid, inverse = f"{CASE}-pid", f"{CASE}-inverse_dob"
    publish(root)
    with store() as client:
        models = {m.name: m for m in client.search_registered_models()}
        assert models[inverse].tags["standing"] == "champion, 1 of 2"
        assert "CHAMPION: the best of the 2 controllers of its case, 1.100 times" in models[inverse].description
        assert models[pid].tags["standing"] == "2 of 2"
        assert f"The champion is {inverse}." in models[pid].description
        found = client.search_registered_models(CHAMPIONS)  # what the link of `serve` asks
        assert [m.name for m in found] == [inverse]
        note = client.get_experiment_by_name(CASE).tags["mlflow.note.content"]
        assert f"(#/models/{inverse})" in note
    assert main(["list"]) == 0
    assert capsys.readouterr().out.startswith(inverse)

    # the champion falls to another controller, and no controller keeps an old title
    write_evidence(root, {"pid": 1.0, "inverse_dob": 1.1})
    publish(root)
    with store() as client:
        assert holders(client, "champion") == {pid: 1}
        assert "does not pass the gate" in client.get_registered_model(inverse).description

    # a person overrules the gate until a person promotes another one
    assert main(["promote", inverse, "1"]) == 0
    publish(root)
    with store() as client:
        assert holders(client, "champion") == {inverse: 1}
        assert client.get_registered_model(inverse).tags["standing"] == "champion, 2 of 2"
    assert main(["fetch", CASE, "out"]) == 0
    assert (root / "out" / "inverse_dob.onnx").exists()
    assert main(["promote", pid, "1"]) == 0
    with store() as client:
        assert holders(client, "champion") == {pid: 1}
        assert "champion_by" not in client.get_model_version(inverse, "1").tags


def test_a_controller_that_swings_is_champion_of_none_that_does_not(root):
    inverse, pid = f"{CASE}-inverse_dob", f"{CASE}-pid"
    file = root / "artifacts" / CASE / "validation.json"
    tree = json.loads(file.read_text())
    tree["laws"]["inverse_dob"]["swings"] = {"sp_a": {"0": 1}}
    file.write_text(json.dumps(tree))
    publish(root)
    with store() as client:
        assert holders(client, "champion") == {pid: 1}
        assert client.get_model_version(inverse, "1").tags["swings"] == "sp_a (seed 0)"
        assert "SWINGS to the end in sp_a (seed 0)" in client.get_model_version(inverse, "1").description
        assert client.get_registered_model(pid).tags["standing"] == "champion, 1 of 2"
    tree["laws"]["pid"]["swings"] = {"sp_a": {"0": 1}}
    file.write_text(json.dumps(tree))
    publish(root)
    with store() as client:
        assert holders(client, "champion") == {inverse: 1}


def test_a_law_that_the_newest_run_withholds_is_no_champion_any_more(root, capsys):
    pid, inverse = f"{CASE}-pid", f"{CASE}-inverse_dob"
    publish(root)
    folder = root / "artifacts" / CASE
    (folder / "inverse_dob.onnx").unlink()
    made_up.write_json(folder / "inverse_dob.json", {"withheld": "it locked up"})
    publish(root)
    assert f"{inverse} version 1: no longer the best version" in capsys.readouterr().err
    with store() as client:
        assert inverse not in holders(client, "best")
        assert holders(client, "champion") == {pid: 1}
        assert "it locked up" in versions(client, inverse)[0].tags["verdict"]
    # a person's own choice stays
    assert main(["promote", inverse, "1", "--alias", "best"]) == 0
    publish(root)
    with store() as client:
        assert holders(client, "best")[inverse] == 1


def test_the_old_loop_decides_in_every_test_and_a_best_version_that_it_beats_falls(root, capsys):
    inverse = f"{CASE}-inverse_dob"
    publish(root)
    with store() as client:
        assert holders(client, "champion") == {inverse: 1}
    file = root / "artifacts" / CASE / "validation.json"
    tree = json.loads(file.read_text())
    tree["gate"]["laws"]["inverse_dob"]["worse"] = ["sp_a"]  # its score is still below the baseline's
    file.write_text(json.dumps(tree))
    publish(root)
    with store() as client:
        assert inverse not in holders(client, "best")
        assert inverse not in holders(client, "champion")
        version = client.get_model_version(inverse, "1")
        assert version.tags["worse_than_old_loop"] == "sp_a"
        assert "larger than under the old loop in sp_a" in version.tags["verdict"]
    # A person overrules it.
    assert main(["promote", inverse, "1", "--alias", "best"]) == 0
    publish(root)
    with store() as client:
        assert holders(client, "best")[inverse] == 1


def test_a_store_whose_folder_was_moved_or_copied_still_gives_its_files(root, monkeypatch, capsys):
    publish(root)
    copy, moved = root.parent / "a copy", root.parent / "moved"
    shutil.copytree(root, copy)
    first = next((copy / "mlruns").rglob("inverse_dob.onnx"))
    digest = sha256(first)
    next((root / "mlruns").rglob("inverse_dob.onnx")).write_bytes(b"of the original alone")

    def work_in(folder: Path) -> None:
        monkeypatch.chdir(folder)
        monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)  # mlflow keeps the store of this process there

    work_in(copy)
    assert main(["fetch", CASE, "out"]) == 0
    assert sha256(copy / "out" / "inverse_dob.onnx") == digest
    copy.rename(moved)
    work_in(moved)
    assert main(["fetch", CASE, "again"]) == 0
    assert publish(moved)["controllers"][f"{CASE}-inverse_dob"] == digest

    import mlflow.pyfunc

    with store() as client:
        mlflow.pyfunc.load_model(f"models:/{CASE}-inverse_dob@champion")
        for run in runs_of(client).values():
            assert run.info.artifact_uri.startswith(moved.as_uri())

    # the database without its files: they are what is missing, and no file is damaged
    shutil.rmtree(moved / "mlruns")
    capsys.readouterr()
    assert main(["fetch", CASE, "out"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"its file inverse_dob.onnx did not come from {moved.as_uri()}" in line
    assert "damaged" not in line
