"""The controllers in a folder that could take over a loop: read here, so that the loop need not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from loopwright.serving.digest import file_digest, unseal
from loopwright.serving.errors import ArtifactError, LoopwrightError
from loopwright.serving.fitted import require_fits
from loopwright.serving.graph_audit import MAX_BYTES, audit
from loopwright.serving.manifest import MANIFEST_KEY, Manifest

MOST = 50  # files that are looked at


def candidates(
    in_charge: Path, trusted: Sequence[str] | None = None, first: Path | None = None
) -> list[dict[str, Any]]:
    """Law, case, file, sha256 and signer of each controller beside the file ``in_charge`` that fits the loop.

    The loop has the signals of the file ``first`` that it began with; without one, of the file in charge.

    Where public keys are ``trusted``, only of files that one of them signed: the loop would refuse any other.
    """
    found: list[dict[str, Any]] = []
    now, _, _ = _described(first or in_charge, trusted)
    beside = (p for p in in_charge.parent.glob("*.onnx") if p.is_file())  # no pipe, which would never end
    for path in sorted(beside)[:MOST]:
        try:
            manifest, sha256, signed = _described(path, trusted)
            require_fits(manifest, now)
        except (LoopwrightError, OSError, KeyError):
            continue
        if path.name != in_charge.name:
            row = {"law": manifest.law, "case": manifest.case, "file": path.name, "sha256": sha256, "signed": signed}
            found.append(row)
    return found


def _described(path: Path, trusted: Sequence[str] | None) -> tuple[Manifest, str, str | None]:
    """Manifest, sha256 and signer, without a session; LoopwrightError where it is no controller, or not trusted."""
    signed = None
    if trusted is not None:
        from loopwright.serving.signing.verify import verified  # here: it needs the package cryptography

        signed = verified(path, trusted)
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    sha256 = file_digest(data)
    if signed is not None and sha256 != signed.sha256:
        raise ArtifactError(f"{path} was exchanged after its signature was verified")
    unseal(data)
    return Manifest.from_json(audit(data).metadata[MANIFEST_KEY]), sha256, None if signed is None else signed.words
