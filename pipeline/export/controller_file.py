"""A controller's file: graph, manifest and digest written together; its evidence may be changed later.

Apart from ``loopwright.pipeline.export.gate``, because whoever only runs controllers needs no torch, and importing
that takes longer than many a closed loop.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import onnx

from loopwright.pipeline.files import draft_of, write_bytes, write_text
from loopwright.serving.controller import Controller
from loopwright.serving.controller_file import TRAILER_BYTES, file_digest, seal, sidecar
from loopwright.serving.explain.explain_file import EXPLAIN_KEY, explain_manifest, explain_path
from loopwright.serving.graph.audit import audit
from loopwright.serving.manifest import MANIFEST_KEY, Manifest


def with_evidence(src: str | Path, dst: str | Path, evidence: Mapping[str, Any]) -> Manifest:
    """Copy a controller with other evidence in its manifest; the graph's bytes stay as they are.

    Raises ArtifactError if ``src`` is no controller.
    """
    src, dst = Path(src), Path(dst)
    manifest = replace(Controller(src).manifest, evidence=dict(evidence))
    model = onnx.ModelProto.FromString(src.read_bytes()[:-TRAILER_BYTES])
    del model.metadata_props[:]
    with draft_of(dst) as draft:
        draft.write_bytes(file_bytes(model.SerializeToString(), manifest))
        Controller(draft)
    write_sidecar(dst, manifest)
    explain_of(src, dst)
    return manifest


def explain_of(src: Path, dst: Path) -> None:
    """Put the explain graph that lies beside ``src`` beside ``dst``, as that of this file; without one, none."""
    source, target = explain_path(src), explain_path(dst)
    if not source.is_file():
        target.unlink(missing_ok=True)
        return
    data = source.read_bytes()
    manifest = replace(explain_manifest(audit(data).metadata), controller=file_digest(dst.read_bytes()))
    model = onnx.ModelProto.FromString(data[:-TRAILER_BYTES])
    del model.metadata_props[:]
    write_bytes(target, sealed(model.SerializeToString(), EXPLAIN_KEY, manifest.to_json()))


def withhold(dst: str | Path, why: str) -> None:
    """Leave no controller at ``dst``, and say why in the JSON file beside it."""
    dst = Path(dst)
    dst.unlink(missing_ok=True)
    explain_path(dst).unlink(missing_ok=True)
    write_text(dst.with_suffix(".json"), json.dumps({"withheld": why}, indent=2) + "\n")


def file_bytes(model: bytes, manifest: Manifest) -> bytes:
    """Model bytes + manifest + digest; appended, because a protobuf may be continued so."""
    return sealed(model, MANIFEST_KEY, manifest.to_json())


def sealed(model: bytes, key: str, manifest: str) -> bytes:
    """Model bytes with a manifest under its ``key``, and the digest."""
    entry = onnx.StringStringEntryProto(key=key, value=manifest)
    return seal(model + onnx.ModelProto(metadata_props=[entry]).SerializeToString())


def write_sidecar(path: Path, manifest: Manifest) -> None:
    """``<law>.json``: the manifest again and the file's SHA-256, for hosts that cannot read ONNX metadata."""
    write_text(path.with_suffix(".json"), sidecar(manifest, file_digest(path.read_bytes())))
