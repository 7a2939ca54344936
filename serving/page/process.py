"""The page's process as its loop sees it: started, watched, started again."""

from __future__ import annotations

import json
import secrets
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from loopwright.serving.errors import LoopError
from loopwright.serving.first_steps import module
from loopwright.serving.page.settings import Page

START_S = 20.0  # [s] until the page's process must have said that it serves
FIRST_PAUSE_S, LAST_PAUSE_S = 1.0, 60.0  # [s] before the page's process is started again: first, longest
LEAVING_S = 0.5  # in which a loop that a signal to its whole group reaches knows that it ends


class PageProcess:
    """Serves the page until ``close``. It dies with this process, and a page that died is started again.

    Raises LoopError where it cannot listen, or its packages are not installed.
    """

    def __init__(self, page: Page, journal: Path, door: Path, tell: Callable[[str], None]) -> None:
        self.page, self._tell = page, tell
        self.token = page.token() or secrets.token_urlsafe(16)
        files = {"certificate": page.certificate, "private_key": page.private_key}
        self._told = {
            "listen": page.listen,
            "allow_remote": page.allow_remote,
            "names": page.names,
            "files": {k: None if v is None else str(v.absolute()) for k, v in files.items()},
            "journal": str(journal.absolute()),
            "door": str(door),
            "token": self.token,
        }
        self._closed = threading.Event()
        self.leaving = False  # the loop is about to end: a page that ends now is not started again
        self.url = ""
        self._process = self._started()
        self._thread = threading.Thread(target=self._keep, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the page."""
        self._closed.set()
        self._process.terminate()
        self._thread.join(5)

    def _started(self) -> subprocess.Popen[str]:
        command, environment = module("loopwright.serving.page")
        process = subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        slow = threading.Timer(START_S, process.kill)
        slow.start()
        try:
            with suppress(OSError):
                process.stdin.write(json.dumps(self._told) + "\n")
                process.stdin.flush()
            said = _read(process.stdout.readline())
        finally:
            slow.cancel()
        if "ready" not in said:
            process.kill()
            last = process.communicate()[1].strip().splitlines()[-1:]
            raise LoopError(str(said.get("error") or f"the page cannot start: {' '.join(last) or 'it ends'}"))
        self.url = str(said["ready"])
        if self.page.address[1] == 0:
            self._told["listen"] = f"{self.page.address[0]}:{self.url.rpartition(':')[2]}"
        return process

    def _keep(self) -> None:
        """Pass on what the page says; start it again when it ends."""
        pause = FIRST_PAUSE_S
        while True:
            process = self._process
            with process:
                threading.Thread(target=_drain, args=(process,), daemon=True).start()
                assert process.stdout is not None
                for line in process.stdout:
                    said = _read(line).get("line")
                    if said:
                        self._tell(str(said))
            if self._closed.wait(LEAVING_S) or self.leaving:
                return
            self._tell(f"the page has ended ({process.returncode}); it is started again")
            while not self._closed.wait(pause):
                pause = min(2 * pause, LAST_PAUSE_S)
                try:
                    self._process = self._started()
                    break
                except (LoopError, OSError) as error:
                    self._tell(str(error))
            if self._closed.is_set():
                self._process.terminate()
                return


def _drain(process: subprocess.Popen[str]) -> None:
    """Read what the page logs, so that it never waits for a reader."""
    assert process.stderr is not None
    with suppress(OSError, ValueError):
        for _ in process.stderr:
            pass


def _read(line: str) -> dict[str, Any]:
    try:
        found = json.loads(line)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
