"""A client's own certificate: what a server recognizes this loop by."""

from __future__ import annotations

import asyncio
import os
import socket
from pathlib import Path

from asyncua.crypto.cert_gen import setup_self_signed_certificate
from cryptography.x509.oid import ExtendedKeyUsageOID

from serving.opcua.link import APPLICATION


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
