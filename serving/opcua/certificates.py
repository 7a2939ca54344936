"""Certificates: what a server recognizes this loop by, and until when."""

from __future__ import annotations

import asyncio
import os
import socket
from datetime import UTC, datetime, timedelta
from pathlib import Path

from asyncua.crypto.cert_gen import setup_self_signed_certificate
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from serving.errors import LoopError

APPLICATION = "urn:loopwright:client"
ENDS_SOON = timedelta(days=30)  # before its end: the server must be given another one to trust
RENEWAL = (
    "remove it and its key: `loopwright loop init CONTROLLER --out spare.toml` makes new ones, for the server to trust"
)


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


def ending(end: datetime, now: datetime | None = None) -> str:
    """That this loop's certificate ends within ``ENDS_SOON``, or has ended, in one line; else empty."""
    left = end - (now or datetime.now(UTC))
    if left > ENDS_SOON:
        return ""
    when = f"{'ends' if left >= timedelta(0) else 'ended'} on {end:%Y-%m-%d}"
    return f"the loop's certificate {when}; after that no server lets it connect: {RENEWAL}"


def last_day(der: bytes) -> str:
    """The last day of a certificate that a server showed."""
    try:
        return x509.load_der_x509_certificate(der).not_valid_after_utc.date().isoformat()
    except ValueError:
        return "a day that cannot be read"


def require_valid(certificate: Path) -> None:
    """LoopError for a file that is no certificate, and for one whose time is over or has not come."""
    found, now = _read(certificate), datetime.now(UTC)
    if now > found.not_valid_after_utc:
        raise LoopError(f"{certificate} was valid until {valid_until(certificate)}; {RENEWAL}")
    if now < found.not_valid_before_utc:
        first = f"{found.not_valid_before_utc:%Y-%m-%d}"
        raise LoopError(f"{certificate} is valid from {first} on; is this machine's clock right?")


def _read(certificate: Path) -> x509.Certificate:
    try:
        data = certificate.read_bytes()
    except OSError as error:
        raise LoopError(f"{certificate} cannot be read: {error.strerror}; `loopwright loop init` makes one") from None
    try:
        return x509.load_pem_x509_certificate(data) if b"-----BEGIN" in data else x509.load_der_x509_certificate(data)
    except ValueError:
        raise LoopError(f"{certificate} is no certificate (DER or PEM)") from None
