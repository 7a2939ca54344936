"""Certificates: what a server recognizes this loop by, and until when."""

from __future__ import annotations

import asyncio
import os
import socket
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from asyncua.crypto.cert_gen import setup_self_signed_certificate
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.rsa import RSAPrivateKey
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.hazmat.primitives.serialization import load_der_private_key, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID

from loopwright.serving.errors import LoopError
from loopwright.serving.opcua.settings import Server

APPLICATION = "urn:loopwright:client"
PEM = b"-----BEGIN"
ENDS_SOON = timedelta(days=30)  # before its end: the server must be given another one to trust
RENEWAL = (
    "remove it and its key: `loopwright loop init CONTROLLER --out spare.toml` makes new ones, for the server to trust"
)
ASK = "ask whoever runs the server for a new one"  # of a user's certificate, which nobody makes here


def make(certificate: Path, key: Path) -> None:
    """Make a certificate and its private key, where they are not there yet; nobody else may read the key."""
    certificate.parent.mkdir(parents=True, exist_ok=True)
    before = os.umask(0o077)
    try:
        asyncio.run(
            setup_self_signed_certificate(
                key, certificate, APPLICATION, socket.gethostname(), [ExtendedKeyUsageOID.CLIENT_AUTH], {}
            )
        )
    finally:
        os.umask(before)
    certificate.chmod(0o644)


def valid_until(certificate: Path) -> str:
    """The last day of a certificate, as YYYY-MM-DD. LoopError for a file that is none."""
    return until(certificate).date().isoformat()


def until(certificate: Path) -> datetime:
    """The end of a certificate. LoopError for a file that is none."""
    return _read(certificate).not_valid_after_utc


class Expiry(NamedTuple):
    """When a certificate ends by which the loop connects, and what to do then."""

    whose: str
    end: datetime
    cure: str = RENEWAL

    def words(self, now: datetime | None = None) -> str:
        """Warning that it ends within ``ENDS_SOON``, or has ended, in one line; else empty."""
        left = self.end - (now or datetime.now(UTC))
        if left > ENDS_SOON:
            return ""
        when = f"{'ends' if left >= timedelta(0) else 'ended'} on {self.end:%Y-%m-%d}"
        return f"the {self.whose}'s certificate {when}; after that no server lets the loop connect: {self.cure}"


def expiries(server: Server) -> list[Expiry]:
    """Names of the loop's certificate and its user's. A file that is none is told when the loop connects."""
    if server.security == "None":
        return []
    found = []
    for whose, path, cure in (("loop", server.certificate, RENEWAL), ("user", server.user_certificate, ASK)):
        with suppress(LoopError):
            found += [Expiry(whose, until(path), cure)] if path is not None else []
    return found


def identity(certificate: Path, key: Path) -> tuple[x509.Certificate, PrivateKeyTypes]:
    """A user's certificate and its private key (DER or PEM, RSA). LoopError where they are not such or no pair."""
    found, private = require_valid(certificate, ASK), _key(key)
    if not isinstance(private, RSAPrivateKey):
        raise LoopError(f"{key} is no RSA key, and OPC UA's policies sign with RSA")
    if private.public_key() != found.public_key():
        raise LoopError(f"{key} is not the key of {certificate}")
    return found, private


def last_day(der: bytes) -> str:
    """The last day of a certificate that a server showed."""
    try:
        return x509.load_der_x509_certificate(der).not_valid_after_utc.date().isoformat()
    except ValueError:
        return "a day that cannot be read"


def require_valid(certificate: Path, cure: str = RENEWAL) -> x509.Certificate:
    """A certificate. LoopError for a file that is none, and for one whose time is over or has not come."""
    found, now = _read(certificate), datetime.now(UTC)
    if now > found.not_valid_after_utc:
        raise LoopError(f"{certificate} was valid until {found.not_valid_after_utc:%Y-%m-%d}; {cure}")
    if now < found.not_valid_before_utc:
        first = f"{found.not_valid_before_utc:%Y-%m-%d}"
        raise LoopError(f"{certificate} is valid from {first} on; is this machine's clock right?")
    return found


def _read(certificate: Path) -> x509.Certificate:
    try:
        data = certificate.read_bytes()
    except OSError as error:
        hint = "; `loopwright loop init` makes the loop's own" if isinstance(error, FileNotFoundError) else ""
        raise LoopError(f"{certificate} cannot be read: {error.strerror}{hint}") from None
    try:
        return x509.load_pem_x509_certificate(data) if PEM in data else x509.load_der_x509_certificate(data)
    except ValueError:
        raise LoopError(f"{certificate} is no certificate (DER or PEM)") from None


def _key(key: Path) -> PrivateKeyTypes:
    try:
        data = key.read_bytes()
    except OSError as error:
        raise LoopError(f"{key} cannot be read: {error.strerror}") from None
    try:
        return load_pem_private_key(data, None) if PEM in data else load_der_private_key(data, None)
    except TypeError:
        raise LoopError(f"{key} is locked by a pass phrase; take it off (`openssl pkey -in KEY -out NEW`)") from None
    except (ValueError, UnsupportedAlgorithm):
        raise LoopError(f"{key} is no private key (DER or PEM)") from None
