"""The operator's page as its loop sees it: where it is served and to whom; its process started, watched, begun anew."""

from __future__ import annotations

import ipaddress
import json
import secrets
import socket
import ssl
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loopwright.serving.errors import LoopError
from loopwright.serving.first_steps import module
from loopwright.serving.words import named


def listening(page: Page) -> socket.socket:
    """A socket that listens where the page is to be. LoopError where it cannot."""
    host, port = page.address
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family, backlog=128)
    except OSError as error:
        raise LoopError(f"the page cannot listen at {page.listen}: {error.strerror or error}") from None


def require_usable(page: Page) -> None:
    """LoopError where the page's certificate or key cannot be used."""
    if page.certificate is None:
        return
    try:
        # A key that is locked by a password would be asked for at the terminal.
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(page.certificate, page.private_key, lambda: "")
    except OSError as error:  # ssl.SSLError too
        raise LoopError(f"the page's certificate or key cannot be used: {named(error)}") from None


# ------------------------------------------------------------------------------------------------------------ settings
LOOPBACK = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True, slots=True)
class Page:
    """The address of the page.

    Changes need the token, which the loop makes and prints at its start unless ``token_file`` has it. An address that
    others can reach needs ``allow_remote``, ``certificate`` and ``private_key`` (PEM); ``names`` are the host names,
    with port where it is not 443, by which browsers then reach it.
    """

    listen: str
    token_file: Path | None = None
    allow_remote: bool = False
    certificate: Path | None = None
    private_key: Path | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        host, port = self.address
        if not self.local and not self.allow_remote:
            raise LoopError(
                f"page listens at {host}, which other machines can reach; use 127.0.0.1:{port}, or say "
                "allow_remote = true with a certificate and private_key"
            )
        if (self.certificate is None) != (self.private_key is None):
            raise LoopError("page.certificate and page.private_key go together")
        if not self.local and self.certificate is None:
            raise LoopError("a page that other machines can reach needs TLS: page.certificate and page.private_key")

    @property
    def address(self) -> tuple[str, int]:
        """Host and port; LoopError where ``listen`` names none."""
        host, _, port = self.listen.rpartition(":")
        host = host.removeprefix("[").removesuffix("]")
        if not host or not port.isascii() or not port.isdigit() or not 0 <= int(port) < 65536:
            raise LoopError(f"page listens at {self.listen!r}; it must be HOST:PORT, such as 127.0.0.1:8080")
        return host, int(port)

    @property
    def local(self) -> bool:
        """Whether only this machine can reach it."""
        host, _ = self.address
        if host == "localhost":
            return True
        try:
            return ipaddress.ip_address(host).is_loopback
        except ValueError:
            return False

    def hosts(self, port: int) -> list[str]:
        """Allowed Host headers of a browser: at the port of its scheme it names none."""
        host, _ = self.address
        shown = f"[{host}]" if ":" in host else host
        names = list(dict.fromkeys((shown.lower(), "localhost", "127.0.0.1", "[::1]")))
        bare = names if port == (80 if self.certificate is None else 443) else []
        return [*(f"{name}:{port}" for name in names), *bare, *(n.lower() for n in self.names)]

    def token(self) -> str:
        """The token in ``token_file``; empty without one. LoopError where it is too short to be one."""
        if self.token_file is None:
            return ""
        try:
            token = self.token_file.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise LoopError(f"page.token_file cannot be read: {error}") from None
        if len(token) < 16 or not token.isascii() or not token.isprintable():
            raise LoopError(f"page.token_file {self.token_file} must hold a token of at least 16 ASCII characters")
        return token


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
