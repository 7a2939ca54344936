"""Signatures edited by hand: what an attacker, or another tool, could write."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from loopwright.serving.signing import bundle
from loopwright.serving.signing.keys import PrivateKey
from loopwright.serving.signing.verify import signature_of

NOW = datetime(2026, 5, 1, 12, tzinfo=UTC)
DAY_AFTER = datetime(2026, 5, 2, 12, tzinfo=UTC)


def edit_bundle(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change what nobody signed: the bundle around the payload."""
    tree = json.loads(signature_of(path).read_text())
    change(tree)
    signature_of(path).write_text(json.dumps(tree))


def payload_of(path: Path) -> dict[str, Any]:
    """What was signed."""
    return dict(json.loads(bundle.read(signature_of(path).read_bytes()).payload))


def sign_payload(path: Path, key: PrivateKey, tree: Any) -> None:
    """A valid signature of any payload."""
    payload = json.dumps(tree).encode()
    envelope = bundle.Envelope(payload, key.sign(bundle.pae(payload)), key.public.fingerprint)
    signature_of(path).write_bytes(bundle.written(envelope))
