"""One loop an MV: a lock that a second loop on this machine finds taken."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path

from serving.errors import LoopError
from serving.station.places import runtime_folder


class Lease:
    """Locks for the nodes of a server that a loop writes, kept until ``release`` or the end of the process.

    Raises LoopError that names the process which has one.
    """

    def __init__(self, endpoint: str, nodes: Iterable[str], folder: Path | None = None) -> None:
        self._held: list[int] = []
        place = runtime_folder(folder)
        import fcntl  # which Windows lacks; the line above has said so there

        for node in nodes:
            path = place / hashlib.sha256(f"{endpoint} {node}".encode()).hexdigest()[:32]
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                owner = os.read(handle, 100).decode(errors="replace")
                os.close(handle)
                self.release()
                raise LoopError(
                    f"{node} at {endpoint} is written by another loop (process {owner}); end that one first"
                ) from None
            os.truncate(handle, 0)
            os.write(handle, str(os.getpid()).encode())
            self._held.append(handle)

    def release(self) -> None:
        """Let others have the nodes."""
        while self._held:
            os.close(self._held.pop())
