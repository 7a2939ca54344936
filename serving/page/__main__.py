"""The page's process, ``python -m loopwright.serving.page``: standard input says what it must know, and ends it."""

from __future__ import annotations

import functools
import json
import os
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import uvicorn

from loopwright.serving.errors import LoopError
from loopwright.serving.page.access import TimedConnection
from loopwright.serving.page.app import PageApp
from loopwright.serving.page.process import Page, listening
from loopwright.serving.station.control import asked
from loopwright.serving.words import first_line, named

NICE = 5  # the loop comes first


def main() -> int:
    """Serve until standard input ends, which is when the loop does."""
    told: dict[str, Any] = json.loads(sys.stdin.readline())
    files = {k: Path(v) if v else None for k, v in told["files"].items()}
    page = Page(told["listen"], allow_remote=told["allow_remote"], names=tuple(told["names"]), **files)
    with suppress(OSError):
        os.nice(NICE)
    try:
        wire = listening(page)
    except LoopError as error:
        _say(error=first_line(error))
        return 2
    host, port = page.address[0], wire.getsockname()[1]
    app = PageApp(
        Path(told["journal"]), functools.partial(asked, Path(told["door"])), told["token"], lambda line: _say(line=line)
    )
    scheme = "http" if page.certificate is None else "https"
    config = uvicorn.Config(
        app.asgi(page.hosts(port), scheme),
        http=TimedConnection,
        ws="none",
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_keep_alive=15,
        timeout_graceful_shutdown=1,
        h11_max_incomplete_event_size=16_384,
        ssl_certfile=page.certificate,
        ssl_keyfile=page.private_key,
    )
    try:
        config.load()
    except OSError as error:  # ssl.SSLError too
        _say(error=f"the page's certificate or key cannot be used: {named(error)}")
        return 2
    threading.Thread(target=_end_with_the_loop, daemon=True).start()
    shown = f"[{host}]" if ":" in host else host
    _say(ready=f"{scheme}://{shown}:{port}")
    uvicorn.Server(config).run(sockets=[wire])
    return 0


def _say(**what: str) -> None:
    with suppress(OSError):
        print(json.dumps(what), flush=True)


def _end_with_the_loop() -> None:
    with suppress(OSError, ValueError):
        while sys.stdin.readline():
            pass
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
