"""The door of a running loop on its own machine: requests in, answers out, both lines of JSON."""

from __future__ import annotations

import hashlib
import json
import os
import socket
import socketserver
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

from loopwright.serving.errors import LoopError, LoopwrightError, NotProvenError
from loopwright.serving.first_steps import DEADLINE_S
from loopwright.serving.station.mv_lock import runtime_folder
from loopwright.serving.words import first_line, named, plain

Answer: TypeAlias = dict[str, Any]

LONGEST_REQUEST = 100_000  # bytes of a request
CONTROL_PATIENCE_S = 10.0  # [s] to wait for the loop's answer (a swap's longer), and for a request's line


class Control:
    """Answers whoever of this user knocks at the socket of a journal. Others cannot enter its folder.

    Whoever opens it has the journal's lock. ``answer`` gets each request as it came and is called in threads of its
    own; what it raises on purpose is told.
    """

    def __init__(self, journal: Path, answer: Callable[[Any], Answer]) -> None:
        self._journal, self._answer = journal, answer
        self.path = door(journal)
        with suppress(FileNotFoundError):
            self.path.unlink()  # of a loop that was killed; the journal's lock says that none lives
        self._server = self._opened()

    def tend(self) -> None:
        """Keep the socket from those who clean temporary folders: young, and made anew where it is gone."""
        try:
            os.utime(door(self._journal))
        except FileNotFoundError:
            gone, self._server = self._server, self._opened()
            gone.shutdown()
            gone.server_close()

    def close(self) -> None:
        """Answer no more."""
        self._server.shutdown()
        self._server.server_close()
        self.path.unlink(missing_ok=True)

    def _opened(self) -> _Server:
        server = _Server(str(self.path), _Handler)
        server.answer = self._answer
        threading.Thread(target=server.serve_forever, args=(0.2,), name="control", daemon=True).start()
        return server


def door(journal: Path) -> Path:
    """The socket of the loop that writes a journal. Its path is short: a socket's may have 100 characters."""
    return runtime_folder() / (hashlib.sha256(os.fsencode(journal.resolve())).hexdigest()[:24] + ".loop")


def ask(journal: Path, request: Answer, patience_s: float = CONTROL_PATIENCE_S) -> Answer:
    """Ask the loop that writes a journal. LoopError where none runs, or it refuses."""
    answer = asked(door(journal), request, patience_s)
    if "error" in answer:
        raise LoopError(str(answer["error"]))
    return answer


def asked(path: Path, request: Answer, patience_s: float = CONTROL_PATIENCE_S) -> Answer:
    """The answer at a socket, a refusal too. LoopError where nobody answers.

    A swap is waited for longer: the loop first has the new file tried by another process.
    """
    patience_s += DEADLINE_S if isinstance(request, dict) and request.get("do") == "swap" else 0.0
    text = json.dumps(request).encode() + b"\n"
    if len(text) > LONGEST_REQUEST:
        raise LoopError(
            f"the request has {len(text)} bytes; the loop takes {LONGEST_REQUEST}: give a course in fewer points, or "
            "signal by signal"
        )
    try:
        with socket.socket(socket.AF_UNIX) as wire:
            wire.settimeout(patience_s)
            wire.connect(str(path))
            wire.sendall(text)
            with wire.makefile("rb") as said:
                line = said.readline()
        answer = json.loads(line)
    except (FileNotFoundError, ConnectionRefusedError):
        raise LoopError("no loop runs with this journal; `loopwright loop run` starts it") from None
    except (OSError, ValueError) as error:
        raise LoopError(f"the loop does not answer: {named(error)}") from None
    if not isinstance(answer, dict):
        raise LoopError("the loop gives no answer that can be read")
    return answer


class _Server(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True
    request_queue_size = 32
    answer: Callable[[Any], Answer]


class _Handler(socketserver.StreamRequestHandler):
    timeout = CONTROL_PATIENCE_S

    def handle(self) -> None:
        """One request, one answer."""
        with suppress(OSError):
            self.wfile.write(json.dumps(self._said(), allow_nan=False).encode() + b"\n")

    def _said(self) -> Answer:
        assert isinstance(self.server, _Server)
        try:
            line = self.rfile.readline(LONGEST_REQUEST)
            if not line.endswith(b"\n"):
                raise LoopError(f"a request is one line of JSON of at most {LONGEST_REQUEST} bytes")
            return self.server.answer(json.loads(line))
        except NotProvenError as error:  # whoever asked may give the word
            return {"error": first_line(error), "needs": "accept_unproven", "unproven": plain(error.why)}
        except LoopwrightError as error:
            return {"error": first_line(error), **({"entry": plain(error.entry)} if error.entry else {})}
        except Exception as error:
            return {"error": f"the request cannot be read: {named(error)}"}
