"""From DVC's cached results to the store: what it lacks is written, the rest is left alone."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mlflow import MlflowClient

from loopwright.pipeline.evaluation.leaderboard import withheld_in
from loopwright.pipeline.evaluation.validation import FILE, Validation
from loopwright.pipeline.files import sha256
from loopwright.pipeline.tracking.notes import experiment_note
from loopwright.pipeline.tracking.registry import describe, elect_champion, register, withdraw
from loopwright.pipeline.tracking.runs import describe_experiment, git_commit, published, refresh, write_run
from loopwright.pipeline.tracking.signing import Signer
from loopwright.pipeline.tracking.stage_results import StageResult, dataset_hash, datasets, read_lock
from loopwright.pipeline.tracking.store import experiment_id, hide_default, store


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
            marks = {**tags[result.name], "stage_key": result.key}
            line, is_new = register(client, case, path, run_id, validation, picture, marks, signer)
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
