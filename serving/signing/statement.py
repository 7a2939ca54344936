"""The signed statement: an in-toto statement with the predicate of OpenSSF Model Signing 1.0.

    {"_type": "https://in-toto.io/Statement/v1",
     "subject": [{"name": NAME, "digest": {"sha256": ROOT}}],
     "predicateType": "https://model_signing/signature/v1.0",
     "predicate": {"serialization": {"method": "files", "hash_type": "sha256", ...},
                   "resources": [{"name": FILE, "algorithm": "sha256", "digest": HEX}, ...],
                   "loopwright": {"signed": TIME, "expires": TIME}}}

ROOT is the SHA-256 of the resources' digests, as bytes, one after the other. The format knows no expiry. Its
verifiers ignore further entries of the predicate, so ours stand there: signed as the rest is, and read by us alone.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from loopwright.serving.errors import SignatureError
from loopwright.serving.signing.bundle import entry, json_object

STATEMENT = "https://in-toto.io/Statement/v1"
PREDICATE = "https://model_signing/signature/v1.0"
OWN = "loopwright"
_TIME = "%Y-%m-%dT%H:%M:%SZ"
_DIGEST = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class Statement:
    """Files by name with their SHA-256; when they were signed and until when that holds (None: not said)."""

    name: str
    files: Mapping[str, str]
    signed: datetime | None = None
    expires: datetime | None = None

    def to_json(self, ignored: str) -> bytes:
        """The statement; ``ignored`` is the signature's own file, which others' tools then leave out."""
        names = sorted(self.files)
        times = {"signed": self.signed, "expires": self.expires}
        tree = {
            "_type": STATEMENT,
            "subject": [{"name": self.name, "digest": {"sha256": root([self.files[n] for n in names])}}],
            "predicateType": PREDICATE,
            "predicate": {
                "serialization": {
                    "method": "files",
                    "hash_type": "sha256",
                    "allow_symlinks": False,
                    "ignore_paths": [ignored],
                },
                "resources": [{"name": n, "algorithm": "sha256", "digest": self.files[n]} for n in names],
                OWN: {name: f"{utc(time, name):{_TIME}}" for name, time in times.items() if time is not None},
            },
        }
        return json.dumps(tree).encode()

    @classmethod
    def read(cls, payload: bytes) -> Statement:
        """The statement in a payload whose signature was verified; SignatureError for any other."""
        tree = json_object(payload, "what was signed")
        for name, wanted in (("_type", STATEMENT), ("predicateType", PREDICATE)):
            if tree.get(name) != wanted:
                raise SignatureError(f"what was signed has the {name} {str(tree.get(name))[:100]!r}, not {wanted!r}")
        subject = entry(tree, "subject", list)
        if len(subject) != 1 or not isinstance(subject[0], dict):
            raise SignatureError(f"what was signed has {len(subject)} subjects; it must have one")
        name, digest = entry(subject[0], "name", str), entry(subject[0], "digest", dict).get("sha256")
        predicate = entry(tree, "predicate", dict)
        how = entry(predicate, "serialization", dict)
        if how.get("method") != "files" or how.get("hash_type") != "sha256":
            raise SignatureError(
                f"the files were signed by {str(how.get('method'))[:20]!r} with {str(how.get('hash_type'))[:20]!r}; "
                "sign them by 'files' with 'sha256', as model-signing does by default"
            )
        files = _files(entry(predicate, "resources", list), name)
        if root(list(files.values())) != digest:
            raise SignatureError("the subject's digest is not that of the files that were signed: sign them again")
        return cls(name, files, *_times(predicate.get(OWN, {})))


def utc(time: datetime, name: str) -> datetime:
    """The same instant in UTC; SignatureError where the time names no zone, so nobody knows which instant it is."""
    if time.utcoffset() is None:
        raise SignatureError(f"{name} is {time}, without a time zone; give one: datetime(2027, 1, 31, tzinfo=UTC)")
    return time.astimezone(UTC)


def root(digests: list[str]) -> str:
    """SHA-256 over the digests, in their order."""
    return hashlib.sha256(b"".join(map(bytes.fromhex, digests))).hexdigest()


def _files(resources: list[Any], subject: str) -> dict[str, str]:
    """Name -> SHA-256. A file that model-signing signed alone is called "." there, and its name is the subject's."""
    files: dict[str, str] = {}
    for row in resources:
        if not isinstance(row, dict) or row.get("algorithm") != "sha256":
            raise SignatureError("a file was signed with another algorithm than sha256: sign it again")
        name, digest = entry(row, "name", str), entry(row, "digest", str)
        name = subject if name == "." and len(resources) == 1 else name
        if name in files or not name.isprintable() or not _DIGEST.fullmatch(digest):
            raise SignatureError(
                f"what was signed has the file {name[:100]!r} twice, or without a SHA-256, or under a strange name"
            )
        files[name] = digest
    return files


def _times(own: Any) -> tuple[datetime | None, datetime | None]:
    if not isinstance(own, dict) or set(own) - {"signed", "expires"}:
        raise SignatureError(
            f"what was signed has entries of {OWN} other than signed and expires: "
            "use the release of loopwright that signed it"
        )
    return _time(own.get("signed")), _time(own.get("expires"))


def _time(text: Any) -> datetime | None:
    if text is None:
        return None
    try:
        return datetime.strptime(text, _TIME).replace(tzinfo=UTC)
    except (TypeError, ValueError):
        raise SignatureError(
            f"what was signed has the time {str(text)[:40]!r}; it must be like 2027-01-31T12:00:00Z"
        ) from None
