"""Signing a controller's file: only one that is a controller, with a manifest beside it that is its own."""

from __future__ import annotations

import os
import tempfile
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path

from loopwright.serving.controller_file import contents, difference, file_digest, manifest_in
from loopwright.serving.errors import ArtifactError, SignatureError
from loopwright.serving.graph import audit
from loopwright.serving.signing import bundle
from loopwright.serving.signing.keys import PrivateKey
from loopwright.serving.signing.statement import Statement, utc
from loopwright.serving.signing.verify import MAX_SIDECAR, signature_of


def sign(
    path: str | PathLike[str], key: PrivateKey, *, expires: datetime | None = None, now: datetime | None = None
) -> Path:
    """Write the signature of a controller's file and of its manifest's JSON file; the signature's file.

    ``expires`` is when the signature ends (None: never), ``now`` when it was made (None: by this machine's clock). Each
    names its time zone; UTC is written.

    Raises ArtifactError where the file is no controller, and SignatureError where the JSON file beside it is not its
    manifest, ``expires`` lies in the past, or a time names no zone.
    """
    path, now = Path(path), utc(now or datetime.now(UTC), "now")
    expires = None if expires is None else utc(expires, "expires")
    if expires is not None and expires <= now:
        raise SignatureError(f"the signature would have expired on {expires:%Y-%m-%d %H:%M} UTC; give a day to come")
    statement = Statement(path.name, _files(path), now.replace(microsecond=0), expires)
    target = signature_of(path)
    payload = statement.to_json(target.name)
    envelope = bundle.Envelope(payload, key.sign(bundle.pae(payload)), key.public.fingerprint)
    _replace(target, bundle.written(envelope))
    return target


def _files(path: Path) -> dict[str, str]:
    """Name -> SHA-256 of the controller's file and of its manifest's JSON file, where there is one."""
    try:
        data = contents(path, audit.MAX_GRAPH_BYTES)
    except FileNotFoundError:
        raise SignatureError(f"{path} does not exist; give a controller's .onnx file") from None
    try:
        manifest = manifest_in(data)
    except ArtifactError as error:
        raise ArtifactError(f"{path}: {error}") from None
    files = {path.name: file_digest(data)}
    sidecar = path.with_suffix(".json")
    try:
        text = contents(sidecar, MAX_SIDECAR)
    except FileNotFoundError:
        return files
    if difference(text, manifest, files[path.name]):
        raise SignatureError(f"{sidecar} is not the manifest of {path.name}; get both from one place, or remove it")
    return {**files, sidecar.name: file_digest(text)}


def _replace(path: Path, data: bytes) -> None:
    """Write a file as a whole or not at all."""
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
            draft = Path(folder) / path.name
            draft.write_bytes(data)
            os.replace(draft, path)
    except OSError as error:
        raise SignatureError(f"{path} cannot be written: {error.strerror}") from None
