"""Keys: P-256 (ECDSA with SHA-256) and Ed25519, in PEM files. The only importer of cryptography for signatures."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal, TypeAlias, get_args

from loopwright.serving.controller_file import contents
from loopwright.serving.errors import SignatureError

try:
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec, ed25519
except ModuleNotFoundError:
    raise SignatureError("signatures need the package cryptography: pip install 'loopwright[sign]'") from None

Kind: TypeAlias = Literal["p256", "ed25519"]
KINDS: tuple[Kind, ...] = get_args(Kind)
MAX_KEY_BYTES = 16 * 2**10  # of a key's file
SHORT_FINGERPRINT = 16  # digits of a fingerprint in a message
_Public: TypeAlias = ec.EllipticCurvePublicKey | ed25519.Ed25519PublicKey
_Private: TypeAlias = ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey


@dataclass(frozen=True, slots=True)
class PublicKey:
    """A public key, with the name that its holder here gave it: that of its file."""

    name: str
    _key: _Public

    @property
    def kind(self) -> Kind:
        """The kind of key."""
        return "ed25519" if isinstance(self._key, ed25519.Ed25519PublicKey) else "p256"

    @property
    def pem(self) -> bytes:
        """The key as its file holds it."""
        form = serialization.PublicFormat.SubjectPublicKeyInfo
        return self._key.public_bytes(serialization.Encoding.PEM, form)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the PEM text, hexadecimal: the hint in a bundle, and what sha256sum prints of the file."""
        return hashlib.sha256(self.pem).hexdigest()

    @property
    def words(self) -> str:
        """Name, and the start of the fingerprint."""
        return f"{self.name} (key {self.fingerprint[:SHORT_FINGERPRINT]})"

    def signed(self, signature: bytes, data: bytes) -> bool:
        """Whether this key signed the data."""
        try:
            if isinstance(self._key, ed25519.Ed25519PublicKey):
                self._key.verify(signature, data)
            else:
                self._key.verify(signature, data, ec.ECDSA(hashes.SHA256()))
        except InvalidSignature:
            return False
        return True

    @classmethod
    def read(cls, path: str | PathLike[str]) -> PublicKey:
        """The key in a PEM file; SignatureError for a file that is none, and for other kinds of key."""
        data = _contents(Path(path))
        if b"PRIVATE KEY" in data:
            raise SignatureError(
                f"{path} is a private key; only its owner may have it: give the public one ({_pub(path)})"
            )
        try:
            key = serialization.load_pem_public_key(data)
        except (ValueError, UnsupportedAlgorithm):
            raise SignatureError(f"{path} is no public key in PEM form; `loopwright keygen` makes one") from None
        if not isinstance(key, ed25519.Ed25519PublicKey) and not _is_p256(key):
            raise SignatureError(f"{path} is a key of another kind; allowed are P-256 and Ed25519")
        return cls(Path(path).stem, key)  # type: ignore[arg-type]  # just checked


@dataclass(frozen=True, slots=True)
class PrivateKey:
    """A key that signs. Its text and its repr hold nothing of the key."""

    name: str
    _key: _Private

    def __repr__(self) -> str:
        return f"PrivateKey({self.name})"

    @property
    def public(self) -> PublicKey:
        """A key that verifies."""
        return PublicKey(self.name, self._key.public_key())

    def sign(self, data: bytes) -> bytes:
        """A signature of the data."""
        if isinstance(self._key, ed25519.Ed25519PrivateKey):
            return self._key.sign(data)
        return self._key.sign(data, ec.ECDSA(hashes.SHA256()))

    @classmethod
    def made(cls, name: str, kind: Kind) -> PrivateKey:
        """A new key."""
        key = ed25519.Ed25519PrivateKey.generate() if kind == "ed25519" else ec.generate_private_key(ec.SECP256R1())
        return cls(name, key)

    def write(self, path: Path, password: bytes | None) -> None:
        """Write the key where no file is yet, for its owner alone (0600); encrypted where there is a password.

        Raises SignatureError where a file stands there already.
        """
        lock = serialization.BestAvailableEncryption(password) if password else serialization.NoEncryption()
        form = serialization.PrivateFormat.PKCS8
        _write_new(path, self._key.private_bytes(serialization.Encoding.PEM, form, lock), 0o600)

    @classmethod
    def read(cls, path: str | PathLike[str], password: bytes | None) -> PrivateKey:
        """The key in a PEM file (PKCS 8, or what openssl and model-signing users have).

        Raises SignatureError for a file that is none, a password that is missing or wrong, another kind of key, and
        a file without a password that others may read.
        """
        data = _contents(Path(path))
        if b"PRIVATE KEY" not in data:
            raise SignatureError(f"{path} is no private key in PEM form; `loopwright keygen` makes one")
        encrypted = b"ENCRYPTED" in data
        if encrypted and not password:
            raise SignatureError(
                f"{path} has a password; name it by --password-env or --password-file, "
                "for `registry publish` by LOOPWRIGHT_SIGNING_PASSWORD"
            )
        if not encrypted and os.name == "posix" and Path(path).stat().st_mode & 0o077:
            raise SignatureError(f"{path} has no password and others may read it: chmod 600 {path}")
        try:
            key = serialization.load_pem_private_key(data, password if encrypted else None)
        except (ValueError, TypeError, UnsupportedAlgorithm):
            wrong = "its password is wrong, or it" if encrypted else "it"
            raise SignatureError(f"{path} cannot be used: {wrong} is no private key") from None
        if not isinstance(key, ed25519.Ed25519PrivateKey) and not _is_p256(key):
            raise SignatureError(f"{path} is a key of another kind; allowed are P-256 and Ed25519")
        return cls(Path(path).stem, key)  # type: ignore[arg-type]  # just checked


def make_pair(path: Path, kind: Kind, password: bytes | None) -> tuple[Path, PublicKey]:
    """Write a new private key to ``path`` and its public key beside it; the public one's file, and it."""
    if not path.name:
        raise SignatureError(f"{path} is a folder; give the private key's file, such as anna.key")
    if path.suffix == ".pub":
        raise SignatureError(
            f"{path} ends as a public key's file does; name the private key's, such as {path.stem}.key"
        )
    public = _pub(path)
    if public.exists():
        raise SignatureError(f"{public} is there already; give another name, or remove it")
    key = PrivateKey.made(path.stem, kind)
    key.write(path, password)
    _write_new(public, key.public.pem, 0o644)
    return public, key.public


def _pub(path: str | PathLike[str]) -> Path:
    return Path(path).with_suffix(".pub")


def _is_p256(key: object) -> bool:
    return isinstance(key, ec.EllipticCurvePublicKey | ec.EllipticCurvePrivateKey) and isinstance(
        key.curve, ec.SECP256R1
    )


def _contents(path: Path) -> bytes:
    try:
        return contents(path, MAX_KEY_BYTES)
    except FileNotFoundError:
        raise SignatureError(f"{path} does not exist; a key is a PEM file, see `loopwright keygen`") from None


def _write_new(path: Path, data: bytes, mode: int) -> None:
    try:
        # The mode is the file's from its first moment on: never for a moment may others read a private key.
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
    except FileExistsError:
        raise SignatureError(f"{path} is there already; give another name, or remove it") from None
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL in it
        raise SignatureError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from None
