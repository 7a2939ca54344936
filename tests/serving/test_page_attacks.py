"""The operator's page under attack: nobody without the token changes anything, and nobody keeps the operator out."""

from __future__ import annotations

import asyncio
import json
import random
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPException
from pathlib import Path

import pytest
import uvicorn
from fake_loop import Browser, FakeLoop, opened
from page_requests import BODY, broken, whole
from processes import within

from loopwright.serving import Controller
from loopwright.serving.page import access, live
from loopwright.serving.page import app as page_app
from loopwright.serving.page.app import PageApp

ARTIFACTS = Path(__file__).parents[2] / "artifacts" / "thiosulfate_cstr"


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeLoop]:
    made = FakeLoop(tmp_path_factory.mktemp("loop"), Controller(ARTIFACTS / "pid.onnx"))
    yield made
    made.close()


@pytest.fixture(scope="module")
def browser(loop: FakeLoop) -> Iterator[Browser]:
    page, made = opened(loop, [])
    yield made
    page.close()


@pytest.fixture(autouse=True)
def _nothing_is_changed(loop: FakeLoop) -> Iterator[None]:
    before = len(loop.changes)
    yield
    assert loop.changes[before:] == []


def codes_of(came: bytes | bytearray) -> list[int]:
    return [int(code) for code in re.findall(rb"HTTP/1.1 (\d{3}) ", came)]


def exchanged(port: int, sent: bytes, last: bytes = b"", answers: int = 1) -> tuple[list[int], bytes]:
    """The status of each answer on one connection, and all that came; ``last`` is sent after so many answers."""
    came = bytearray()
    with socket.create_connection(("127.0.0.1", port), timeout=60) as wire, suppress(OSError):  # closed by the server
        wire.sendall(sent)
        while len(codes_of(came)) < answers and (data := wire.recv(65_536)):
            came += data
        wire.sendall(last)
        wire.shutdown(socket.SHUT_WR)
        while data := wire.recv(65_536):
            came += data
    return codes_of(came), bytes(came)


def test_ten_thousand_forged_and_malformed_requests_change_nothing(browser: Browser) -> None:
    rng, sent = random.Random(1), 0
    for _ in range(500):
        batch = [whole(rng, browser.port, browser.token) for _ in range(19)]
        codes, came = exchanged(browser.port, b"".join(batch), broken(rng, browser.port), len(batch))
        assert len(codes) >= len(batch), came[
            -500:
        ]  # those that are whole live on one connection; the last one may not
        assert all(300 <= code < 500 for code in codes[: len(batch)]), codes
        sent += len(batch) + 1
    assert sent == 10_000
    assert browser.json("/api/state")["mode"] == "AUTO"


def raw(port: int, token: str, first: str, *others: str, body: bytes = BODY, **changed: str | None) -> bytes:
    """A request of the page's own scripts with some lines changed, left out (None) or added."""
    fields: dict[str, str | None] = {
        "Host": f"127.0.0.1:{port}", "Origin": f"http://127.0.0.1:{port}", "Content-Type": "application/json",
        "Authorization": f"Bearer {token}", "Content-Length": str(len(body)),
    }  # fmt: skip
    fields |= {name.replace("_", "-"): value for name, value in changed.items()}
    lines = [first, *(f"{name}: {value}" for name, value in fields.items() if value is not None), *others]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body


CHANGE = "POST /api/change HTTP/1.1"
HUGE = b"186A0\r\n" + b"A" * 100_000 + b"\r\n0\r\n\r\n"


@pytest.mark.parametrize(
    ("first", "others", "changed", "status"),
    [
        ("POST /api/change HTTP/1.0", [], {"Host": None}, 421),
        (CHANGE, ["Host: evil.example"], {}, 400),
        (CHANGE, ["Host: 127.0.0.1"], {"Host": None}, 421),
        (CHANGE, ["Origin: https://evil.example"], {}, 403),
        (CHANGE, ["Host : evil.example"], {}, 400),
        (CHANGE, ["Authorization: Bearer x"], {"Authorization": "Bearer y"}, 401),
        (CHANGE, ["Content-Length: 5"], {}, 400),
        (CHANGE, ["Transfer-Encoding: chunked"], {"body": HUGE}, 413),
        (CHANGE, ["Transfer-Encoding: chunked"], {"body": HUGE, "Content_Length": None}, 413),
        (CHANGE, ["Transfer-Encoding: identity, chunked"], {}, 400),
        (CHANGE, ["Transfer-Encoding: xchunked"], {}, 400),
        (CHANGE, ["Content-Encoding: gzip"], {}, 413),
        (CHANGE, ["Sec-Fetch-Site: same-site"], {}, 403),
        ("POST http://evil.example/api/change HTTP/1.1", [], {}, 404),
        ("POST http://127.0.0.1/api/change HTTP/1.1", [], {}, 404),
        ("POST /api/change/ HTTP/1.1", [], {"Authorization": None}, 307),
        ("POST /static/%2e%2e/api/change HTTP/1.1", [], {}, 405),
        ("GET /api/change?do=mode HTTP/1.1", [], {}, 405),
        ("OPTIONS /api/change HTTP/1.1", ["Access-Control-Request-Method: POST"], {"Origin": "https://evil"}, 405),
        ("TRACE /api/change HTTP/1.1", [], {}, 405),
        ("PUT /api/change HTTP/1.1", [], {}, 405),
        ("CONNECT 127.0.0.1:80 HTTP/1.1", [], {}, 405),
        ("PRI * HTTP/2.0", [], {}, 405),
    ],
)  # fmt: skip
def test_a_request_that_could_be_read_in_two_ways_changes_nothing(
    browser: Browser, first: str, others: list[str], changed: dict[str, str | None], status: int
) -> None:
    codes, came = exchanged(browser.port, raw(browser.port, browser.token, first, *others, **changed))  # type: ignore[arg-type]
    assert codes == [status], came
    assert b"access-control-allow" not in came.lower()


def test_a_request_inside_a_body_is_no_request(browser: Browser) -> None:
    inner = raw(browser.port, "x", CHANGE)
    outer = raw(browser.port, "x", CHANGE, body=inner)
    assert exchanged(browser.port, outer)[0] == [401]


def test_a_socket_is_not_upgraded(browser: Browser) -> None:
    lines = [
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
    ]
    for path, status in (("/", 200), ("/api/none", 404)):
        codes, _ = exchanged(browser.port, raw(browser.port, browser.token, f"GET {path} HTTP/1.1", *lines, body=b""))
        assert codes == [status]


def test_a_token_in_an_address_is_none(browser: Browser) -> None:
    sent = raw(browser.port, browser.token, f"POST /api/change?token={browser.token} HTTP/1.1", Authorization=None)
    assert exchanged(browser.port, sent)[0] == [401]


@pytest.mark.parametrize(
    "path",
    ["/static/../app.py", "/static/%2e%2e/app.py", "/static/..%2fapp.py", "/static/%2e%2e%2fapp.py",
     "/static/%2fetc/passwd", "/static//etc/passwd",
     "/static/..%5capp.py", "/static/%252e%252e/app.py", "/static/page.css%00.js", "/static/",
     "/static", "/static/./../__main__.py", "/api/picture/..%2f..%2fetc%2fpasswd"],
)  # fmt: skip
def test_no_file_outside_the_page_is_served(browser: Browser, path: str) -> None:
    status, _, body = browser.get(path)
    assert status in {404, 307}, path
    assert b"import" not in body
    assert b"root:" not in body


@pytest.mark.parametrize(
    "value",
    [{"file": "../pid.onnx"}, {"file": "/etc/passwd"}, {"file": ".."}, {"file": "a/b.onnx"}, {"file": "a\\b.onnx"},
     {"file": ""}, {"file": 5}, "pid.onnx", None],
)  # fmt: skip
def test_a_swap_does_not_leave_the_folder(browser: Browser, value: object) -> None:
    status, answer = browser.change({"do": "swap", "value": value, "who": "anna", "reason": ""})
    assert status == 400
    assert "by name" in answer["error"]


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_another_site_may_link_to_the_page_and_read_nothing(browser: Browser, site: str) -> None:
    linked = {"Sec_Fetch_Site": site, "Sec_Fetch_Mode": "navigate", "Sec_Fetch_Dest": "document"}
    assert browser.get("/", **linked)[0] == 200
    assert browser.get("/api/state", **linked)[0] == 403
    for path in ("/", "/api/state", "/api/live", "/static/main.js", "/metrics"):
        assert browser.get(path, Sec_Fetch_Site=site, Sec_Fetch_Mode="no-cors", Sec_Fetch_Dest="image")[0] == 403


def test_heads_are_told_and_a_stream_has_no_end_to_wait_for(browser: Browser) -> None:
    for path in ("/", "/api/live", "/api/state"):
        status, headers, body = browser.send("HEAD", path, None, {})
        assert (status, body) == (200, b"")
        assert headers["Content-Security-Policy"]


# ---------------------------------------------------------------- who keeps connections
@contextmanager
def serving_here(loop: FakeLoop) -> Iterator[tuple[PageApp, Browser, uvicorn.Server]]:
    """The page in a thread of this process, whose limits a test can change."""
    app = PageApp(loop.journal, loop.answer, "token")
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = int(listening.getsockname()[1])
        config = uvicorn.Config(
            app.asgi([f"127.0.0.1:{port}"], "http"),
            http=access.TimedConnection, ws="none", log_config=None, access_log=False, timeout_graceful_shutdown=1,
        )  # fmt: skip
        server = uvicorn.Server(config)
        thread = threading.Thread(target=asyncio.run, args=(server.serve([listening]),), daemon=True)
        thread.start()
        try:
            assert within(10, lambda: server.started)
            yield app, Browser(port, "token"), server
        finally:
            server.should_exit = True
            thread.join(20)
        assert not thread.is_alive()


def connected(port: int, sent: bytes = b"", room: int | None = None) -> socket.socket:
    wire = socket.socket()
    if room is not None:
        wire.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room)
    wire.settimeout(20)
    wire.connect(("127.0.0.1", port))
    wire.sendall(sent)
    return wire


def ends(wire: socket.socket) -> bool:
    """Whether the other side closes; what it still sent is passed over."""
    with suppress(ConnectionError):
        while wire.recv(65_536):
            pass
    return True


def test_who_takes_his_time_is_cut_off(loop: FakeLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Slow-loris: connections that never finish a request, or begin a second one and never finish that."""
    monkeypatch.setattr(access, "REQUEST_S", 0.4)
    with serving_here(loop) as (_, browser, _):
        first = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n\r\n" % browser.port
        open_ones = [
            connected(browser.port, (first if i % 2 else b"") + b"GET / HTTP/1.1\r\nHost: ") for i in range(60)
        ]
        for i, wire in enumerate(open_ones):
            with wire:
                assert ends(wire), i
        assert within(20, lambda: healthy(browser))


def healthy(browser: Browser) -> bool:
    """Whether the page answers; a busy machine may take too long even for a whole request."""
    with suppress(OSError, HTTPException):
        return browser.get("/healthz")[0] == 200
    return False


def test_many_connections_keep_nobody_out(loop: FakeLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "MOST_CONNECTIONS", 20)
    monkeypatch.setattr(access, "REQUEST_S", 600.0)
    with serving_here(loop) as (_, browser, _):
        idle = [connected(browser.port, b"GET / HTTP/1.1\r\n") for _ in range(50)]
        assert browser.get("/healthz")[0] == 200
        for wire in idle[:30]:  # those that came first had to go
            assert ends(wire)
        for wire in idle:
            wire.close()


LIVE = "GET /api/live HTTP/1.1"
TREND = "GET /api/trend?from=0&to=100 HTTP/1.1"


def test_many_busy_connections_keep_nobody_out(loop: FakeLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Streams and trends that somebody keeps waiting: those that are open longest go when a newcomer comes."""
    monkeypatch.setattr(access, "MOST_CONNECTIONS", 20)
    go = threading.Event()
    with serving_here(loop) as (app, browser, server):
        monkeypatch.setattr(app, "_trend", lambda *_: str(go.wait(60)))
        busy = [connected(browser.port, raw(browser.port, "token", LIVE, body=b"")) for _ in range(12)]
        assert within(10, lambda: len(app.live._pages) == 12)
        busy += [connected(browser.port, raw(browser.port, "token", TREND, body=b"")) for _ in range(8)]
        assert within(10, lambda: app._waiting == 6)
        try:
            for _ in range(5):
                assert browser.get("/healthz")[0] == 200
            assert ends(busy[0])
            assert within(10, lambda: len(app.live._pages) < 12)
            assert len(server.server_state.connections) <= 20
        finally:
            go.set()
            for wire in busy:
                wire.close()


def test_trends_beyond_a_few_that_wait_are_put_off_and_none_is_drawn_for_who_has_gone(
    loop: FakeLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn, go = list[float](), threading.Event()
    with serving_here(loop) as (app, browser, _):

        def slow(begin: float, end: float, points: int) -> str:
            drawn.append(begin)
            assert go.wait(60)
            return "{}"

        monkeypatch.setattr(app, "_trend", slow)
        waiting = [
            connected(browser.port, raw(browser.port, "token", TREND, body=b""))
            for _ in range(page_app.TRENDS + page_app.WAITING_TRENDS)
        ]
        assert within(10, lambda: app._waiting == page_app.WAITING_TRENDS)
        status, headers, body = browser.get("/api/trend?from=0&to=100")
        assert (status, headers["Retry-After"]) == (503, "2")
        assert "again" in json.loads(body)["error"]
        for wire in waiting:
            wire.close()
        assert browser.get("/healthz")[0] == 200  # the server has seen them go
        go.set()
        assert within(10, lambda: app._waiting == 0)
        assert browser.get("/api/trend?from=7&to=100")[0] == 200
        assert drawn == [0.0] * page_app.TRENDS + [7.0]


def test_as_many_pages_as_are_allowed_are_sent_news(loop: FakeLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "MOST_PAGES", 3)
    with serving_here(loop) as (app, browser, _):
        pages = [connected(browser.port, raw(browser.port, "token", LIVE, body=b"")) for _ in range(3)]
        assert within(10, lambda: app.live.full)
        status, headers, body = browser.get("/api/live")
        assert (status, headers["Retry-After"]) == (503, "30")
        assert "close one" in json.loads(body)["error"]
        assert browser.get("/api/state")[0] == 200  # reading goes on
        for wire in pages:
            wire.close()
        loop.add(1)
        assert within(20, lambda: not app.live.full)


def test_who_never_reads_holds_little_and_is_cut_off(loop: FakeLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "STALLED_S", 1.5)  # the second one is seen before it is cut off
    with serving_here(loop) as (app, browser, server):
        deaf = connected(browser.port, raw(browser.port, "token", LIVE, body=b""), room=4_096)
        assert within(10, lambda: len(app.live._pages) == 1)
        (queue,) = app.live._pages
        send = server.servers[0].get_loop().call_soon_threadsafe
        for _ in range(400):  # much more than a connection keeps
            send(app.live._send, "data: " + "x" * 50_000 + "\n\n")
        assert within(20, lambda: not server.server_state.connections)
        assert not app.live._pages
        assert queue.qsize() <= live.WAITING_MESSAGES
        deaf.close()
        # Answers that are not taken, the same.
        script = raw(browser.port, "token", "GET /static/uPlot.iife.min.js HTTP/1.1", body=b"")
        deaf = connected(browser.port, script * 200, room=4_096)
        assert within(20, lambda: bool(server.server_state.connections))
        assert within(20, lambda: not server.server_state.connections)
        deaf.close()
        assert browser.get("/healthz")[0] == 200


def test_the_loop_is_asked_once_for_all_who_ask_at_a_time(loop: FakeLoop) -> None:
    asked, go = list[str](), threading.Event()
    with serving_here(loop) as (app, browser, _):

        def slow(request: dict[str, str]) -> dict[str, object]:
            asked.append(request["do"])
            assert go.wait(20)
            return loop.answer(request)

        app.ask = app.live._ask = slow
        wires = [
            connected(browser.port, raw(browser.port, "token", "GET /api/about HTTP/1.1", body=b"")) for _ in range(20)
        ]
        assert within(10, lambda: len(asked) == 1)
        assert within(10, lambda: app._described._running is not None)
        go.set()
        for wire in wires:
            assert b"HTTP/1.1 200" in wire.recv(65_536)
            wire.close()
        assert len(asked) < 10


@pytest.mark.parametrize("error", [OSError("being exchanged"), KeyError(7), RuntimeError("odd")])
def test_news_go_on_after_a_journal_that_could_not_be_read(
    loop: FakeLoop, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    with serving_here(loop) as (app, browser, _):
        failed, told = list[int](), list[str]()
        read = app.live._read
        monkeypatch.setattr(app.live, "_tell", told.append)

        def unreadable(after_id: int | None) -> tuple[list[str], int]:
            if after_id is not None and len(failed) < 2:
                failed.append(after_id)
                raise error
            return read(after_id)

        monkeypatch.setattr(app.live, "_read", unreadable)
        with connected(browser.port, raw(browser.port, "token", LIVE, body=b"")) as wire:
            assert within(10, lambda: len(failed) == 2)
            loop.add(1)
            came = b""
            while b"event: scans" not in came:
                came += wire.recv(65_536)
        assert app.live.failed == 2
        assert len(told) == 1
        assert str(error) in told[0]
