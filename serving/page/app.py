"""The page's routes. Reading is free; a change needs the token."""

from __future__ import annotations

import asyncio
import hmac
import json
import math
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path, PurePath
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from loopwright.serving.controller_file import controller_files, file_digest, unseal
from loopwright.serving.errors import ArtifactError, LoopError, LoopwrightError
from loopwright.serving.graph.audit import MAX_GRAPH_BYTES, audit
from loopwright.serving.in_charge.adapted import require_fits
from loopwright.serving.journal import JournalReader
from loopwright.serving.manifest import MANIFEST_KEY, Manifest
from loopwright.serving.monitor.weekly_report import plain_rows, week_reports
from loopwright.serving.page.access import Access, longest
from loopwright.serving.page.foresight import LawForesight
from loopwright.serving.page.live import ENTRIES, LATER_MS, Ask, Live, Shared, shown
from loopwright.serving.page.prometheus import metrics_text
from loopwright.serving.page.trend import MOST_POINTS, trend
from loopwright.serving.words import first_line

MOST_FILES = 50  # files that are looked at
SHOWN_WEEKS = 5  # weeks that the card shows: a month and the present one


def candidates(
    in_charge: Path, trusted: Sequence[str] | None = None, first: Path | None = None
) -> list[dict[str, Any]]:
    """Law, case, file, sha256 and signer of each controller beside the file ``in_charge`` that fits the loop.

    The loop has the signals of the file ``first`` that it began with; without one, of the file in charge.

    Where public keys are ``trusted``, only of files that one of them signed: the loop would refuse any other.
    """
    found: list[dict[str, Any]] = []
    now, _, _ = _described(first or in_charge, trusted)
    beside = (p for p in controller_files(in_charge.parent) if p.is_file())  # no pipe, which would never end
    for path in list(beside)[:MOST_FILES]:
        try:
            manifest, sha256, signed = _described(path, trusted)
            require_fits(manifest, now)
        except (LoopwrightError, OSError, KeyError):
            continue
        if path.name != in_charge.name:
            row = {"law": manifest.law, "case": manifest.case, "file": path.name, "sha256": sha256, "signed": signed}
            found.append(row)
    return found


def _described(path: Path, trusted: Sequence[str] | None) -> tuple[Manifest, str, str | None]:
    """Manifest, sha256 and signer, without a session; LoopwrightError where it is no controller, or not trusted."""
    signed = None
    if trusted is not None:
        from loopwright.serving.signing.verify import verified  # here: it needs the package cryptography

        signed = verified(path, trusted)
    with path.open("rb") as file:
        data = file.read(MAX_GRAPH_BYTES + 1)
    sha256 = file_digest(data)
    if signed is not None and sha256 != signed.sha256:
        raise ArtifactError(f"{path} was exchanged after its signature was verified")
    unseal(data)
    return Manifest.from_json(audit(data).metadata[MANIFEST_KEY]), sha256, None if signed is None else signed.words


# ------------------------------------------------------------------------------------------------------------ the page
STATIC = Path(__file__).parent / "static"
BODY_S = 5.0  # in which the body of a change must be here
LONGEST_SPAN_S = 400 * 86_400.0  # [s] of a trend that a browser may ask for
TELL_S = 60.0  # between two lines about wrong tokens
TRENDS, WAITING_TRENDS = 2, 10  # that are computed at a time, and that may wait for it
WAITING_LOOKS = 10  # changes that are looked at beforehand, one after the other: each takes up to a second of a core
LOOKS = frozenset({"state", "about", "inputs", "future", "courses", "picture"})  # at the loop, which change nothing
TRENDS_LATER_S = 2  # after which a trend beyond them may be asked for again


WHAT_IF = (
    'a what-if is {"changes": {the name of a set point or entry: a number}}, or {"course": as a loop is given one}'
)


class PageApp:
    """Answers to the page, from the journal and from the loop itself (``ask``)."""

    def __init__(self, journal: Path, ask: Ask, token: str, tell: Callable[[str], None] = lambda _: None) -> None:
        self.journal, self.ask, self.token, self.tell = journal, ask, token, tell
        self.live = Live(journal, ask, tell)
        self._about = Shared(lambda: self._asked({"do": "about"}))
        self._described = Shared(self._describe)
        self._courses = Shared(lambda: self._asked({"do": "courses"}))
        self._told = -math.inf
        self._trends, self._waiting = asyncio.Semaphore(TRENDS), 0
        self._foresight = LawForesight(ask)
        self._explained = Shared(lambda: asyncio.to_thread(self._foresight.explained))
        self._looks, self._looking = asyncio.Semaphore(1), 0

    def asgi(self, hosts: Sequence[str], scheme: str) -> Starlette:
        """The application, for those who ask for one of ``hosts``."""
        routes = [
            Route("/", self.index),
            Route("/api/about", self.about),
            Route("/api/state", self.state),
            Route("/api/trend", self.trend),
            Route("/api/events", self.events),
            Route("/api/weeks", self.weeks),
            Route("/api/live", self.stream),
            Route("/api/picture/{digest}", self.picture),
            Route("/api/courses", self.courses),
            Route("/api/explain", self.explain),
            Route("/api/what-if", self.what_if, methods=["POST"]),
            Route("/api/change", self.change, methods=["POST"]),
            Route("/metrics", self.metrics),
            Route("/healthz", self.healthz),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        return Starlette(
            routes=routes,
            middleware=[Middleware(Access, hosts=hosts, scheme=scheme)],
            exception_handlers={HTTPException: _http_error, LoopwrightError: _refusal, Exception: _trouble},
        )

    async def index(self, _: Request) -> Response:
        """The page itself."""
        return FileResponse(STATIC / "index.html", media_type="text/html; charset=utf-8")

    async def about(self, _: Request) -> Response:
        """Description of the loop."""
        return Response(await self._described(), media_type="application/json")

    async def _describe(self) -> str:
        about = await self._about()
        card = about["card"]
        picture = f"/api/picture/{card['sha256'][:16]}" if card["picture"] else None
        at = Path(about["folder"]) / card["file"]
        others = await asyncio.to_thread(self._candidates, at, Path(about.get("first", at)), about.get("trusted"))
        private = {"folder", "first", "trusted"}  # paths of this machine
        shown = {k: v for k, v in about.items() if k not in private}
        return json.dumps({**shown, "card": {**card, "picture": picture}, "candidates": others}, allow_nan=False)

    def _candidates(self, in_charge: Path, first: Path, trusted: list[str] | None) -> list[dict[str, Any]]:
        try:
            return candidates(in_charge, trusted, first)
        except (LoopwrightError, OSError, KeyError):
            return []  # the file that the loop began with is gone

    async def state(self, _: Request) -> Response:
        """How it stands."""
        return JSONResponse(await self.live.state())

    async def picture(self, _: Request) -> Response:
        """The picture of the controller's closed loop."""
        path = (await self._asked({"do": "picture"}))["file"]
        if path is None or not Path(path).is_file():
            raise HTTPException(404, "this controller has no picture beside its file")
        return FileResponse(path, media_type="image/png")

    async def trend(self, request: Request) -> Response:
        """Columns over a time."""
        begin, end = _number(request, "from"), _number(request, "to")
        points = _number(request, "points", 1000)
        if not 0 < end - begin <= LONGEST_SPAN_S:
            raise HTTPException(400, f"from and to must be in order and at most {LONGEST_SPAN_S:.0f} s apart")
        if not 1 <= points <= MOST_POINTS:
            raise HTTPException(400, f"points must lie in 1 .. {MOST_POINTS}")
        if self._waiting >= WAITING_TRENDS:
            after = {"Retry-After": str(TRENDS_LATER_S)}
            raise HTTPException(503, "many trends are being drawn; ask for this one again in a moment", after)
        self._waiting += 1
        try:
            await self._trends.acquire()
        finally:
            self._waiting -= 1
        try:
            if await request.is_disconnected():
                return Response(status_code=503)  # nobody reads it
            text = await asyncio.to_thread(self._trend, begin, end, int(points))
        finally:
            self._trends.release()
        return Response(text, media_type="application/json")

    def _trend(self, begin: float, end: float, points: int) -> str:
        with closing(JournalReader(self.journal)) as reader:
            return json.dumps(trend(reader, begin, end, points), allow_nan=False)

    async def events(self, request: Request) -> Response:
        """Events, newest first."""
        limit = _number(request, "limit", ENTRIES)
        if not 1 <= limit <= MOST_POINTS:
            raise HTTPException(400, f"limit must lie in 1 .. {MOST_POINTS}")

        def read() -> list[dict[str, Any]]:
            with closing(JournalReader(self.journal)) as reader:
                return [shown(entry) for entry in reader.entries(int(limit))]

        return JSONResponse({"events": await asyncio.to_thread(read)})

    async def weeks(self, _: Request) -> Response:
        """The last weeks in plain words, newest first."""
        found = await asyncio.to_thread(week_reports, self.journal, SHOWN_WEEKS)
        return JSONResponse({"weeks": plain_rows(found[::-1])})

    async def stream(self, request: Request) -> Response:
        """News, as server-sent events."""
        if request.method == "HEAD":
            return Response(media_type="text/event-stream")
        if self.live.full:
            after = {"Retry-After": str(LATER_MS // 1000)}
            raise HTTPException(503, "as many pages are open as are sent news; close one", after)
        last = request.headers.get("last-event-id", "")
        seen = int(last) if last.isascii() and last.isdigit() and len(last) < 16 else None
        return StreamingResponse(self.live.messages(seen), media_type="text/event-stream")

    async def change(self, request: Request) -> Response:
        """Have something changed."""
        given = request.headers.get("authorization", "")
        if not hmac.compare_digest(given.encode(), f"Bearer {self.token}".encode()):
            if time.monotonic() - self._told > TELL_S:
                self._told = time.monotonic()
                self.tell(f"page: a wrong token was refused (from {request.client.host if request.client else '?'})")
            return JSONResponse({"error": "the token is not the loop's; it prints its token at its start"}, 401)
        wanted = await _json(request)
        if not isinstance(wanted, dict) or wanted.get("do") in LOOKS:
            raise HTTPException(400, 'a change is an object with "do"')
        if wanted.get("do") == "swap" and not _is_name(wanted.get("value")):
            raise HTTPException(400, "the page tries only files that lie beside the controller in charge, by name")
        answer = await asyncio.to_thread(self.ask, wanted)
        return JSONResponse(answer, 409 if "error" in answer else 200)

    async def courses(self, _: Request) -> Response:
        """The courses that stand, with their points."""
        return JSONResponse(await self._courses())

    async def explain(self, _: Request) -> Response:
        """Courses that the law in charge predicts and plans, and the parts of its next moves; 404 without them."""
        try:
            return JSONResponse(await self._explained())
        except LoopwrightError as error:
            return JSONResponse({"error": first_line(error)}, 404)

    async def what_if(self, request: Request) -> Response:
        """Courses after some changes, or with courses to come, which are not made, beside those without them."""
        wanted = await _json(request)
        if not isinstance(wanted, dict) or not wanted or set(wanted) - {"changes", "course"}:
            raise HTTPException(400, WHAT_IF)
        changes, course = wanted.get("changes", {}), wanted.get("course")
        if not isinstance(changes, dict) or (not changes and course is None):
            raise HTTPException(400, WHAT_IF)
        if self._looking >= WAITING_LOOKS:
            raise HTTPException(503, "many changes are being looked at; ask again in a moment", {"Retry-After": "1"})
        self._looking += 1
        try:
            async with self._looks:
                speed = 1.0 if course is None else (await self._about())["speed"] or 1.0
                return JSONResponse(await asyncio.to_thread(self._foresight.what_if, changes, course, speed))
        except LoopwrightError as error:
            return JSONResponse({"error": first_line(error), **({"entry": error.entry} if error.entry else {})}, 409)
        finally:
            self._looking -= 1

    async def metrics(self, _: Request) -> Response:
        """For Prometheus."""
        about, state = await self._about(), await self.live.state()
        return PlainTextResponse(metrics_text(about, state), media_type="text/plain; version=0.0.4")

    async def healthz(self, _: Request) -> Response:
        """200 while the loop scans, else 503."""
        state = await self.live.state()
        return JSONResponse(
            {k: state.get(k) for k in ("alive", "mode", "reason", "time")}, 200 if state["alive"] else 503
        )

    async def _asked(self, request: dict[str, Any]) -> dict[str, Any]:
        answer = await asyncio.to_thread(self.ask, request)
        if "error" in answer:
            raise LoopError(str(answer["error"]))
        return answer


def _number(request: Request, name: str, otherwise: float | None = None) -> float:
    text = request.query_params.get(name)
    try:
        number = float(text) if text is not None and len(text) < 40 else otherwise
    except ValueError:
        number = None
    if number is None or not math.isfinite(number):
        raise HTTPException(400, f"{name} must be a number")
    return number


async def _json(request: Request) -> Any:
    """The content of a request; HTTPException where it is late or no JSON."""
    try:
        async with asyncio.timeout(BODY_S):
            return json.loads(await _body(request))
    except TimeoutError:
        raise HTTPException(408, "the change did not arrive in time") from None
    except (ValueError, RecursionError):
        raise HTTPException(400, "the change is no JSON") from None


async def _body(request: Request) -> bytes:
    """The body of a change; its length was said, but a proxy may have said another one."""
    body = bytearray()
    async for piece in request.stream():
        body += piece
        if len(body) > (most := longest(request.url.path)):
            raise HTTPException(413, f"a change has at most {most} bytes")
    return bytes(body)


def _is_name(value: Any) -> bool:
    """Whether a swap names a file without a way to it."""
    file = value.get("file") if isinstance(value, dict) else None
    return isinstance(file, str) and file not in {"", ".", ".."} and PurePath(file).name == file and "\\" not in file


async def _http_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)


async def _refusal(_: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, 503)


async def _trouble(_: Request, error: Exception) -> Response:
    return JSONResponse({"error": f"the page cannot answer: {type(error).__name__}"}, 500)
