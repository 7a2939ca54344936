"""The JSON file beside a controller: its manifest again, for hosts that cannot read the metadata of ONNX."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from loopwright.serving import graph_audit
from loopwright.serving.digest import file_digest, unseal
from loopwright.serving.errors import ArtifactError
from loopwright.serving.manifest import MANIFEST_KEY, MAX_CHARACTERS, Manifest, strictly

INDENTED = 16  # times as long at most as the manifest: the deepest entries have a line and 42 blanks of their own


def sidecar(manifest: Manifest, sha256: str) -> str:
    """The JSON file's text: the manifest, and the SHA-256 of the controller's file."""
    return json.dumps({**json.loads(manifest.to_json()), "sha256": sha256}, indent=2) + "\n"


def manifest_in(data: bytes) -> Manifest:
    """The manifest inside a controller's file. ArtifactError where it is none, or was changed after its export."""
    unseal(data)
    return Manifest.from_json(graph_audit.audit(data).metadata.get(MANIFEST_KEY, ""))


def require_sidecar(path: Path) -> None:
    """ArtifactError where the JSON file beside a controller says other things than the controller's own manifest.

    A host that believes the JSON file would command other ranges than those that were validated.
    """
    data, beside = path.read_bytes(), path.with_suffix(".json")
    manifest = manifest_in(data)
    different = difference(beside.read_bytes(), manifest, file_digest(data))
    if different:
        raise ArtifactError(
            f"{beside.name} is not the manifest of {path.name}: {different} differs; get both from one place"
        )


def difference(text: bytes, manifest: Manifest, sha256: str) -> str:
    """Where a JSON file differs from the one of a controller, as ``mv.0.high``; empty: it repeats the manifest."""
    try:
        found = strictly(text.decode(), INDENTED * MAX_CHARACTERS)
    except (UnicodeDecodeError, ArtifactError):
        return "what should be JSON"
    return _differs(found, json.loads(sidecar(manifest, sha256)), "")


def _differs(found: Any, wanted: Any, where: str) -> str:
    if isinstance(found, dict) and isinstance(wanted, dict):
        keys = [*wanted, *(key for key in found if key not in wanted)]
        pairs = [(key, found.get(key, ...), wanted.get(key, ...)) for key in keys]
    elif isinstance(found, list) and isinstance(wanted, list) and len(found) == len(wanted):
        pairs = [(str(i), f, w) for i, (f, w) in enumerate(zip(found, wanted, strict=True))]
    else:
        return "" if found == wanted and isinstance(found, bool) == isinstance(wanted, bool) else where or "the whole"
    return next(filter(None, (_differs(f, w, f"{where}.{key}".lstrip(".")) for key, f, w in pairs)), "")
