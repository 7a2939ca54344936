"""One loop an MV: a lock that a second loop on this machine finds taken."""

from __future__ import annotations

import hashlib
import ipaddress
import os
import socket
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import urlsplit

from serving.errors import LoopError
from serving.station.places import runtime_folder

OPC_UA_PORT = 4840


class Lease:
    """Locks for the nodes of a server that a loop writes, kept until ``release`` or the end of the process.

    The locks are files in a folder for temporary ones: ``tend`` keeps them young, and makes one anew that is gone.

    Raises LoopError that names the process which has one.
    """

    def __init__(self, endpoint: str, nodes: Iterable[str], folder: Path | None = None) -> None:
        self._folder, self._endpoint, self._address = folder, endpoint, address_of(endpoint)
        self._held: dict[str, int] = {}  # handles by node
        try:
            for node in nodes:
                self._held[node] = self._locked(node)
        except LoopError:
            self.release()
            raise

    def tend(self) -> None:
        """Keep the files. LoopError where one was removed and another loop has it now."""
        for node, handle in self._held.items():
            path = self._path(node)
            if path.exists() and os.path.samestat(path.stat(), os.fstat(handle)):
                os.utime(path)
            else:
                self._held[node] = self._locked(node)
                os.close(handle)

    def release(self) -> None:
        """Let others have the nodes."""
        while self._held:
            os.close(self._held.popitem()[1])

    def _path(self, node: str) -> Path:
        return runtime_folder(self._folder) / hashlib.sha256(f"{self._address} {node}".encode()).hexdigest()[:32]

    def _locked(self, node: str) -> int:
        path = self._path(node)
        import fcntl  # which Windows lacks; the line above has said so there

        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            owner = os.read(handle, 100).decode(errors="replace")
            os.close(handle)
            raise LoopError(
                f"{node} at {self._endpoint} is written by another loop (process {owner}); end that one first"
            ) from None
        os.truncate(handle, 0)
        os.write(handle, str(os.getpid()).encode())
        return handle


def address_of(endpoint: str) -> str:
    """Where a server listens, however its host is spelt: ``localhost``, 127.0.0.1 and ::1 are the same one."""
    try:
        parts = urlsplit(endpoint)
        host, port = parts.hostname or "", parts.port or OPC_UA_PORT
    except ValueError:
        return endpoint
    try:
        found = sorted({str(row[4][0]) for row in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)})
    except OSError:
        return f"{host}:{port}"
    if any(ipaddress.ip_address(address.partition("%")[0]).is_loopback for address in found):
        return f"this machine:{port}"
    return f"{found[0]}:{port}"
