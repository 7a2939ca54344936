"""From DVC's cached results to the store: one MLflow run for each stage result that it lacks."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from mlflow import MlflowClient
from mlflow.entities import Dataset, DatasetInput, InputTag, Metric, Param, Run
from mlflow.utils.time import get_current_time_millis

from loopwright.pipeline.evaluation.leaderboard import withheld_in
from loopwright.pipeline.evaluation.validation import FILE, Validation
from loopwright.pipeline.files import sha256
from loopwright.pipeline.tracking.notes import curves, experiment_note, headline, of_gate, run_note, table
from loopwright.pipeline.tracking.registry import describe, elect_champion, register, withdraw
from loopwright.pipeline.tracking.signing import Signer
from loopwright.pipeline.tracking.stage_results import StageResult, StageTimes, dataset_hash, datasets, read_lock
from loopwright.pipeline.tracking.store import experiment_id, hide_default, store

KEY_TAG = "stage_key"
ARTIFACTS = {".png", ".json", ".html", ".md", ".onnx"}
LARGEST_ARTIFACT = 5_000_000
"""Bytes; records and trajectories stay where DVC keeps them, named by the dataset hash."""
FIGURES = {"metrics.json", "validation.json", "sweep.json"}
TABLE = "figures.json"
NOTE_TAG, TABLES_TAG = "mlflow.note.content", "mlflow.loggedArtifacts"
PARAMS_A_CALL, PARAM_CHARACTERS, DIGEST_CHARACTERS = 100, 6000, 36  # mlflow's limits


def git_commit(root: Path) -> str:
    """The commit that the working tree stands on; "unknown" without git."""
    command = ["git", "-C", str(root), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=20).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def published(client: MlflowClient, experiment: str) -> dict[str, Run]:
    """The finished runs of an experiment by stage key.

    A run that was being written when the publisher was killed is deleted, and so written again.
    """
    finished: dict[str, Run] = {}
    token: str | None = None
    while True:
        page = client.search_runs([experiment], max_results=1000, page_token=token)
        for run in page:
            if run.info.status == "FINISHED":
                finished[run.data.tags.get(KEY_TAG, "")] = run
            elif KEY_TAG in run.data.tags:
                client.delete_run(run.info.run_id)
        token = page.token
        if not token:
            return finished


def write_run(
    client: MlflowClient,
    experiment: str,
    result: StageResult,
    root: Path,
    records: Mapping[str, str],
    validation: Validation | None,
    tags: Mapping[str, str],
) -> str:
    """Write the run of one stage result; its status turns to FINISHED last. Returns the run's id.

    Start and end are the stage's. ``records`` are the data that it descends from: path -> content hash.
    """
    times = StageTimes.of(result, root)
    files = list(result.files(root))
    trees = {path.name: _read(path) for path, folder in files if not folder and path.name in FIGURES}
    rows = table(trees)
    own = {KEY_TAG: result.key, "stage": result.kind, "dvc_stage": result.name, "mlflow.source.name": result.cmd}
    own[NOTE_TAG] = run_note(result, str(result.case), validation, times)
    own |= {f"out.{_name(path)}": md5 for path, md5 in result.outs.items()}
    if rows:
        own[TABLES_TAG] = json.dumps([{"path": TABLE, "type": "table"}])
    run_name = result.kind if result.kind == "report" else f"{result.kind} {result.item}"
    run = client.create_run(experiment, start_time=times.start_ms, run_name=run_name, tags={**own, **tags})
    run_id = str(run.info.run_id)
    params = [Param(_name(k), _text(v)) for k, v in result.params.items()]
    own_figures, sweep = trees.get("metrics.json", {}), trees.get("sweep.json", {})
    points = [(name, 0, value) for name, value in headline(result.kind, own_figures, validation).items()]
    points += curves(own_figures, sweep)
    metrics = [Metric(_name(name), value, times.end_ms, step) for name, step, value in points]
    for start in range(0, max(len(params), 1), PARAMS_A_CALL):
        client.log_batch(run_id, params=params[start : start + PARAMS_A_CALL], metrics=metrics if start == 0 else [])
    if records:
        client.log_inputs(run_id, [_dataset(*record, result, root) for record in records.items()])
    for path, folder in files:
        if path.suffix in ARTIFACTS and path.stat().st_size <= LARGEST_ARTIFACT:
            client.log_artifact(run_id, str(path), folder)
    if rows:
        client.log_text(run_id, json.dumps({"columns": ["figure", "value"], "data": rows}), TABLE)
    client.set_terminated(run_id, "FINISHED", times.end_ms)
    return run_id


def refresh(client: MlflowClient, run: Run, law: str, validation: Validation | None) -> None:
    """Write the score of a validation anew where the report has changed it since the run was written."""
    figures = of_gate(law, validation)
    now = get_current_time_millis()
    changed = [Metric(k, v, now, 0) for k, v in figures.items() if run.data.metrics.get(k) != v]
    if changed:
        client.log_batch(run.info.run_id, metrics=changed)


def describe_experiment(client: MlflowClient, experiment: str, note: str) -> None:
    """Put the note on the experiment's page, unless it stands there."""
    if client.get_experiment(experiment).tags.get(NOTE_TAG) != note:
        client.set_experiment_tag(experiment, NOTE_TAG, note)


def _dataset(path: str, digest: str, result: StageResult, root: Path) -> DatasetInput:
    """A record as MLflow's data set; the run that made it says so."""
    at = PurePosixPath(path)
    rows = headline("excite", _read(root / at / "metrics.json"), None).get("rows")
    dataset = Dataset(
        name=at.stem,
        digest=digest.removesuffix(".dir")[:DIGEST_CHARACTERS],
        source_type="local",
        source=json.dumps({"uri": path}),
        profile=None if rows is None else json.dumps({"num_rows": int(rows)}),
    )
    context = "made here" if path in result.outs else "training"
    return DatasetInput(dataset, [InputTag(key="mlflow.data.context", value=context)])


def _name(text: str) -> str:
    """``text`` with the characters that mlflow refuses in a name (such as the = of "r=2.5") replaced."""
    return re.sub(r"[^\w\-. /]", "_", text)[:250]


def _text(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= PARAM_CHARACTERS else text[: PARAM_CHARACTERS - 1] + "…"


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def publish(root: Path) -> dict[str, Any]:
    """Publish every stage result of ``root/dvc.lock`` that the store lacks; returns the receipt.

    The receipt names what the store now holds by content (stage keys, controller digests), not by
    run ids, so it is the same after a deleted store was rebuilt. A result whose files on disk are
    not those of dvc.lock (a stage that was killed, a case that never ran here) is left out; one line
    counts these by case.

    Where the environment names a key (see ``loopwright.pipeline.tracking.signing``), it signs the controllers.

    Raises TrackingError where there is no dvc.lock or the store does not answer, SignatureError where the key cannot
    be used.
    """
    results, signer = read_lock(root), Signer.configured()
    by_case: dict[str, list[StageResult]] = {}
    for result in (r for r in results if r.case is not None and r.is_current(root)):
        by_case.setdefault(str(result.case), []).append(result)
    if by_case:
        if left := Counter(str(r.case) for r in results if r.case is not None and r not in by_case.get(r.case, [])):
            stages = ", ".join(f"{n} of {case}" for case, n in left.items())
            _say(
                f"left out, their files are not those of dvc.lock (`loopwright run` makes them anew): stages, {stages}"
            )
    else:
        _say(
            "nothing to publish: the results of dvc.lock are not here, as in a fresh clone; `loopwright run` makes them"
        )
    receipt: dict[str, Any] = {"stages": {r.name: r.key for own in by_case.values() for r in own}, "controllers": {}}
    with store() as client:
        for case, own in by_case.items():
            receipt["controllers"] |= _publish_case(client, case, own, results, root, signer)
        hide_default(client)
    return receipt


def _publish_case(
    client: MlflowClient,
    case: str,
    own: list[StageResult],
    results: list[StageResult],
    root: Path,
    signer: Signer | None,
) -> dict[str, str]:
    """Publish a case's own results; returns registered model -> digest of its file."""
    experiment = experiment_id(client, case)
    known = published(client, experiment)
    evidence = root / "artifacts" / case / FILE
    validation = Validation.read(evidence) if evidence.exists() else None
    common = {"git_commit": git_commit(root)}
    records = {result.name: datasets(result, results) for result in own}
    tags = {name: common | {"dataset_sha256": dataset_hash(data)} for name, data in records.items()}
    runs = {key: str(run.info.run_id) for key, run in known.items()}
    new = [result for result in own if result.key not in runs]
    for number, result in enumerate(own, 1):
        if result.key not in runs:
            marks = {"case": case, **tags[result.name]}
            runs[result.key] = write_run(client, experiment, result, root, records[result.name], validation, marks)
            _say(f"[{number}/{len(own)}] {case}: run {result.name}")
    digests, made = {}, 0
    for result in own:
        for path in result.controllers(root):
            run_id, law = runs[result.key], path.stem
            if result.key in known:
                refresh(client, known[result.key], law, validation)
            picture = _add_picture(client, run_id, evidence.parent / "figures" / f"closed_loop_{law}.png")
            operated = {}
            for drawn in sorted((evidence.parent / "figures").glob(f"operated_{law}_*.png")):
                client.log_artifact(run_id, str(drawn), "operated")
                operated[drawn.stem.removeprefix(f"operated_{law}_")] = f"operated/{drawn.name}"
            marks = {**tags[result.name], "stage_key": result.key}
            line, is_new = register(client, case, path, run_id, validation, picture, marks, signer, operated)
            made += is_new
            _say(line)
            digests[f"{case}-{law}"] = sha256(path)
    for law, why in withheld_in(evidence.parent).items():
        if line := withdraw(client, f"{case}-{law}", why):
            _say(line)
    champion = elect_champion(client, case)
    describe(client, case, validation, champion)
    describe_experiment(client, experiment, experiment_note(case, validation, champion))
    _say(f"{case}: {len(new)} new runs of {len(own)}, {made} new versions; champion: {champion or 'none'}")
    return digests


def _add_picture(client: MlflowClient, run_id: str, picture: Path) -> str | None:
    """The law's closed loop, drawn by the report, beside the controller that its run made."""
    if not picture.exists():
        return None
    with TemporaryDirectory() as draft:
        target = Path(draft) / "closed_loop.png"
        target.write_bytes(picture.read_bytes())
        client.log_artifact(run_id, str(target))
    return target.name


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
