"""A loop that only answers: a journal, and the door at which a page knocks."""

from __future__ import annotations

import http.client
import json
from pathlib import Path
from typing import Any

import numpy as np

from loopwright.serving import Controller
from loopwright.serving.errors import NotProvenError
from loopwright.serving.journal import EventEntry, Journal, ScanEntry
from loopwright.serving.page.process import Page, PageProcess
from loopwright.serving.station.control import Control

BEGIN = 1_790_000_000.0
THIRDS = [0.0, 1 / 3, 1.0]  # of an MV that is not continuous


class FakeLoop:
    """Answers views with what it was given and writes down every change that reaches it."""

    def __init__(self, folder: Path, controller: Controller, scans: int = 100) -> None:
        m = controller.manifest
        self.journal = folder / "loop.journal"
        self.writer = Journal(self.journal)
        self.writer.begin(m, controller.sha256, BEGIN)
        self.columns = len(m.sp) + len(m.pv) + 4 * len(m.mv) + len(m.dv) + len(m.info)
        self.scans = 0
        self.add(scans)
        self.writer.event(EventEntry(BEGIN, "change", "anna", "mode SHADOW -> AUTO"))
        self.writer.event(EventEntry(BEGIN + 5, "fault", "loop", "PV T: bad", alarm="fault", raised=True))
        self.changes: list[dict[str, Any]] = []
        self.unproven = ""  # why its controller is not proven
        groups = {"sp": m.sp, "pv": m.pv, "mv": m.mv, "dv": m.dv}
        self.about = {
            "title": m.law,
            "period_s": 1.0,
            "signals": {name: [s.to_dict() for s in group] for name, group in groups.items()},
            "info": list(m.info),
            "folder": str(controller.path.parent),
            "card": {"law": m.law, "case": m.case, "file": controller.path.name, "sha256": controller.sha256,
                     "picture": False},
        }  # fmt: skip
        self.state = {
            "time": BEGIN, "scan": 100, "alive": True, "mode": "AUTO", "reason": "", "missed": 1, "faults": 2,
            "sp": [0.5] * len(m.sp), "pv": [0.4, None], "mv": None, "journal": "", "sha256": controller.sha256,
            "verdicts": [{"name": "residual", "level": "watch"}, {"name": "time in HOLD", "level": "not known yet"}],
            "numbers": {"saturated_share": 0.25},
        }  # fmt: skip
        self.control = Control(self.journal, self.answer)

    def add(self, scans: int) -> None:
        rng = np.random.default_rng(self.scans)
        for _ in range(scans):
            self.writer.scan(ScanEntry(BEGIN + self.scans, "AUTO", tuple(rng.normal(size=self.columns).tolist())))
            self.scans += 1

    def answer(self, request: Any) -> dict[str, Any]:
        if request.get("do") == "state":
            return dict(self.state)
        if request.get("do") == "about":
            return json.loads(json.dumps(self.about))  # type: ignore[no-any-return]
        if request.get("do") == "picture":
            return {"file": None}
        self.changes.append(request)
        if self.unproven and request.get("value") == "AUTO" and not request.get("accept_unproven"):
            raise NotProvenError("AUTO needs your word for it", self.unproven)
        return {"error": "out of range"} if request.get("value") == "refuse" else {"done": "well"}

    def close(self) -> None:
        self.control.close()
        self.writer.close()


class Browser:
    """Requests as this page's own scripts make them, or with headers changed."""

    def __init__(self, port: int, token: str) -> None:
        self.port, self.token = port, token

    def get(self, path: str, **headers: str) -> tuple[int, http.client.HTTPMessage, bytes]:
        return self.send("GET", path, None, {k.replace("_", "-"): v for k, v in headers.items()})

    def json(self, path: str) -> Any:
        status, _, body = self.get(path)
        assert status == 200, body
        return json.loads(body)

    def change(self, wanted: Any, **changed: str | None) -> tuple[int, Any]:
        headers = {
            "Authorization": f"Bearer {self.token}",
            "Content-Type": "application/json",
            "Origin": f"http://127.0.0.1:{self.port}",
            **{k.replace("_", "-"): v for k, v in changed.items()},
        }
        body = wanted if isinstance(wanted, bytes) else json.dumps(wanted).encode()
        status, _, said = self.send("POST", "/api/change", body, {k: v for k, v in headers.items() if v is not None})
        return status, json.loads(said)

    def send(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str]
    ) -> tuple[int, http.client.HTTPMessage, bytes]:
        wire = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        try:
            wire.request(method, path, body, headers)
            answer = wire.getresponse()
            return answer.status, answer.headers, answer.read()
        finally:
            wire.close()


def opened(loop: FakeLoop, told: list[str]) -> tuple[PageProcess, Browser]:
    """The page of a loop as its process, and a browser for it."""
    page = PageProcess(Page("127.0.0.1:0"), loop.journal, loop.control.path, told.append)
    return page, Browser(int(page.url.rpartition(":")[2]), page.token)
