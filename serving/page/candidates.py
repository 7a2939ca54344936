"""The controllers in a folder that could take over a loop: read here, so that the loop need not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from serving.digest import file_digest, unseal
from serving.errors import LoopwrightError
from serving.graph_audit import MAX_BYTES, audit
from serving.manifest import MANIFEST_KEY, Manifest
from serving.successor import require_same_signals

MOST = 50  # files that are looked at


def candidates(folder: Path, in_charge: str) -> list[dict[str, Any]]:
    """Law, file and sha256 of each controller with the period and the signals of the file ``in_charge``."""
    found: list[dict[str, Any]] = []
    now, _ = _described(folder / in_charge)
    for path in sorted(folder.glob("*.onnx"))[:MOST]:
        try:
            manifest, sha256 = _described(path)
            require_same_signals(now, manifest)
        except (LoopwrightError, OSError, KeyError):
            continue
        if path.name != in_charge:
            found.append({"law": manifest.law, "file": path.name, "sha256": sha256})
    return found


def _described(path: Path) -> tuple[Manifest, str]:
    """Manifest and sha256, without a session; LoopwrightError where the file is no controller."""
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    unseal(data)
    return Manifest.from_json(audit(data).metadata[MANIFEST_KEY]), file_digest(data)
