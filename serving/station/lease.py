"""One loop an MV: a lock that a second loop on this machine finds taken."""

from __future__ import annotations

import hashlib
import ipaddress
import os
import socket
import threading
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

from serving.errors import LoopError
from serving.file_lock import LockTakenError, locked
from serving.station.places import runtime_folder
from serving.words import first_line

OPC_UA_PORT = 4840


class Lease:
    """Locks for the nodes of a server that a loop writes, kept until ``release`` or the end of the process.

    The locks are files in a folder for temporary ones: ``tend`` keeps them young, and makes one anew that is gone. A
    node that another loop has locked meanwhile is lost: ``lost`` says so, until ``tend`` has it back.

    The first locks are of the nodes as they are spelt. Once the server is known, ``claim`` locks them by what they are,
    since a host and an id can be written in many ways.

    Raises LoopError that names the process which has one, OSError where a lock cannot be opened.
    """

    def __init__(self, endpoint: str, nodes: Iterable[str], folder: Path | None = None) -> None:
        self._folder, self._endpoint, self._address = folder, endpoint, address_of(endpoint)
        self._held: dict[str, int] = {}  # handles by node
        self._lost: dict[str, str] = {}  # by node, who has it
        self._claimed: dict[str, str] = {}  # how a node is spelt, by what the server calls it
        self._tending = threading.Lock()
        try:
            for node in nodes:
                self._held[node] = self._locked(node)
        except (LoopError, OSError):
            self.release()
            raise

    def claim(self, nodes: Mapping[str, str]) -> None:
        """Lock nodes by what the server calls them, in place of those claimed before; each is given with its spelling.

        A node that another loop has locked counts as ``lost``.
        """
        with self._tending, suppress(OSError):  # a lock that cannot be made says nothing of another loop
            for key in [k for k in self._claimed if k not in nodes]:
                self._lost.pop(key, None)
                if key in self._held:
                    os.close(self._held.pop(key))
            self._claimed = dict(nodes)
            for key in nodes:
                with suppress(LoopError):  # ``lost`` says so
                    self._tend(key)

    def tend(self) -> None:
        """Keep all files. LoopError where one was removed and another loop has it now, OSError where one cannot be."""
        troubles: list[LoopError | OSError] = []
        with self._tending:
            for node in {**self._held, **self._claimed}:
                try:
                    self._tend(node)
                except (LoopError, OSError) as error:
                    troubles.append(error)
        if troubles:
            raise troubles[0]

    @property
    def lost(self) -> str:
        """Why this loop may not write, as far as it was looked at: another one has a node. Empty: it may."""
        return next(iter(self._lost.values()), "")

    def _tend(self, node: str) -> None:
        path, handle = self._path(node), self._held.get(node)
        if handle is not None and path.exists() and os.path.samestat(path.stat(), os.fstat(handle)):
            os.utime(path)
            return
        try:
            self._held[node] = self._locked(node)
        except LoopError as error:
            self._lost[node] = first_line(error)
            raise
        if handle is not None:
            os.close(handle)
        self._lost.pop(node, None)

    def release(self) -> None:
        """Let others have the nodes."""
        while self._held:
            os.close(self._held.popitem()[1])

    def _path(self, node: str) -> Path:
        name = node if node in self._claimed else f"{self._address} {node}"
        return runtime_folder(self._folder) / hashlib.sha256(name.encode()).hexdigest()[:32]

    def _locked(self, node: str) -> int:
        try:
            return locked(self._path(node))
        except LockTakenError as error:
            text = self._claimed.get(node, node)
            raise LoopError(
                f"{text} at {self._endpoint} is written by another loop (process {error.owner}); end that one first"
            ) from None


def address_of(endpoint: str) -> str:
    """Where a server listens, however its host is spelt: all addresses of this machine are the same one."""
    try:
        parts = urlsplit(endpoint)
        host, port = parts.hostname or "", parts.port or OPC_UA_PORT
    except ValueError:
        return endpoint
    try:
        found = sorted({str(row[4][0]) for row in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)})
    except OSError:
        return f"{host}:{port}"
    if any(_of_this_machine(address) for address in found):
        return f"this machine:{port}"
    return f"{found[0]}:{port}"


def _of_this_machine(address: str) -> bool:
    """Whether an address is one of this machine: a socket can be bound to no other."""
    at = ipaddress.ip_address(address.partition("%")[0])
    at = (at.ipv4_mapped or at) if isinstance(at, ipaddress.IPv6Address) else at
    if at.is_loopback or at.is_unspecified:
        return True
    try:
        with socket.socket(socket.AF_INET6 if at.version == 6 else socket.AF_INET, socket.SOCK_DGRAM) as tried:
            tried.bind((str(at), 0))
    except OSError:
        return False
    return True
