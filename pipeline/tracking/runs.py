"""One MLflow run for each stage result: parameters, figures, series, pictures."""

from __future__ import annotations

import json
import math
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mlflow import MlflowClient
from mlflow.entities import Metric, Param, Run, RunTag
from mlflow.utils.time import get_current_time_millis

from pipeline.tracking.lock import StageResult, flat

KEY_TAG = "stage_key"
ARTIFACTS = {".png", ".json", ".html", ".md", ".onnx"}
LARGEST_ARTIFACT = 5_000_000
"""Bytes; records and trajectories stay where DVC keeps them, named by the dataset hash."""
DETAIL = re.compile(r"\bper_seed\b|\bsequences\b|^variants\..*\.(min|max)\b")
"""Figures that stay in the metrics.json artifact: thousands of rows hide the hundred that matter."""
METRICS_A_CALL, PARAMS_A_CALL, PARAM_CHARACTERS = 1000, 100, 6000  # mlflow's limits


def git_commit(root: Path) -> str:
    """The commit that the working tree stands on; "unknown" without git."""
    try:
        found = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=True, timeout=20
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return found.stdout.strip()


def published(client: MlflowClient, experiment: str) -> dict[str, Run]:
    """The finished runs of an experiment by stage key.

    A run that was being written when the publisher was killed is deleted, and so written again.
    """
    found: dict[str, Run] = {}
    token: str | None = None
    while True:
        page = client.search_runs([experiment], max_results=1000, page_token=token)
        for run in page:
            if run.info.status == "FINISHED":
                found[run.data.tags.get(KEY_TAG, "")] = run
            elif KEY_TAG in run.data.tags:
                client.delete_run(run.info.run_id)
        token = page.token
        if not token:
            return found


def write_run(client: MlflowClient, experiment: str, result: StageResult, root: Path, tags: dict[str, str]) -> str:
    """Write the run of one stage result; its status turns to FINISHED last. Returns the run's id."""
    own = {KEY_TAG: result.key, "stage": result.kind, "dvc_stage": result.name, "mlflow.source.name": result.cmd}
    run = client.create_run(experiment, run_name=result.name, tags={**own, **tags})
    run_id = str(run.info.run_id)
    params = [Param(_name(k), _text(v)) for k, v in result.params.items()]
    metrics = list(_metrics(result, root))
    for start in range(0, len(params), PARAMS_A_CALL):
        client.log_batch(run_id, params=params[start : start + PARAMS_A_CALL])
    for start in range(0, len(metrics), METRICS_A_CALL):
        client.log_batch(run_id, metrics=metrics[start : start + METRICS_A_CALL])
    outs = [RunTag(f"out.{_name(path)}", md5) for path, md5 in result.outs.items()]
    client.log_batch(run_id, tags=outs[:PARAMS_A_CALL])
    for path, folder in _artifacts(result, root):
        client.log_artifact(run_id, str(path), folder)
    client.set_terminated(run_id, "FINISHED")
    return run_id


def _name(text: str) -> str:
    """``text`` with the characters that mlflow refuses in a name (such as the = of "r=2.5") replaced."""
    return re.sub(r"[^\w\-. /]", "_", text)[:250]


def _text(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= PARAM_CHARACTERS else text[: PARAM_CHARACTERS - 1] + "…"


def _files(result: StageResult, root: Path) -> Iterator[tuple[Path, str | None]]:
    """Every file of the stage's outputs, and the folder that it lies in, relative to the output."""
    for out in result.outs:
        top = root / out
        if top.is_file():
            yield top, None
            continue
        for path in sorted(p for p in top.rglob("*") if p.is_file()):
            folder = path.parent.relative_to(top).as_posix()
            yield path, None if folder == "." else folder


def _artifacts(result: StageResult, root: Path) -> Iterator[tuple[Path, str | None]]:
    for path, folder in _files(result, root):
        if path.suffix in ARTIFACTS and path.stat().st_size <= LARGEST_ARTIFACT:
            yield path, folder


def _metrics(result: StageResult, root: Path) -> Iterator[Metric]:
    """metrics.json and validation.json flat, lists of numbers as series; sweep.json over its partitions."""
    now = get_current_time_millis()

    def metric(name: str, value: Any, step: int = 0) -> Iterator[Metric]:
        if isinstance(value, bool | int | float) and math.isfinite(value):
            yield Metric(_name(name), float(value), now, step)

    for path, folder in _files(result, root):
        if path.name == "sweep.json":
            for row in json.loads(path.read_text())["rows"]:
                for name, value in flat(row, "sweep").items():
                    yield from metric(name, value, int(row["partitions"]))
        if path.name not in {"metrics.json", "validation.json"}:
            continue
        for name, value in flat(json.loads(path.read_text()), folder or "").items():
            if isinstance(value, list):
                for step, entry in enumerate(value):
                    yield from metric(name, entry, step)
            elif not DETAIL.search(name):
                yield from metric(name, value)
