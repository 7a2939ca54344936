"""A sigstore bundle, version 0.3, that holds a DSSE envelope signed by a key.

    signature = sign(key, PAE),   PAE = "DSSEv1" SP len(type) SP type SP len(payload) SP payload

DSSE 1.0.0, protocol.md; ``len`` is the number of bytes in decimal digits. Nothing of the payload is read before its
signature was verified.
"""

from __future__ import annotations

import base64
import binascii
import json
from dataclasses import dataclass
from typing import Any

from loopwright.serving.errors import SignatureError

MEDIA_TYPE = "application/vnd.dev.sigstore.bundle.v0.3+json"
PAYLOAD_TYPE = "application/vnd.in-toto+json"
MAX_SIGNATURE_BYTES = 2**20  # of a signature's file
MAX_HINT = 200  # characters
_SHOWN = 60  # letters of a foreign text that a message shows


@dataclass(frozen=True, slots=True)
class Envelope:
    """The signed statement, its signature, and the key that the bundle names (empty: none)."""

    payload: bytes
    signature: bytes
    hint: str


def pae(payload: bytes) -> bytes:
    """The bytes that are signed for a payload: DSSE's pre-authentication encoding."""
    return b"DSSEv1 %d %s %d %s" % (len(PAYLOAD_TYPE), PAYLOAD_TYPE.encode(), len(payload), payload)


def written(envelope: Envelope) -> bytes:
    """The bundle's JSON."""
    tree = {
        "mediaType": MEDIA_TYPE,
        "verificationMaterial": {"publicKey": {"hint": envelope.hint}, "tlogEntries": []},
        "dsseEnvelope": {
            "payload": base64.b64encode(envelope.payload).decode(),
            "payloadType": PAYLOAD_TYPE,
            "signatures": [{"sig": base64.b64encode(envelope.signature).decode(), "keyid": ""}],
        },
    }
    return json.dumps(tree).encode() + b"\n"


def read(data: bytes) -> Envelope:
    """The envelope in a bundle; SignatureError for any other format, and for a bundle without a key's signature."""
    tree = json_object(data, "the signature")
    media = tree.get("mediaType")
    if media != MEDIA_TYPE:
        raise SignatureError(f"the signature's mediaType is {_short(media)}; it must be {MEDIA_TYPE!r}")
    material = entry(tree, "verificationMaterial", dict)
    if "publicKey" not in material:
        other = sorted(set(material) - {"tlogEntries"})
        raise SignatureError(
            f"the signature was made with {_short(other)}; only signatures of keys can be verified here: "
            "`loopwright sign`, or `model_signing sign key`"
        )
    hint = entry(material, "publicKey", dict).get("hint") or ""
    if not isinstance(hint, str) or len(hint) > MAX_HINT or not (hint.isascii() and hint.isprintable()):
        raise SignatureError(f"the signature's key hint is {_short(hint)}; it must be a SHA-256 in hexadecimal digits")
    if "dsseEnvelope" not in tree:
        raise SignatureError(
            "the signature's bundle has no DSSE envelope, so it is none of a model: sign the file again"
        )
    envelope = entry(tree, "dsseEnvelope", dict)
    if envelope.get("payloadType") != PAYLOAD_TYPE:
        raise SignatureError(
            f"the signature's payloadType is {_short(envelope.get('payloadType'))}; it must be {PAYLOAD_TYPE!r}"
        )
    signatures = entry(envelope, "signatures", list)
    if len(signatures) != 1 or not isinstance(signatures[0], dict):
        raise SignatureError(f"the signature's envelope has {len(signatures)} signatures; it must have one")
    return Envelope(_bytes(envelope, "payload"), _bytes(signatures[0], "sig"), hint)


def json_object(data: bytes, what: str) -> dict[str, Any]:
    """JSON's object in ``data``, each entry once; SignatureError names ``what``."""
    try:
        tree = json.loads(data.decode(), object_pairs_hook=_once, parse_constant=_refused)
    except (ValueError, RecursionError) as error:
        raise SignatureError(f"{what} is not JSON ({error}): it is truncated, or another format") from None
    if not isinstance(tree, dict):
        raise SignatureError(f"{what} is no JSON object")
    return tree


def entry(tree: dict[str, Any], name: str, kind: type) -> Any:
    """One entry of a JSON object, of a type; SignatureError where it is not."""
    value = tree.get(name)
    if type(value) is not kind:
        words = {"dict": "an object", "list": "a list"}.get(kind.__name__, "a text")
        raise SignatureError(f"the signature's {name} is {_short(value)}; it must be {words}")
    return value


def _bytes(tree: dict[str, Any], name: str) -> bytes:
    try:
        return base64.b64decode(entry(tree, name, str), validate=True)
    except (binascii.Error, ValueError) as error:
        raise SignatureError(f"the signature's {name} is no base64: {error}") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    row = dict(pairs)
    if len(row) < len(pairs):
        raise ValueError("an entry stands twice")
    return row


def _refused(constant: str) -> Any:
    raise ValueError(f"{constant} is no number")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
