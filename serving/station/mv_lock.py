"""One loop an MV: a lock that a second loop on this machine finds taken."""

from __future__ import annotations

import hashlib
import ipaddress
import os
import socket
import stat
import tempfile
import threading
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

from loopwright.serving.errors import LoopError
from loopwright.serving.journal.file import LockTakenError, locked
from loopwright.serving.loop import ControlLoop, Mode
from loopwright.serving.opcua.nameplates import Identity
from loopwright.serving.station.recorder import Recorder
from loopwright.serving.words import first_line


def runtime_folder(folder: Path | None = None) -> Path:
    """A folder that only this user may enter, made where it is not there yet.

    Raises LoopError where somebody else made it first, or opened it to others, and on a system that tells no users
    apart and has no Unix sockets.
    """
    if not hasattr(os, "getuid"):
        raise LoopError("`loopwright loop` runs on Linux and macOS; on Windows run it in WSL, or embed ControlLoop")
    place = folder or Path(tempfile.gettempdir()) / f"loopwright-{os.getuid()}"
    place.mkdir(mode=0o700, exist_ok=True)
    found = place.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise LoopError(f"{place} must be a folder of this user that nobody else may enter; remove it")
    return place


# ------------------------------------------------------------------------------------------------------------ the lock
OPC_UA_PORT, DISCARD_PORT = 4840, 9  # IANA: of a server whose address names none; of a socket that sends nothing


class Lease:
    """Locks for the nodes of a server that a loop writes, kept until ``release`` or the end of the process.

    The locks are files in a folder for temporary ones: ``tend`` keeps them young, and makes one anew that is gone. A
    node that another loop has locked meanwhile is lost: ``lost`` says so, until ``tend`` has it back.

    The first locks are of the nodes as they are spelt. Once the server is known, ``claim`` locks them by what they are,
    since a host and an id can be written in many ways. The loop that writes claims; ``disclaim`` leaves them to the
    others.

    Raises LoopError that names the process which has one, OSError where a lock cannot be opened.
    """

    def __init__(self, endpoint: str, nodes: Iterable[str], folder: Path | None = None) -> None:
        self._folder, self._endpoint, self._address = folder, endpoint, address_of(endpoint)
        self._held: dict[str, int] = {}  # handles by node
        self._lost: Mapping[str, str] = {}  # by node, who has it; replaced as a whole, as other threads read it
        self._claimed: dict[str, str] = {}  # how a node is spelt, by what the server calls it
        self._claims = False  # whether those are to be had: a loop that writes nothing leaves them to the others
        self._tending = threading.Lock()
        try:
            for node in nodes:
                self._held[node] = self._locked(node)
        except (LoopError, OSError):
            self.release()
            raise

    def claim(self, writes: Mapping[str, str], nodes: Mapping[str, str] | None = None) -> None:
        """Lock nodes by what the server calls them, in place of those claimed before: all of them or none.

        ``writes`` names them by the server's own name and start, which is known also where its address is spelt another
        way; ``nodes`` by their namespaces alone, and they are locked at this address, which a server that starts anew
        keeps: the loop that writes has them until it ends. Each is given with its spelling.

        A node that another loop has locked counts as ``lost``.
        """
        wanted = {**{f"at {self._address} {name}": text for name, text in (nodes or {}).items()}, **writes}
        with self._tending:
            self._drop(key for key in self._claimed if key not in wanted)
            self._lost = {key: who for key, who in self._lost.items() if key in wanted or key not in self._claimed}
            self._claimed, self._claims = wanted, True
            self._claim()

    def disclaim(self) -> None:
        """Nothing is written: whoever claims the nodes now has them. ``lost`` says still who had them."""
        if self._claims:
            with self._tending:
                self._claims = False
                self._drop(self._claimed)

    def tend(self) -> None:
        """Keep all files. LoopError where another loop has a node, OSError where a file cannot be made or locked."""
        troubles: list[LoopError | OSError] = []
        with self._tending:
            for node in [key for key in self._held if key not in self._claimed]:
                try:
                    self._tend(node)
                except (LoopError, OSError) as error:
                    troubles.append(error)
            troubles += self._claim()
        if troubles:
            raise troubles[0]

    @property
    def lost(self) -> str:
        """Why this loop may not write, as far as it was looked at: another one has a node. Empty: it may."""
        return next(iter(self._lost.values()), "")

    def _claim(self) -> list[LoopError | OSError]:
        """Have the nodes by what the server calls them, all or none: of two loops that share some, one writes.

        Where none are to be had, see whether those that others had are free now.
        """
        troubles: list[LoopError | OSError] = []
        for key in self._claimed:
            if self._claims or key in self._lost:
                try:
                    self._tend(key)
                except (LoopError, OSError) as error:  # a lock that cannot be made says nothing of another loop
                    troubles.append(error)
        if not self._claims or any(isinstance(error, LoopError) for error in troubles):
            self._drop(self._claimed)
        return troubles

    def _tend(self, node: str) -> None:
        path, handle = self._path(node), self._held.get(node)
        if handle is not None and path.exists() and os.path.samestat(path.stat(), os.fstat(handle)):
            os.utime(path)
            return
        try:
            self._held[node] = self._locked(node)
        except LoopError as error:
            self._lost = {**self._lost, node: first_line(error)}
            raise
        if handle is not None:
            os.close(handle)
        self._lost = {key: who for key, who in self._lost.items() if key != node}

    def release(self) -> None:
        """Let others have the nodes."""
        self._drop(self._held)

    def _drop(self, nodes: Iterable[str]) -> None:
        """Close locks, and take their files away, which nobody would."""
        for node in [key for key in nodes if key in self._held]:
            handle = self._held.pop(node)
            with suppress(LoopError, OSError):  # the file is gone already, or the folder is
                path = self._path(node)
                if os.path.samestat(path.stat(), os.fstat(handle)):
                    path.unlink()
            os.close(handle)

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
    """Whether an address is one of this machine: what is sent to it leaves from it.

    A socket that can be bound to it is no sign: Linux may let it be bound to any (``net.ipv4.ip_nonlocal_bind``).
    """
    at = _plain(address)
    if at.is_loopback or at.is_unspecified:
        return True
    try:
        with socket.socket(socket.AF_INET6 if at.version == 6 else socket.AF_INET, socket.SOCK_DGRAM) as tried:
            tried.connect((str(at), DISCARD_PORT))  # sends nothing
            return _plain(str(tried.getsockname()[0])) == at
    except OSError:
        return False


def _plain(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """An address without its zone; one of IPv4 in an IPv6 coat as itself."""
    at = ipaddress.ip_address(address.partition("%")[0])
    return (at.ipv4_mapped or at) if isinstance(at, ipaddress.IPv6Address) else at


# ----------------------------------------------- the locks while a loop runs, with an alarm where another loop has one
ALARM = "lease"


class Locks:
    """Claims the nodes for the loop that writes, and owns the alarm that another loop has one.

    A shadow leaves them to the loop that writes: once the server has started anew, all must lock its nodes anew.
    """

    def __init__(self, lease: Lease, recorder: Recorder) -> None:
        self._lease, self._recorder = lease, recorder
        self._found: Identity | None = None  # the server of the last connection
        self._claimed: Identity | None = None  # as whose the nodes are claimed now; None: they are not
        self._untended = ""  # what keeps the files from being looked after, other than another loop
        self._told, self._telling = "", threading.Lock()  # the alarm as it stands in the journal

    def identified(self, found: Identity, *, writes: bool) -> None:
        """The server is known: a loop that ``writes`` claims its nodes before anything can be written there."""
        self._found = found
        if writes:
            self._claim(found)

    def keep(self, loop: ControlLoop) -> None:
        """Have the nodes while the loop writes. It goes to SHADOW while another loop has one, whoever asks for what."""
        if loop.mode is Mode.SHADOW:
            self._claimed = None
            self._lease.disclaim()
            return
        if self._claimed is not self._found and self._found is not None:
            self._claim(self._found)
        if self._lease.lost:
            with suppress(LoopError, OSError):
                self._lease.tend()  # the other loop may have ended since, or only have looked whether it is free
        self._tell()
        if self._lease.lost:
            words = f"mode {loop.mode} -> {Mode.SHADOW}"
            self._recorder.note("change", "loop", words, self._lease.lost, mode=Mode.SHADOW)
            loop.set_mode(Mode.SHADOW)

    def tend(self) -> None:
        """Keep the files; OSError where they cannot be kept."""
        try:
            with suppress(LoopError):  # ``lost`` says so
                self._lease.tend()
        finally:
            self._tell()

    def untended(self, trouble: str) -> None:
        """The obstacle to looking after the loop's files; empty without one."""
        self._untended = trouble
        self._tell()

    def _claim(self, found: Identity) -> None:
        self._claimed = found
        self._lease.claim(found.writes, found.nodes)

    def _tell(self) -> None:
        """Begin or end the alarm, whoever has found out: it tells what holds now, and nothing twice."""
        with self._telling:
            trouble = self._lease.lost or self._untended
            if trouble != self._told:
                self._told = trouble
                what = trouble or "over: the locks of this loop are kept again"
                self._recorder.note("fault", "loop", what, alarm=ALARM, raised=bool(trouble))
