"""Whether a trusted key signed a controller's file, told from the signature and digests alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

from loopwright.serving.controller_file import contents, file_digest
from loopwright.serving.errors import SignatureError
from loopwright.serving.graph import audit
from loopwright.serving.signing import bundle
from loopwright.serving.signing.keys import PublicKey
from loopwright.serving.signing.statement import Statement

SUFFIX = ".sig"
MAX_SIDECAR = 16 * 2**20  # bytes of a manifest beside the file
ENDS_SOON = timedelta(days=30)  # before a signature's end: the maker is asked for another one
SLACK = timedelta(minutes=5)  # by which two clocks may differ

Trusted: TypeAlias = Sequence["str | PathLike[str] | PublicKey"]


@dataclass(frozen=True, slots=True)
class Signed:
    """Signer of a file: the key, its holder's name here, when, until when, and the file's SHA-256."""

    name: str
    fingerprint: str
    kind: str
    sha256: str
    files: tuple[str, ...]
    signed: datetime | None
    expires: datetime | None

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready: name, fingerprint, kind of key, times in ISO 8601 (None: not said), and all of it in words."""
        times = {"signed": self.signed, "expires": self.expires}
        iso = {name: None if time is None else time.isoformat() for name, time in times.items()}
        return {"name": self.name, "fingerprint": self.fingerprint, "kind": self.kind, **iso, "words": self.words}

    @property
    def words(self) -> str:
        """In one line, for a person."""
        on = "" if self.signed is None else f" on {self.signed:%Y-%m-%d}"
        until = "" if self.expires is None else f", until {self.expires:%Y-%m-%d}"
        return f"{self.name} (key {self.fingerprint[:16]}){on}{until}"

    def ending(self, now: datetime | None = None) -> str:
        """Warning that the signature ends within ``ENDS_SOON``, or has ended, in one line; else empty."""
        left = None if self.expires is None else self.expires - (now or datetime.now(UTC))
        if left is None or left > ENDS_SOON:
            return ""
        when = f"{'ends' if left >= timedelta(0) else 'ended'} on {self.expires:%Y-%m-%d}"
        return f"the file's signature {when}; after that a loop runs on, but none starts: have the file signed again"


def signature_of(path: Path) -> Path:
    """Where the signature of a file lies: beside it, .sig after its whole name."""
    if not path.name:
        raise SignatureError(f"{path} is a folder; give a controller's .onnx file")
    return path.with_name(path.name + SUFFIX)


def public_keys(trusted: Trusted) -> list[PublicKey]:
    """The keys; SignatureError where there is none, or a file holds none."""
    if isinstance(trusted, str | PathLike | PublicKey):
        raise SignatureError(f"trusted is {str(trusted)!r}; it must be a list of public keys' files")
    keys = [key if isinstance(key, PublicKey) else PublicKey.read(key) for key in trusted]
    if not keys:
        raise SignatureError("trusted names no public key, so no file could pass; name one, or leave trusted out")
    return keys


def verified(
    path: str | PathLike[str],
    trusted: Trusted,
    *,
    now: datetime | None = None,
    signature: str | PathLike[str] | None = None,
) -> Signed:
    """Signer of a controller's file.

    Parameters
    ----------
    path
        The controller's file. Its manifest's JSON file, where one lies beside it, must be signed with it.
    trusted
        Public keys, or their PEM files.
    now
        When the signature must hold; None: now, by this machine's clock.
    signature
        The signature's file; None: ``path`` with .sig after its name.

    Raises
    ------
    SignatureError
        The file is unsigned, or signed by none of the keys; the signature is malformed, expired, or of another
        file; the file or its manifest has changed since.
    """
    keys, path = public_keys(trusted), Path(path)
    try:
        envelope = bundle.read(_signature(path, Path(signature) if signature is not None else signature_of(path)))
        key = _signer(envelope, keys)
        statement = Statement.read(envelope.payload)
        _in_time(statement, now or datetime.now(UTC))
        sha256 = _unchanged(path, statement)
    except SignatureError as error:
        raise SignatureError(f"{path}: {error}") from None
    names = tuple(sorted(statement.files))
    return Signed(key.name, key.fingerprint, key.kind, sha256, names, statement.signed, statement.expires)


def _signature(path: Path, signature: Path) -> bytes:
    try:
        return contents(signature, bundle.MAX_SIGNATURE_BYTES)
    except FileNotFoundError:
        raise SignatureError(
            f"it is not signed: there is no {signature.name} beside it; ask its maker for one (`loopwright sign`)"
        ) from None


def _signer(envelope: bundle.Envelope, keys: Sequence[PublicKey]) -> PublicKey:
    """The key that signed; the hint only chooses among the trusted ones, and proves nothing."""
    known = ", ".join(key.words for key in keys)
    meant = [key for key in keys if envelope.hint in ("", key.fingerprint)]
    if not meant:
        raise SignatureError(f"it is signed by the key {envelope.hint[:16]}, which is not trusted; trusted: {known}")
    data = bundle.pae(envelope.payload)
    for key in meant:
        if key.signed(envelope.signature, data):
            return key
    raise SignatureError(
        f"its signature is not by {' or '.join(k.words for k in meant)}: it was forged or changed; ask its maker for it"
    )


def _in_time(statement: Statement, now: datetime) -> None:
    if statement.expires is None:
        return
    if now > statement.expires:
        raise SignatureError(
            f"its signature expired on {statement.expires:%Y-%m-%d %H:%M} UTC (this machine's clock: "
            f"{now:%Y-%m-%d %H:%M} UTC); ask its maker to sign it anew"
        )
    if statement.signed is not None and now < statement.signed - SLACK:
        raise SignatureError(
            f"its signature is from {statement.signed:%Y-%m-%d %H:%M} UTC, but this machine's clock says "
            f"{now:%Y-%m-%d %H:%M} UTC, so it cannot be told whether it expired; set the clock"
        )


def _unchanged(path: Path, statement: Statement) -> str:
    """The file's SHA-256, after it and its manifest's JSON file were compared with what was signed."""
    if path.name not in statement.files:
        named = ", ".join(sorted(statement.files))[:200]
        raise SignatureError(f"its signature is that of another file ({named}); a signed file keeps its name")
    sidecar = path.with_suffix(".json")
    for file, most in ((path, audit.MAX_GRAPH_BYTES), (sidecar, MAX_SIDECAR)):
        wanted = statement.files.get(file.name)
        try:
            data = contents(file, most)
        except FileNotFoundError:
            if wanted is not None:
                raise SignatureError(f"{file.name} was signed but is not there; get it from its maker") from None
            continue
        if wanted is None:
            raise SignatureError(f"{file.name} lies beside it and is not signed; remove it, or sign both anew")
        if file_digest(data) != wanted:
            raise SignatureError(
                f"{file.name} was changed since it was signed (its SHA-256 is {file_digest(data)[:16]}..., signed was "
                f"{wanted[:16]}...); get it from its maker"
            )
    return statement.files[path.name]
