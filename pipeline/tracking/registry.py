"""The model registry: a registered model for each controller, a version for each different file."""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import mlflow
import mlflow.artifacts
import mlflow.onnx
import numpy as np
import onnx
from mlflow import MlflowClient
from mlflow.entities import LoggedModelOutput
from mlflow.entities.model_registry import ModelVersion, RegisteredModel
from mlflow.exceptions import MlflowException
from mlflow.models import ModelSignature
from mlflow.types import Schema, TensorSpec

from loopwright.pipeline.errors import TrackingError
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.files import sha256, write_bytes
from loopwright.pipeline.tracking import card, signing
from loopwright.pipeline.tracking.gate import Gate
from loopwright.pipeline.tracking.signing import Signer
from loopwright.pipeline.tracking.store import missing_file
from loopwright.serving.certificate import certificate_of
from loopwright.serving.controller_file import EXPLAIN_SUFFIX, law_in, manifest_in, require_sidecar
from loopwright.serving.errors import ArtifactError, SignatureError
from loopwright.serving.explain.explain_file import explain_path
from loopwright.serving.words import harmless, plain

CANDIDATE, BEST, CHAMPION = "candidate", "best", "champion"
BY_HAND = "champion_by"
EXPLAINED = "explain_sha256"  # tag of a version with a graph that explains it
REQUIREMENTS = ["onnxruntime>=1.20", "numpy>=2.0"]


def registered(client: MlflowClient) -> list[RegisteredModel]:
    """Every registered controller: cases by name, within a case the champion first, then by rank."""
    return sorted(client.search_registered_models(max_results=1000), key=_order)


def _order(model: RegisteredModel) -> tuple[str, bool, int, str]:
    standing = model.tags.get("standing", "")
    rank = re.search(r"(\d+) of \d+", standing)
    return (
        model.tags.get("case", ""),
        not standing.startswith(CHAMPION),
        int(rank[1]) if rank else sys.maxsize,
        str(model.name),
    )


def versions(client: MlflowClient, name: str) -> list[ModelVersion]:
    """All versions of a registered model with their tags and aliases, the newest first."""
    rows = client.search_model_versions(f"name = '{name}'", max_results=10_000)
    aliases = client.get_registered_model(name).aliases if rows else {}
    for version in rows:
        version.aliases = sorted(alias for alias, number in aliases.items() if str(number) == str(version.version))
    return sorted(rows, key=lambda v: -int(v.version))


def register(
    client: MlflowClient,
    case: str,
    path: Path,
    run_id: str,
    validation: Validation | None,
    picture: str | None,
    tags: Mapping[str, str],
    signer: Signer | None = None,
    operated: Mapping[str, str] | None = None,
) -> tuple[str, bool]:
    """Register the controller file ``path`` unless its digest is known; refresh its evidence and its signature.

    ``picture`` is an artifact of the run, as those of ``operated`` are, by the test that they show. Without a
    ``signer`` the signature that is there stays. Returns one line that says what happened, and whether a version was
    made.
    """
    law = path.stem
    name = f"{case}-{law}"
    gate = Gate.of(validation, law)
    digest = sha256(path)
    if not client.search_registered_models(f"name = '{name}'"):
        client.create_registered_model(name, tags={"standing": "not compared yet", "case": case, "law": law})
    known = next((v for v in versions(client, name) if v.tags.get("sha256") == digest), None)
    data = path.read_bytes()
    manifest = manifest_in(data)
    if path.with_suffix(".json").exists():
        require_sidecar(path)
    beside = explain_path(path)  # the run of a known version has the file of then
    explained = {EXPLAINED: sha256(beside)} if known is None and beside.is_file() else {}
    own = {"sha256": digest, **explained, "law": law, "case": case, "period_s": str(manifest.period_s)}
    before, at = ({}, run_id) if known is None else (dict(known.tags), str(known.run_id))
    signature = signing.present(before) if signer is None else signer.attach(client, at, path, before)
    signed = signing.words(signature)
    certificate = certificate_of(manifest, law_in(data))
    description = card.version_description(validation, gate, run_id, picture, signed, operated, certificate)
    description = harmless(description)
    analysis = {f"analysis_{name}": f"{value:.6g}" for name, value in card.analysis_figures(validation, law).items()}
    shown = {**gate.tags(), **analysis, **own, **signature, **tags}  # in this order they are shown
    tags = {key: plain(value) for key, value in shown.items()}
    if known is None:
        number, before = _log(client, name, path, run_id, description, tags), tags
        client.set_registered_model_alias(name, CANDIDATE, number)
    else:
        number = str(known.version)
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
    made = client.create_logged_model(client.get_run(run_id).info.experiment_id, name=name, source_run_id=run_id)
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
    """Move ``best`` to the version if it earned it, and from it where its newest evidence is refused; the verdict.

    A version that a person promoted stays.
    """
    holder = next((v for v in versions(client, name) if BEST in v.aliases), None)
    if holder is not None and str(holder.version) == number and holder.tags.get("promoted_by") != "hand":
        if refusal := gate.refusal():
            client.delete_registered_model_alias(name, BEST)
            return f"no longer the best version: {refusal}"
    elif holder is None or str(holder.version) != number:
        refusal = gate.refusal() or (gate.refusal_against(holder.tags) if holder is not None else None)
        if refusal:
            return f"not the best version: {refusal}"
        client.set_registered_model_alias(name, BEST, number)
    return "is the best version"


def withdraw(client: MlflowClient, name: str, why: str) -> str:
    """Take ``best`` from a controller that its newest validation does not ship; the line to say, or nothing.

    A version of an older run must not be handed out for it. One that a person put there stays.
    """
    holder = next((v for v in versions(client, name) if BEST in v.aliases), None)
    if holder is None or holder.tags.get("promoted_by") == "hand":
        return ""
    client.delete_registered_model_alias(name, BEST)
    verdict = f"no longer the best version: the newest run does not ship this law: {why}"
    client.set_model_version_tag(name, str(holder.version), "verdict", verdict)
    return f"{name} version {holder.version}: no longer the best version, the newest run does not ship this law"


def _of_case(client: MlflowClient, case: str) -> list[ModelVersion]:
    """Every version of every controller of a case."""
    return [version for model in _models(client, case) for version in versions(client, model.name)]


def _models(client: MlflowClient, case: str) -> list[RegisteredModel]:
    return list(client.search_registered_models(f"tags.`case` = '{case}'", max_results=1000))


def elect_champion(client: MlflowClient, case: str) -> str | None:
    """Put ``champion`` on the best controller of the case, and only there; returns its name or None.

    Best versions are compared among those of the newest gate: the one that most of them share. A
    champion that a person promoted stays.
    """
    rows = _of_case(client, case)
    holders = [v for v in rows if CHAMPION in v.aliases]
    best = next((v for v in holders if v.tags.get(BY_HAND) == "hand"), None)
    if best is None:
        scored = [v for v in rows if BEST in v.aliases and "gate_score" in v.tags]
        ids = [v.tags.get("gate_id") for v in scored]
        common = max(ids, key=ids.count, default=None)
        able = [v for v in scored if v.tags.get("gate_id") == common]
        able = [v for v in able if not v.tags.get("swings")] or able
        best = min(able, key=lambda v: float(v.tags["gate_score"]), default=None)
    _crown(client, holders, best)
    return None if best is None else str(best.name)


def _crown(client: MlflowClient, holders: Iterable[ModelVersion], best: ModelVersion | None) -> None:
    """Move ``champion`` from its holders to the version."""
    for version in holders:
        if best is None or version.name != best.name:
            client.delete_registered_model_alias(version.name, CHAMPION)
    if best is not None and CHAMPION not in best.aliases:
        client.set_registered_model_alias(best.name, CHAMPION, str(best.version))


def describe(client: MlflowClient, case: str, validation: Validation | None, champion: str | None) -> None:
    """Say on the page of every controller of a case where it stands."""
    for model in _models(client, case):
        law = model.tags["law"]
        description = card.model_description(case, law, validation, champion)
        standing, _ = card.standing(model.name, law, validation, champion)
        if model.description != description:
            client.update_registered_model(model.name, description)
        if model.tags.get("standing") != standing:
            client.set_registered_model_tag(model.name, "standing", standing)


def _find(client: MlflowClient, what: str, default_alias: str) -> ModelVersion:
    """The version meant by NAME, NAME@ALIAS, NAME/NUMBER, or a case's name (its champion)."""
    bare = what.partition("@")[0].partition("/")[0]
    names = [m.name for m in client.search_registered_models(max_results=1000)]
    if bare not in names and bare == what:
        rows = _of_case(client, bare)
        crowned = next((v for v in rows if CHAMPION in v.aliases), None)
        if crowned is not None:
            return crowned
        if rows:
            raise TrackingError(f"{bare} has no champion: no controller of the case passed the gate; `list` shows all")
    if bare not in names:
        near = get_close_matches(bare, names, n=1) or names[:1]
        hint = f"did you mean {near[0]!r}? `list` shows all" if near else "it is empty: `loopwright run` fills it"
        raise TrackingError(f"no controller {bare!r} is registered; {hint}")
    number, alias = what.partition("/")[2], what.partition("@")[2] or default_alias
    rows = versions(client, bare)
    for version in rows:
        if (str(version.version) == number) if number else (alias in version.aliases):
            return version
    have = ", ".join(str(v.version) + "".join(f" @{a}" for a in v.aliases) for v in reversed(rows))
    wanted = f"version {number}" if number else f"alias {alias!r}"
    raise TrackingError(f"{bare} has no {wanted}; it has {have}; give NAME/NUMBER or NAME@ALIAS")


def promote(client: MlflowClient, name: str, number: str, alias: str) -> str:
    """Move an alias by hand; a person may overrule the gate, and the tag ``promoted_by`` says so.

    A champion that was promoted by hand stays champion until a person promotes another one.
    """
    version = _find(client, f"{name}/{number}", alias)
    try:
        client.set_registered_model_alias(version.name, alias, str(version.version))
    except MlflowException as error:
        reason = " ".join(str(error).split())
        raise TrackingError(f"alias {alias!r} was refused: {reason}; use champion, best or candidate") from error
    client.set_model_version_tag(version.name, str(version.version), "promoted_by", "hand")
    case = version.tags.get("case")
    if alias == BEST and case:
        elect_champion(client, case)
    line = f"{version.name} version {version.version} is now @{alias}"
    if alias == CHAMPION and case:
        rows = _of_case(client, case)
        for other in rows:
            if other.tags.get(BY_HAND):
                client.delete_model_version_tag(other.name, str(other.version), BY_HAND)
        client.set_model_version_tag(version.name, str(version.version), BY_HAND, "hand")
        best = next(v for v in rows if v.name == version.name and str(v.version) == str(version.version))
        _crown(client, [v for v in rows if CHAMPION in v.aliases], best)
        line += (
            f" of {case}, by hand: the gate (no lock-up, better than the baseline and than the other controllers) was "
            f"not asked. It stays champion until you promote another one or delete its tag {BY_HAND!r}"
        )
    return line


def fetch(
    client: MlflowClient, what: str, folder: Path, trusted: Sequence[Path] | None = None
) -> tuple[list[Path], str]:
    """Write a registered controller, its manifest, its signature and the graph that explains it into ``folder``.

    Returns the files, and who signed.

    The file is checked against its digest, and the JSON file against the manifest inside it. Where public keys are
    ``trusted``, nothing is written unless one of them signed it: whoever can write the store can write its digest too.
    SignatureError says why.
    """
    version = _find(client, what, BEST)
    law = version.tags.get("law", "")
    suffixes = [".onnx", ".json", *([".onnx.sig"] if signing.FINGERPRINT in version.tags else [])]
    explained = [EXPLAIN_SUFFIX] if EXPLAINED in version.tags else []
    with tempfile.TemporaryDirectory() as draft:
        files = [_download(client, version, f"{law}{suffix}", draft) for suffix in suffixes]
        if sha256(files[0]) != version.tags.get("sha256"):
            raise TrackingError(
                f"{version.name} version {version.version}: the stored {files[0].name} is not the file that was "
                "registered (its sha256 differs); delete the version and run `make registry`"
            )
        words = _signer(version, files[0], trusted)
        try:
            require_sidecar(files[0])
        except ArtifactError as error:
            raise TrackingError(f"{version.name} version {version.version}: {error}") from None
        beside = [_download(client, version, f"{law}{suffix}", draft) for suffix in explained]
        for file in beside:
            if sha256(file) != version.tags[EXPLAINED]:
                raise TrackingError(
                    f"{version.name} version {version.version}: the stored {file.name} is not the file that was "
                    "registered (its sha256 differs); delete the version and run `make registry`"
                )
        for file in (*files, *beside):
            write_bytes(folder / file.name, file.read_bytes())
        if not beside:  # of a version that was fetched here before
            (folder / f"{law}{EXPLAIN_SUFFIX}").unlink(missing_ok=True)
        if len(files) < 3:  # of a version that was fetched here before
            (folder / f"{files[0].name}.sig").unlink(missing_ok=True)
        return [folder / file.name for file in (*files, *beside)], words


def _signer(version: ModelVersion, file: Path, trusted: Sequence[Path] | None) -> str:
    """Signer of a file that came from the store, in words; SignatureError where none of the keys did."""
    said = signing.words(version.tags)
    if trusted is None:
        return f"signed by {said}, as the store says: verify it with --key PUBLIC" if said else "not signed"
    from loopwright.serving.signing.verify import verified

    try:
        return f"signed by {verified(file, trusted).words}: verified"
    except SignatureError as error:
        reason = str(error).removeprefix(f"{file}: ")
        raise SignatureError(f"{version.name} version {version.version}: {reason}") from None


def _download(client: MlflowClient, version: ModelVersion, file: str, draft: str) -> Path:
    """One file of a version's run; TrackingError says which one is missing and where it should be."""
    place = str(client.get_run(str(version.run_id)).info.artifact_uri)
    try:
        # not by the run's id: mlflow remembers where a run lay, also of a store that was copied since
        return Path(mlflow.artifacts.download_artifacts(artifact_uri=f"{place}/{file}", dst_path=draft))
    except (MlflowException, OSError) as error:
        raise TrackingError(
            f"{version.name} version {version.version} is registered, but its file {file} did not come from {place}: "
            f"{missing_file(error)}"
        ) from error
