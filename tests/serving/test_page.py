"""The operator's page as its process serves it: what it shows, and to whom it does what."""

from __future__ import annotations

import http.client
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_loop import BEGIN, Browser, FakeLoop, opened
from processes import lives, within

from loopwright.serving import Controller, LoopError
from loopwright.serving.journal import EventEntry, Journal, JournalReader, ScanEntry
from loopwright.serving.page.live import Live
from loopwright.serving.page.process import Page, PageProcess
from loopwright.serving.page.trend import BinnedExtremes, Modes, trend

pytest_plugins = ["small_laws"]


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory, pi_file: Path) -> Iterator[FakeLoop]:
    made = FakeLoop(tmp_path_factory.mktemp("loop"), Controller(pi_file))
    yield made
    made.close()


@pytest.fixture(scope="module")
def told() -> list[str]:
    return []


@pytest.fixture(scope="module")
def page(loop: FakeLoop, told: list[str]) -> Iterator[PageProcess]:
    made, _ = opened(loop, told)
    yield made
    made.close()


@pytest.fixture
def browser(page: PageProcess) -> Browser:
    return Browser(int(page.url.rpartition(":")[2]), page.token)


def test_reading_is_free(browser: Browser, loop: FakeLoop, controller: Controller) -> None:
    status, headers, body = browser.get("/")
    assert status == 200
    assert b"<script" in body
    assert b"style=" not in body
    assert "script-src 'self'" in headers["Content-Security-Policy"]
    assert headers["X-Frame-Options"] == "DENY"
    about = browser.json("/api/about")
    assert about["card"]["sha256"] == controller.sha256
    assert "folder" not in about
    assert about["candidates"] == []
    assert browser.json("/api/state")["mode"] == "AUTO"
    assert within(10, lambda: len(browser.json("/api/events")["events"]) == 2)
    alarm, change = browser.json("/api/events")["events"]
    assert (alarm["alarm"], alarm["over"], alarm["acknowledged"]) == (True, None, None)
    assert (change["who"], change["what"]) == ("anna", "mode SHADOW -> AUTO")
    drawn = browser.json(f"/api/trend?from={BEGIN - 1}&to={BEGIN + 200}&points=500")
    assert len(drawn["time"]) >= 100
    assert drawn["modes"] == [[BEGIN, "AUTO"]]
    assert len(drawn["columns"]["pv T"]) == len(drawn["time"])
    assert browser.get("/api/picture/0")[0] == 404
    assert browser.get("/static/../app.py")[0] == 404
    assert browser.get("/static/%2e%2e/app.py")[0] == 404


@pytest.mark.parametrize(
    "query", ["", "from=0", "from=5&to=1", "from=0&to=nan", "from=0&to=1e300", "from=0&to=1&points=0", "from=a&to=1"]
)
def test_a_trend_that_is_none_is_refused(browser: Browser, query: str) -> None:
    status, _, body = browser.get(f"/api/trend?{query}")
    assert status == 400
    assert json.loads(body)["error"]


def test_metrics_and_health(browser: Browser, loop: FakeLoop) -> None:
    status, headers, body = browser.get("/metrics")
    assert status == 200
    assert headers["Content-Type"].startswith("text/plain; version=0.0.4")
    lines = body.decode().splitlines()
    assert 'loopwright_mode{mode="AUTO"} 1.0' in lines
    assert "loopwright_missed_total 1.0" in lines
    assert 'loopwright_verdict{name="residual"} 1.0' in lines
    assert 'loopwright_verdict{name="time in HOLD"} -1.0' in lines
    assert 'loopwright_monitor{name="saturated_share"} 0.25' in lines
    families = [line.split()[2] for line in lines if line.startswith("# TYPE")]
    assert len(families) == len(set(families))
    assert browser.get("/healthz")[0] == 200
    loop.state["alive"] = False
    try:
        assert within(10, lambda: browser.get("/healthz")[0] == 503)
    finally:
        loop.state["alive"] = True


def test_only_a_request_of_the_page_itself_with_the_token_changes_anything(
    browser: Browser, loop: FakeLoop, told: list[str]
) -> None:
    wanted = {"do": "mode", "value": "AUTO", "who": "anna", "reason": ""}
    before = len(loop.changes)
    port = browser.port
    for changed, status in (
        ({"Authorization": "Bearer forged"}, 401),
        ({"Authorization": None}, 401),
        ({"Authorization": f"Bearer {browser.token}x"}, 401),
        ({"Authorization": "Bearer \u00e9"}, 401),
        ({"Origin": None}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "https://evil.example"}, 403),
        ({"Origin": f"https://127.0.0.1:{port}"}, 403),
        ({"Origin": f"http://127.0.0.1:{port}.evil.example"}, 403),
        ({"Sec_Fetch_Site": "cross-site"}, 403),
        ({"Host": f"evil.example:{port}"}, 421),
        ({"Host": "evil.example"}, 421),
        ({"Content_Type": "text/plain"}, 415),
        ({"Content_Type": "application/x-www-form-urlencoded"}, 415),
    ):
        got, answer = browser.change(wanted, **changed)  # type: ignore[arg-type]
        assert got == status, (changed, answer)
        assert answer["error"]
    assert browser.change(b"x" * 200_000)[0] == 413
    assert browser.change(b"x" * 20_000)[0] == 400  # a course's file may be so long
    own = {"Content-Type": "application/json", "Origin": f"http://127.0.0.1:{port}"}
    assert browser.send("POST", "/api/what-if", b"x" * 20_000, own)[0] == 413  # which asks for no token
    assert browser.change(b"{")[0] == 400
    assert browser.change(b"[" * 5_000)[0] == 400
    for view in ("state", "about", "inputs", "future", "courses", "picture"):
        assert browser.change({"do": view})[0] == 400
    assert browser.get("/api/change")[0] == 405
    assert browser.get("/", Host="evil.example")[0] == 421
    assert browser.get("/api/state", Host="evil.example")[0] == 421
    assert loop.changes[before:] == []
    assert any("a wrong token was refused" in line for line in told)
    assert not any(browser.token in line for line in told)
    assert browser.change(wanted) == (200, {"done": "well"})
    assert browser.change({**wanted, "value": "refuse"}) == (409, {"error": "out of range"})
    assert loop.changes[before] == wanted


def test_a_word_that_is_missing_is_asked_for_as_a_value(browser: Browser, loop: FakeLoop) -> None:
    loop.unproven = "pid: it locked up \x1b[2J"
    status, answer = browser.change({"do": "mode", "value": "AUTO", "who": "anna"})
    assert (status, answer["needs"], answer["unproven"]) == (409, "accept_unproven", "pid: it locked up \\x1b[2J")
    accepted = {"do": "mode", "value": "AUTO", "who": "anna", "accept_unproven": True}
    assert browser.change(accepted) == (200, {"done": "well"})
    loop.unproven = ""


def test_what_is_new_is_sent_and_a_gap_is_filled(browser: Browser, loop: FakeLoop) -> None:
    last = loop.scans
    assert within(10, lambda: _newest(loop) == last)
    with closing(http.client.HTTPConnection("127.0.0.1", browser.port, timeout=20)) as wire:
        wire.request("GET", "/api/live", headers={"Last-Event-ID": str(last - 7)})
        stream = wire.getresponse()
        assert stream.headers["Content-Type"].startswith("text/event-stream")
        assert _next(stream, "state")["mode"] == "AUTO"
        filled = _next(stream, "scans")
        assert filled["time"] == [BEGIN + last - k for k in range(7, 0, -1)]
        assert set(map(len, filled["columns"].values())) == {7}
        loop.add(3)
        assert _next(stream, "scans")["time"][-1] == BEGIN + last + 2
        stream.close()
    # More than a page would draw: it is told to ask for the trend.
    loop.add(2_100)
    assert within(20, lambda: _newest(loop) == loop.scans)
    with closing(http.client.HTTPConnection("127.0.0.1", browser.port, timeout=20)) as wire:
        wire.request("GET", "/api/live", headers={"Last-Event-ID": "1"})
        stream = wire.getresponse()
        assert _next(stream, "reset") == {}
        stream.close()


def _newest(loop: FakeLoop) -> int:
    with closing(JournalReader(loop.journal)) as reader:
        return reader.last_id()


def _next(stream: http.client.HTTPResponse, event: str) -> Any:
    """The next message of a kind; others are passed over."""
    while True:
        fields: dict[str, str] = {}
        while (line := stream.readline()) != b"\n":
            assert line, f"the stream ended without {event}"
            name, _, value = line.decode().rstrip("\n").partition(": ")
            fields[name] = value
        if fields.get("event") == event:
            return json.loads(fields["data"])


def test_a_page_that_died_is_started_again_and_ends_with_its_loop(loop: FakeLoop) -> None:
    told: list[str] = []
    page, browser = opened(loop, told)
    try:
        os.kill(page._process.pid, signal.SIGKILL)
        assert within(10, lambda: any("it is started again" in line for line in told))
        assert within(20, lambda: _answers(browser))
    finally:
        page.close()
    assert within(10, lambda: not _answers(browser))


def test_a_page_that_ends_by_the_signal_that_ends_its_loop_is_not_started_again(loop: FakeLoop) -> None:
    """SIGTERM to the whole process group reaches both; the loop says that it is about to end."""
    told: list[str] = []
    page, browser = opened(loop, told)
    try:
        page.leaving = True
        os.kill(page._process.pid, signal.SIGTERM)
        page._thread.join(10)
        assert not page._thread.is_alive()
    finally:
        page.close()
    assert told == []
    assert not _answers(browser)


def _answers(browser: Browser) -> bool:
    try:
        return browser.get("/healthz")[0] == 200
    except OSError:
        return False


OWNER = """
import sys
from pathlib import Path
from loopwright.serving.page.process import PageProcess
from loopwright.serving.page.process import Page
page = PageProcess(Page("127.0.0.1:0"), Path(sys.argv[1]), Path(sys.argv[2]), print)
print(page._process.pid, flush=True)
sys.stdin.read()
"""


def test_a_killed_loop_leaves_no_page_behind(loop: FakeLoop) -> None:
    owner = subprocess.Popen(
        [sys.executable, "-c", OWNER, str(loop.journal), str(loop.control.path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with owner:
        assert owner.stdout is not None
        page = int(owner.stdout.readline())
        assert lives(page)
        owner.kill()
        assert within(10, lambda: not lives(page))


def test_a_taken_port_is_one_line(loop: FakeLoop, page: PageProcess) -> None:
    listen = page.url.removeprefix("http://")
    with pytest.raises(LoopError, match=f"the page cannot listen at {listen}: Address already in use"):
        PageProcess(Page(listen), loop.journal, loop.control.path, lambda _: None)


@pytest.mark.parametrize(
    ("listen", "others", "words"),
    [
        ("8080", {}, "must be HOST:PORT"),
        ("127.0.0.1:x", {}, "must be HOST:PORT"),
        ("127.0.0.1:99999", {}, "must be HOST:PORT"),
        ("0.0.0.0:80", {}, "which other machines can reach; use 127.0.0.1:80, or say allow_remote = true"),
        ("plant.example:80", {}, "which other machines can reach"),
        ("0.0.0.0:80", {"allow_remote": True}, "needs TLS"),
        ("127.0.0.1:80", {"certificate": Path("a")}, "go together"),
    ],
)
def test_an_address_that_is_none_or_open_is_refused(listen: str, others: dict[str, Any], words: str) -> None:
    with pytest.raises(LoopError, match=words):
        Page(listen, **others)


def test_a_token_is_made_or_comes_from_its_file(tmp_path: Path) -> None:
    page = Page("[::1]:8080", token_file=tmp_path / "token")
    assert page.address == ("::1", 8080)
    assert "[::1]:8080" in page.hosts(8080)
    assert "[::1]" not in page.hosts(8080)
    with pytest.raises(LoopError, match="token_file cannot be read"):
        page.token()
    (tmp_path / "token").write_text("short\n")
    with pytest.raises(LoopError, match="at least 16 ASCII characters"):
        page.token()
    (tmp_path / "token").write_text("long enough to be one\n")
    assert page.token() == "long enough to be one"


def test_a_page_at_its_scheme_s_own_port_is_asked_for_without_it() -> None:
    """A browser says no :443 and no :80."""
    plain = Page("127.0.0.1:80", names=("loop",))
    files = {"certificate": Path("c.pem"), "private_key": Path("k.pem")}
    safe = Page("10.0.0.5:443", allow_remote=True, **files)
    for page, own, other in ((plain, 80, 443), (safe, 443, 80)):
        bare = {host.rpartition(":")[0] for host in page.hosts(own)} & set(page.hosts(own))
        assert {"localhost", "127.0.0.1", "[::1]", page.address[0]} == bare
        assert set(page.hosts(own)) - set(page.names) >= {f"{host}:{own}" for host in bare}
        assert not bare & set(page.hosts(other))


@pytest.mark.parametrize("seed", range(5))
def test_thinning_keeps_the_extremes_of_every_bin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, points = 5_000, 37
    times = np.sort(rng.uniform(0, 1000, n))
    values = rng.normal(size=n).cumsum()
    values[rng.random(n) < 0.2] = np.nan
    thinned = BinnedExtremes(0.0, 1000.0, points)
    for part in np.array_split(np.arange(n), 7):
        thinned.add(times[part], {"pv a": values[part]})
    at, columns = thinned.rows()
    assert len(at) <= 2 * points
    assert (np.diff(at) >= 0).all()
    bins = np.minimum((times / (1000 / points)).astype(int), points - 1)
    pairs = columns["pv a"].reshape(-1, 2)
    for row, bin_ in zip(pairs, np.unique(bins), strict=True):
        inside = values[bins == bin_]
        assert {row[0], row[1]} == {np.nanmin(inside), np.nanmax(inside)}


def test_a_trend_over_another_controller_and_a_pause(tmp_path: Path, controller: Controller) -> None:
    made = FakeLoop(tmp_path, controller, scans=50)
    made.scans += 1_000  # the loop did not run
    made.writer.begin(controller.manifest, "another", BEGIN + 1_050)
    made.add(50)
    made.close()
    with closing(JournalReader(made.journal)) as reader:
        drawn = trend(reader, BEGIN, BEGIN + 2_000, 500)
        coarse = trend(reader, BEGIN, BEGIN + 2_000, 20)
    assert len(drawn["time"]) == 101
    assert [v for v in drawn["columns"]["pv T"] if v is None] == [None]
    assert drawn["columns"]["pv T"][50] is None
    assert None in coarse["columns"]["pv T"]
    assert coarse["time"] == sorted(coarse["time"])


@pytest.mark.parametrize("view", ["news", "trend"])
def test_a_controller_that_takes_over_while_the_journal_is_read_is_no_trouble(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch, view: str
) -> None:
    made = FakeLoop(tmp_path, controller, scans=50)
    assert within(10, lambda: made.writer.behind == 0)
    runs, swaps = JournalReader.runs, list[int]()

    def meanwhile(reader: JournalReader) -> list[dict[str, Any]]:
        """Runs, and right after them another controller and its first scan."""
        found = runs(reader)
        if not swaps:
            swaps.append(made.scans)
            made.writer.begin(controller.manifest, "another", BEGIN + made.scans)
            made.add(1)
            assert within(10, lambda: made.writer.behind == 0)
        return found

    monkeypatch.setattr(JournalReader, "runs", meanwhile)
    live = Live(made.journal, made.answer)

    def last() -> float:
        if view == "news":
            return float(json.loads(live._read(1)[0][-1].split("data: ")[1])["time"][-1])
        with closing(JournalReader(made.journal)) as reader:
            return float(trend(reader, BEGIN, BEGIN + 200, 500)["time"][-1])

    assert last() in {BEGIN + 49, BEGIN + 50}
    assert last() == BEGIN + 50
    assert swaps == [50]
    made.close()


def test_the_first_event_of_an_empty_journal_is_news(tmp_path: Path) -> None:
    with closing(Journal(tmp_path / "loop.journal")) as journal:
        live = Live(journal.path, lambda _: {})
        assert live._entries() == []  # what is there at first; here it is nothing
        journal.event(EventEntry(BEGIN, "change", "anna", "mode SHADOW -> AUTO"))
        assert within(10, lambda: journal.behind == 0)
        (news,) = live._entries()
        assert "mode SHADOW -> AUTO" in news
        assert live._entries() == []


@pytest.mark.parametrize("seed", range(20))
def test_changes_of_mode_are_thinned_and_no_hold_is_lost(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, n = 50, 5_000
    times = np.sort(rng.uniform(0, 1000, n))
    names = rng.choice(["AUTO", "HOLD", "MANUAL", "SHADOW"], n, p=[0.6, 0.01, 0.2, 0.19]).tolist()
    modes = Modes(0.0, 1000 / points, points)
    for part in np.array_split(np.arange(n), 9):
        modes.add(times[part], [names[i] for i in part], 5.0)
    drawn = modes.thinned()
    at = [t for t, _ in drawn]
    assert len(drawn) <= points + 1
    assert at == sorted(at)
    assert all(one != other for (_, one), (_, other) in pairwise(drawn))
    assert drawn[-1][1] == names[-1]
    bins = (times / (1000 / points)).astype(int)
    for k in range(points):
        held = "HOLD" in {names[i] for i in np.flatnonzero(bins == k)}
        end = [mode for t, mode in drawn if t < (k + 1) * 1000 / points][-1]
        assert (end == "HOLD") == held, k


def test_a_trend_of_a_loop_that_changes_its_mode_at_each_scan_is_short(tmp_path: Path, controller: Controller) -> None:
    made = FakeLoop(tmp_path, controller, scans=0)
    for k in range(20_000):
        made.writer.scan(ScanEntry(BEGIN + k, "AUTO" if k % 2 else "HOLD", (0.5,) * made.columns))
    made.close()
    with closing(JournalReader(made.journal)) as reader:
        drawn = trend(reader, BEGIN, BEGIN + 20_000, 100)
        close = trend(reader, BEGIN, BEGIN + 50, 100)
    assert len(drawn["modes"]) <= 101
    assert len(close["modes"]) == 51  # with few scans there is nothing to thin
