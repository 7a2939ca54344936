"""A running loop as others see it: what it is, and how it stands; JSON-ready."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from loopwright.serving.bridging import BRIDGE_PERIODS
from loopwright.serving.certificate import certificate_of
from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopError
from loopwright.serving.guard import Sample
from loopwright.serving.in_charge.active_controller import LawInputs
from loopwright.serving.journal import columns
from loopwright.serving.loop import Command, ControlLoop
from loopwright.serving.monitor import Verdict
from loopwright.serving.monitor.weekly_report import shares
from loopwright.serving.opcua.values import words
from loopwright.serving.preview.course import Course
from loopwright.serving.trust import judged, signer
from loopwright.serving.words import plain_tree

if TYPE_CHECKING:
    from loopwright.serving.station.recorder import MonitorRunner
    from loopwright.serving.station.station import Station

View = dict[str, Any]

SILENT_PERIODS = 3  # without a scan: the loop counts as dead
MOST_OPERATED = 300  # changes of operate that the trends draw as ranges: a shift has some ten
PICTURES = ("{stem}.png", "figures/closed_loop_{stem}.png")


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The loop as a scan left it.

    The loop's own thread makes one after each scan. Answers to others are made of it, and of nothing else of the loop
    and its monitor, so that none is half of one scan and half of the next.
    """

    seen_s: float  # since 1970
    sample: Sample | None
    command: Command
    controller: Controller  # in charge after it; a change that is asked for now shows with the next scan
    stepped: Controller  # that gave this command; another one where a swap followed
    successor: View | None  # on trial
    replaced: Controller | None
    missed: int  # periods
    faults: int  # scans
    goal: tuple[float, ...]  # where each MV goes that is moved by hand, and where the others stand
    operate: tuple[float, ...]  # as operators want it of the controller in charge
    operated: tuple[tuple[float, tuple[float, ...]], ...]  # since when these and earlier values of it hold
    inputs: LawInputs | None  # of the last step of the controller in charge
    stepped_s: float  # since 1970, when that was
    courses: Mapping[str, Course]  # those that stand
    next_s: float  # the loop's time of the next scan, as the courses count it
    verdicts: tuple[Verdict, ...]
    numbers: Mapping[str, float]
    week: str  # that the counts are of
    counts: Mapping[str, float]

    @classmethod
    def of(
        cls,
        loop: ControlLoop,
        watching: MonitorRunner,
        seen: tuple[Sample | None, Command, float],
        stepped: Controller,
        counts: tuple[int, int],
        before: Snapshot | None = None,
    ) -> Self:
        """After a scan ``seen``, by the controller ``stepped``; ``counts``: periods missed, scans with a fault.

        ``before`` is the snapshot of the scan before it.
        """
        sample, command, seen_s = seen
        new = loop.successor
        successor = None
        if new is not None:
            successor = {**_named(new.controller), "good": new.good, "trial": new.trial, "reason": new.reason}
        monitor, weekly = watching.monitor, watching.weekly
        operate = tuple(map(float, loop.operate))
        operated = () if before is None or before.controller is not loop.controller else before.operated
        if not operated or operated[-1][1] != operate:
            operated = (*operated[1 - MOST_OPERATED :], (seen_s, operate))
        stepped_s = seen_s if command.law_mv is not None or before is None else before.stepped_s
        return cls(
            *(seen_s, sample, command, loop.controller, stepped, successor, loop.replaced, *counts),
            goal=tuple(map(float, loop.mv_wanted)),
            operate=operate,
            operated=operated,
            inputs=loop.stepped,
            stepped_s=stepped_s,
            courses=loop.courses.standing,
            next_s=loop.courses.now_s,
            verdicts=tuple(monitor.verdicts()),
            numbers=monitor.numbers(),
            week=weekly.week,
            counts=dict(weekly.counts),
        )


def about(station: Station) -> View:
    """Description of the loop: its controller, its signals, the controllers that could take its place."""
    controller = station.active_controller
    m = controller.manifest
    groups = {"sp": m.sp, "pv": m.pv, "mv": m.mv, "dv": m.dv}
    return {
        "title": f"{m.law} for {m.case}",
        "period_s": m.period_s,
        "speed": station.settings.speed,
        "signals": {name: [s.to_dict() for s in signals] for name, signals in groups.items()},
        "info": list(m.info),
        "operate": [{"name": e.name, **e.to_dict()} for e in m.operate],
        "operated": [] if station.snapshot is None else [[at, list(of)] for at, of in station.snapshot.operated],
        "bridge_s": BRIDGE_PERIODS * m.period_s if (of := station.settings.fresh.bridge_s) is None else of,
        "ahead": None if m.ahead is None else m.ahead.to_dict(),
        "columns": columns(m),
        "card": _card(controller),
        "folder": str(controller.path.absolute().parent),
        "first": str(station.controller.path.absolute()),
        "trusted": None if (keys := station.settings.trusted) is None else [str(key.absolute()) for key in keys],
        "warnings": [*station.warnings, *station.ending()],
    }


def state(station: Station) -> View:
    """How the loop stands now."""
    seen, now = station.snapshot, station.time.wall_s()
    if seen is None:
        trouble = station.endpoint.trouble
        return {
            "time": now,
            "scan": 0,
            "alive": False,
            "mode": station.settings.start,
            "reason": trouble,
            "connection": trouble,
            "sha256": station.controller.sha256,
            "verdicts": [],
            "warnings": station.ending(),
        }
    sample, command = seen.sample, seen.command
    applied = None if sample is None else sample.mv_applied
    patience = SILENT_PERIODS * station.manifest.period_s / station.settings.speed
    return {
        "time": seen.seen_s,
        "scan": command.scan,
        "alive": now - seen.seen_s <= patience,
        "mode": command.mode.value,
        "reason": command.fault,
        "sp": _plain(command.sp),
        "pv": _plain(None if sample is None else sample.pv),
        "mv": _plain(command.mv if command.writes else None),
        "applied": _plain(applied),
        "goal": _plain(seen.goal),
        "law": _plain(command.law_mv),
        "beside": _plain(command.successor_mv),
        "dv": _plain(None if sample is None else sample.dv),
        "info": _plain(command.info if seen.stepped is seen.controller else None),  # of the names in ``about``
        "operate": list(seen.operate),  # of the names in ``about``
        "courses": {name: _standing(course, seen.next_s) for name, course in seen.courses.items()},
        "bridged": dict(command.bridged),
        "shed": dict(command.shed),
        "unread_s": None if seen.inputs is None else _plain(seen.inputs.unread_s),
        "local": dict(command.local),
        "quality": [] if sample is None else [words(status) for status in sample.quality],
        "sha256": seen.controller.sha256,
        "successor": seen.successor,
        "replaced": None if seen.replaced is None else _named(seen.replaced),
        "connection": station.endpoint.trouble,
        "connections": station.endpoint.connections,
        "journal": station.journal.trouble,
        "journal_lost": station.journal.lost,
        "missed": seen.missed,
        "faults": seen.faults,
        "verdicts": [asdict(v) for v in seen.verdicts],
        "numbers": dict(seen.numbers),
        "week": {"began": seen.week, **shares(seen.counts)},
        "warnings": station.ending(),
    }


def _standing(course: Course, now_s: float) -> View:
    """A course by its last point, in seconds from the next scan; ``number`` tells it from others of its signal."""
    ends = {"ends_in_s": float(course.times_s[-1]) - now_s, "at": float(course.values[-1])}
    return {**ends, "who": course.who, "number": course.number}


def courses(station: Station) -> View:
    """The points of the courses that stand: those to come and the last one before, in seconds from the course's end."""
    seen = station.snapshot
    return {
        "courses": [] if seen is None else [_pointed(of, seen.next_s, of.times_s[-1]) for of in seen.courses.values()]
    }


def _pointed(course: Course, now_s: float, begin_s: float) -> View:
    """The points of a course that are to come and the last one before, in seconds from ``begin_s``."""
    first = max(0, int(np.searchsorted(course.times_s, now_s, side="right")) - 1)
    times, values = (course.times_s[first:] - begin_s).tolist(), course.values[first:].tolist()
    row = {"signal": course.signal, "straight": course.straight, "points": list(zip(times, values, strict=True))}
    return {**row, "who": course.who, "number": course.number}


def inputs(station: Station) -> View:
    """Inputs of the last step of the controller in charge, and its file: for who computes that step again.

    LoopError before the first one.
    """
    seen = station.snapshot
    if seen is None or seen.inputs is None:
        raise LoopError("the law in charge has not been stepped yet: nothing is known of its next moves")
    m = station.manifest
    return {
        "time": seen.stepped_s,
        "file": str(seen.controller.path.absolute()),
        "sha256": seen.controller.sha256,
        "signals": {name: [s.name for s in m.signals(name)] for name in ("pv", "dv")},
        "inputs": {name: value.tolist() for name, value in seen.inputs.values.items()},
        "operate": seen.inputs.operate.tolist(),
    }


def future(station: Station) -> View:
    """The same inputs, and the courses that stand, in seconds from that step: for who computes what comes after it."""
    found, seen = inputs(station), station.snapshot
    assert seen is not None
    assert seen.inputs is not None
    begin = seen.inputs.course_s
    return {**found, "courses": [_pointed(of, begin, begin) for of in seen.courses.values()]}


def _plain(values: Iterable[float] | None) -> list[float | None] | None:
    """Numbers for JSON, which has neither NaN nor infinity."""
    return None if values is None else [float(v) if isfinite(v) else None for v in values]


def _named(controller: Controller) -> View:
    return {"law": controller.manifest.law, "file": controller.path.name, "sha256": controller.sha256}


def _card(controller: Controller) -> View:
    m, evidence = controller.manifest, controller.manifest.evidence
    scenarios = evidence.get("scenarios")
    rows = scenarios if isinstance(scenarios, dict) else {}
    signed, certificate = signer(controller), certificate_of(m, controller.law_sha256)
    found = {
        "law": m.law,
        "case": m.case,
        "file": controller.path.name,
        "sha256": controller.sha256,
        "signed": None if signed is None else signed.to_dict(),
        "size_bytes": controller.size_bytes,
        "period_s": m.period_s,
        "commit": m.provenance.get("commit"),
        "versions": m.provenance.get("versions", {}),
        "lock_ups": evidence.get("lock_ups"),
        "unproven": judged(m).why,  # empty: it is proven
        "certificate": {"lines": list(certificate.lines), "wrong": certificate.wrong},
        "scenarios": {name: row for name, row in rows.items() if isinstance(row, dict)},
        "units": evidence.get("units", {}),
        "picture": picture(controller) is not None,
    }
    shown: View = plain_tree(found)  # provenance and evidence hold any text
    return shown


def picture(controller: Controller) -> Path | None:
    """The picture of the controller's closed loop beside its file, where there is one."""
    for name in PICTURES:
        path = controller.path.parent / name.format(stem=controller.path.stem)
        if path.is_file():
            return path
    return None


def _pictured(station: Station) -> View:
    path = picture(station.active_controller)
    return {"file": None if path is None else str(path.absolute())}


VIEWS: Mapping[str, Callable[[Station], View]] = {
    "about": about,
    "state": state,
    "inputs": inputs,
    "future": future,
    "courses": courses,
    "picture": _pictured,
}
