"""The model registry: a registered model for each controller, a version for each different file."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path

import mlflow
import mlflow.onnx
import numpy as np
import onnx
from mlflow import MlflowClient
from mlflow.entities import LoggedModelOutput
from mlflow.entities.model_registry import ModelVersion
from mlflow.exceptions import MlflowException
from mlflow.models import ModelSignature
from mlflow.types import Schema, TensorSpec

from pipeline.errors import TrackingError
from pipeline.evaluation.validation import Validation
from pipeline.tracking import card
from pipeline.tracking.gate import Gate

CANDIDATE, CHAMPION, CASE_CHAMPION = "candidate", "champion", "case_champion"
REQUIREMENTS = ["onnxruntime>=1.20", "numpy>=2.0"]


def file_digest(path: Path) -> str:
    """sha256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def versions(client: MlflowClient, name: str) -> list[ModelVersion]:
    """All versions of a registered model with their tags and aliases, the newest first."""
    found = client.search_model_versions(f"name = '{name}'", max_results=10_000)
    aliases: dict[str, list[str]] = {}
    for alias, number in (client.get_registered_model(name).aliases if found else {}).items():
        aliases.setdefault(str(number), []).append(alias)
    for version in found:
        version.aliases = sorted(aliases.get(str(version.version), []))
    return sorted(found, key=lambda v: -int(v.version))


def register(
    client: MlflowClient,
    case: str,
    path: Path,
    run_id: str,
    validation: Validation | None,
    picture: str | None,
    tags: Mapping[str, str],
) -> tuple[str, bool]:
    """Register the controller file ``path`` unless its digest is known; refresh its evidence.

    ``picture`` is an artifact of the run. Returns one line that says what happened, and whether a version was made.
    """
    law = path.stem
    name = f"{case}-{law}"
    gate = Gate.of(validation, law)
    digest = file_digest(path)
    if not client.search_registered_models(f"name = '{name}'"):
        client.create_registered_model(name, tags={"case": case, "law": law})
    model = client.get_registered_model(name)
    described = card.model_description(case, law, validation)
    if model.description != described:
        client.update_registered_model(name, described)
    known = next((v for v in versions(client, name) if v.tags.get("sha256") == digest), None)
    manifest = json.loads(path.with_suffix(".json").read_text()) if path.with_suffix(".json").exists() else {}
    own = {
        "sha256": digest,
        "law": law,
        "case": case,
        "plant": str((manifest.get("provenance") or {}).get("plant", case)),
        "period_s": str(manifest.get("period_s", "")),
    }
    description = card.version_description(validation, gate, run_id, picture)
    analysis = {f"analysis_{name}": f"{value:.6g}" for name, value in card.analysis_figures(validation, law).items()}
    tags = {**tags, **own, **gate.tags(), **analysis}
    if known is None:
        number, before = _log(client, name, path, run_id, description, tags), tags
        client.set_registered_model_alias(name, CANDIDATE, number)
    else:
        number, before = str(known.version), dict(known.tags)
        if known.description != description:
            client.update_model_version(name, number, description)
    verdict = _elect(client, name, number, gate)
    # each call is a transaction of its own, so only what differs is written
    for key, value in {**tags, "verdict": verdict}.items():
        if before.get(key) != value:
            client.set_model_version_tag(name, number, key, value)
    return f"{name} version {number}{'' if known else ' (new)'}: {verdict}", known is None


def _log(client: MlflowClient, name: str, path: Path, run_id: str, description: str, tags: Mapping[str, str]) -> str:
    """Store the controller as a model that pyfunc can load; returns the new version's number.

    The model is made here and not by an active run, because log_model would then read every figure
    of the run and write it a second time.
    """
    model = onnx.load(path)
    run = client.get_run(run_id)
    made = client.create_logged_model(run.info.experiment_id, name=name, source_run_id=run_id)
    info = mlflow.onnx.log_model(
        model,
        model_id=made.model_id,
        signature=ModelSignature(_schema(model.graph.input), _schema(model.graph.output)),
        save_as_external_data=False,
        onnx_execution_providers=["CPUExecutionProvider"],
        pip_requirements=REQUIREMENTS,
    )
    client.log_outputs(run_id, [LoggedModelOutput(made.model_id, step=0)])
    version = client.create_model_version(
        name, info.model_uri, run_id=run_id, model_id=info.model_id, description=description, tags=dict(tags)
    )
    return str(version.version)


def _schema(values: Iterable[onnx.ValueInfoProto]) -> Schema:
    rows = []
    for value in values:
        tensor = value.type.tensor_type
        shape = tuple(int(d.dim_value) for d in tensor.shape.dim)
        rows.append(TensorSpec(np.dtype(onnx.helper.tensor_dtype_to_np_dtype(tensor.elem_type)), shape, value.name))
    return Schema(rows)


def _elect(client: MlflowClient, name: str, number: str, gate: Gate) -> str:
    """Move ``champion`` to the version if it earned it; returns the verdict in words."""
    holder = next((v for v in versions(client, name) if CHAMPION in v.aliases), None)
    if holder is not None and str(holder.version) == number:
        return "is the champion"
    refusal = gate.refusal() or (gate.refusal_against(holder.tags) if holder is not None else None)
    if refusal:
        return f"not the champion: {refusal}"
    client.set_registered_model_alias(name, CHAMPION, number)
    return "is the champion"


def elect_case_champion(client: MlflowClient, case: str) -> str | None:
    """Put ``case_champion`` on the case's best champion, and only there; returns its name or None.

    Champions are compared among those of the newest gate: the one that most of them share.
    """
    champions = [
        version
        for model in client.search_registered_models(f"tags.`case` = '{case}'", max_results=1000)
        for version in versions(client, model.name)
        if CHAMPION in version.aliases or CASE_CHAMPION in version.aliases
    ]
    ids = [v.tags.get("gate_id") for v in champions if CHAMPION in v.aliases and "gate_score" in v.tags]
    common = max(ids, key=ids.count, default=None)
    able = [v for v in champions if CHAMPION in v.aliases and "gate_score" in v.tags and v.tags["gate_id"] == common]
    best = min(able, key=lambda v: float(v.tags["gate_score"]), default=None)
    for version in champions:
        if CASE_CHAMPION in version.aliases and (best is None or version.name != best.name):
            client.delete_registered_model_alias(version.name, CASE_CHAMPION)
    if best is None:
        return None
    client.set_registered_model_alias(best.name, CASE_CHAMPION, str(best.version))
    return str(best.name)


def _find(client: MlflowClient, what: str, default_alias: str) -> ModelVersion:
    """The version meant by NAME, NAME@ALIAS, NAME/NUMBER, or a case's name (its case champion)."""
    bare = what.partition("@")[0].partition("/")[0]
    names = [m.name for m in client.search_registered_models(max_results=1000)]
    if bare not in names and bare == what:
        of_case = client.search_registered_models(f"tags.`case` = '{bare}'", max_results=1000)
        crowned = [v for m in of_case for v in versions(client, m.name) if CASE_CHAMPION in v.aliases]
        if crowned:
            return crowned[0]
    if bare not in names:
        near = get_close_matches(bare, names, n=1) or names[:1]
        hint = f"did you mean {near[0]!r}? `list` shows all" if near else "the registry is empty: run `dvc repro`"
        raise TrackingError(f"no controller {bare!r} is registered; {hint}")
    number, alias = what.partition("/")[2], what.partition("@")[2] or default_alias
    found = versions(client, bare)
    for version in found:
        if (str(version.version) == number) if number else (alias in version.aliases):
            return version
    have = ", ".join(str(v.version) + "".join(f" @{a}" for a in v.aliases) for v in reversed(found))
    wanted = f"version {number}" if number else f"alias {alias!r}"
    raise TrackingError(f"{bare} has no {wanted}; it has {have}; give NAME/NUMBER or NAME@ALIAS")


def promote(client: MlflowClient, name: str, number: str, alias: str) -> str:
    """Move an alias by hand; a person may overrule the gate, and the tag ``promoted_by`` says so."""
    version = _find(client, f"{name}/{number}", alias)
    try:
        client.set_registered_model_alias(version.name, alias, str(version.version))
    except MlflowException as error:
        reason = " ".join(str(error).split())
        raise TrackingError(f"alias {alias!r} was refused: {reason}; use champion or candidate") from error
    client.set_model_version_tag(version.name, str(version.version), "promoted_by", "hand")
    if alias == CHAMPION and "case" in version.tags:
        elect_case_champion(client, version.tags["case"])
    said = f"{version.name} version {version.version} is now @{alias}"
    if alias == CHAMPION:
        said += " by hand; the gate (no lock-up, better than the baseline and than the last champion) was not asked"
    return said


def fetch(client: MlflowClient, what: str, folder: Path) -> list[Path]:
    """Write a registered controller and its manifest into ``folder``, checked against its digest."""
    version = _find(client, what, CHAMPION)
    law = version.tags.get("law", "")
    with tempfile.TemporaryDirectory() as draft:
        files = [
            Path(client.download_artifacts(str(version.run_id), f"{law}{suffix}", draft))
            for suffix in (".onnx", ".json")
        ]
        if file_digest(files[0]) != version.tags.get("sha256"):
            raise TrackingError(
                f"{version.name} version {version.version}: the stored {files[0].name} is not the file that was "
                "registered (its sha256 differs); delete the version and run `make registry`"
            )
        folder.mkdir(parents=True, exist_ok=True)
        return [_place(file, folder / file.name) for file in files]


def _place(source: Path, target: Path) -> Path:
    """Copy by renaming a draft, so that a loop which reloads the file never sees half of it."""
    draft = target.with_name(target.name + ".draft")
    draft.write_bytes(source.read_bytes())
    os.replace(draft, target)
    return target
