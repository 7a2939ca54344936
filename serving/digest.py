"""The digest at the end of a controller file: a last metadata entry that covers every byte before it.

ONNX is a protobuf and a protobuf may be continued by appending fields to its bytes. So the entry
``loopwright.sha256`` is appended to the finished model: any ONNX reader still loads the file, and
the digest is checked over raw bytes, with no second serialization that could differ.
"""

from __future__ import annotations

import hashlib

from loopwright.serving.errors import ArtifactError

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
