"""Bytes of a controller file: the digest at its end, and the JSON file beside it; other files, read with a limit."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

from loopwright.serving.errors import ArtifactError, SignatureError
from loopwright.serving.graph import audit
from loopwright.serving.graph.onnx_bytes import write_model
from loopwright.serving.manifest import MANIFEST_KEY, MAX_CHARACTERS, Manifest, strictly

# -------------------------------------------------------------- a last metadata entry that covers every byte before it
DIGEST_KEY = "loopwright.sha256"
# ModelProto.metadata_props (field 14) holding StringStringEntryProto{key = 1, value = 2}
_ENTRY = b"\x0a" + bytes([len(DIGEST_KEY)]) + DIGEST_KEY.encode() + b"\x12\x40"
_HEAD = b"\x72" + bytes([len(_ENTRY) + 64]) + _ENTRY
TRAILER_BYTES = len(_HEAD) + 64


def file_digest(data: bytes) -> str:
    """Hexadecimal SHA-256, as ``sha256sum`` prints it."""
    return hashlib.sha256(data).hexdigest()


def seal(model: bytes) -> bytes:
    """The model with its digest appended."""
    return model + _HEAD + file_digest(model).encode()


def unseal(data: bytes) -> bytes:
    """The model without its digest; ArtifactError if the digest is missing or does not match."""
    body, trailer = data[:-TRAILER_BYTES], data[-TRAILER_BYTES:]
    if not body or not trailer.startswith(_HEAD):
        raise ArtifactError(
            "the file does not end with a Loopwright digest: it is truncated, changed, or not a controller; "
            "fetch it again or export the controller again"
        )
    if trailer[len(_HEAD) :] != file_digest(body).encode():
        raise ArtifactError(
            "the file was changed after export (its digest does not match): "
            "fetch it again or export the controller again"
        )
    return body


# ------------------------------------------------------------------------------- the law alone, whatever is known of it
def law_digest(data: bytes, manifest: str) -> str:
    """SHA-256 of a controller file's law: its graph, and its ``manifest`` (the JSON text in it) without the evidence.

    It stays the same where evidence is added. Only the last entry before the digest is taken for the manifest, where
    the exporter writes it; wherever else it stands, its evidence counts too.
    """
    body, entry = data[:-TRAILER_BYTES], write_model({"metadata_props": [{"key": MANIFEST_KEY, "value": manifest}]})
    graph = body.removesuffix(entry)
    contract = json.loads(manifest)
    contract.pop("evidence", None)
    text = json.dumps(contract, sort_keys=True, allow_nan=False)
    return hashlib.sha256(hashlib.sha256(graph).digest() + text.encode()).hexdigest()


def law_in(data: bytes) -> str:
    """The law's digest of a controller's file; ArtifactError where it is none, or was changed after its export."""
    unseal(data)
    return law_digest(data, audit.audit(data).metadata.get(MANIFEST_KEY, ""))


# ---------------------------------------------------------------- the manifest for hosts that cannot read the metadata
INDENTED = 16  # times as long at most as the manifest: the deepest entries have a line and 42 blanks of their own


def sidecar(manifest: Manifest, sha256: str) -> str:
    """The JSON file's text: the manifest, and the SHA-256 of the controller's file."""
    return json.dumps({**json.loads(manifest.to_json()), "sha256": sha256}, indent=2) + "\n"


def manifest_in(data: bytes) -> Manifest:
    """The manifest inside a controller's file. ArtifactError where it is none, or was changed after its export."""
    unseal(data)
    return Manifest.from_json(audit.audit(data).metadata.get(MANIFEST_KEY, ""))


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


# ------------------------------------------------------------------------------------------------- files in a folder
EXPLAIN_SUFFIX = ".explain.onnx"  # of the graph beside a controller's file that says why it moves
BATCH_SUFFIX = ".batch1.onnx"  # of the graph with a leading batch of 1, in a conformance kit


def controller_files(folder: Path) -> list[Path]:
    """The controllers' files of a folder, by name; graphs that explain them, and those with a batch, are none."""
    return sorted(path for path in folder.glob("*.onnx") if not path.name.endswith((EXPLAIN_SUFFIX, BATCH_SUFFIX)))


# ------------------------------------------------------------------------------------------------- reading a file
def read_controller(path: Path, pinned: str | None) -> bytes:
    """The bytes of a controller's file, read once: what is checked is what is loaded.

    ArtifactError for what is no regular file, is too large, is damaged, or has another SHA-256 than the ``pinned`` one.
    """
    try:
        _check_kind(path.stat())  # before it is opened: opening a device may already do something
        with open(path, "rb", opener=without_waiting) as file:
            info = os.fstat(file.fileno())
            _check_kind(info)
            data = file.read(info.st_size)
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL in it
        raise ArtifactError(f"the file cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if pinned is not None and file_digest(data) != pinned.lower():
        raise ArtifactError(
            f"the file's SHA-256 is {file_digest(data)}, not the pinned {pinned}; "
            "pin this one only if you changed the file yourself"
        )
    unseal(data)
    return data


def _check_kind(info: os.stat_result) -> None:
    """ArtifactError unless it is a regular file of at most MAX_GRAPH_BYTES: a pipe or a device may never end."""
    if not stat.S_ISREG(info.st_mode):
        kind = next((word for is_kind, word in _KINDS if is_kind(info.st_mode)), "no regular file")
        raise ArtifactError(f"the path is {kind}; a controller is a regular file")
    if info.st_size > audit.MAX_GRAPH_BYTES:
        raise ArtifactError(f"the file has {info.st_size} bytes; a controller has at most {audit.MAX_GRAPH_BYTES}")


_KINDS: tuple[tuple[Callable[[int], bool], str], ...] = (
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def without_waiting(path: str, flags: int) -> int:
    """Open a path, for ``open``; a pipe without a writer does not block: it may have been put there since a check."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


# -------------------------------------------------------------------------- files of somebody else's, read with a limit
def contents(path: Path, most: int) -> bytes:
    """The bytes of a regular file of at most ``most`` bytes; FileNotFoundError where there is none.

    Raises SignatureError for anything else: a pipe would be waited for, and a device may never end.
    """
    try:
        with open(path, "rb", opener=without_waiting) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise SignatureError(f"{path} is no regular file")
            data = file.read(most + 1)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL in it
        raise SignatureError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(data) > most:
        raise SignatureError(f"{path} has more than the {most} bytes that it may have")
    return data
