"""A running loop as others see it: what it is, and how it stands; JSON-ready."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from loopwright.serving.controller import Controller
from loopwright.serving.guard import Sample
from loopwright.serving.journal import columns
from loopwright.serving.loop import Command, ControlLoop
from loopwright.serving.monitor import Verdict
from loopwright.serving.monitor.weekly_report import shares
from loopwright.serving.opcua.values import words
from loopwright.serving.trust import judged, signer
from loopwright.serving.words import plain_tree

if TYPE_CHECKING:
    from loopwright.serving.station.recorder import MonitorRunner
    from loopwright.serving.station.station import Station

View = dict[str, Any]

SILENT_PERIODS = 3  # without a scan: the loop counts as dead
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
    operate: tuple[float, ...]  # as operators want it of the controller in charge
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
    ) -> Self:
        """After a scan ``seen``, by the controller ``stepped``; ``counts``: periods missed, scans with a fault."""
        sample, command, seen_s = seen
        new = loop.successor
        successor = None
        if new is not None:
            successor = {**_named(new.controller), "good": new.good, "trial": new.trial, "reason": new.reason}
        monitor, weekly = watching.monitor, watching.weekly
        operate, told = tuple(map(float, loop.operate)), (tuple(monitor.verdicts()), monitor.numbers())
        who, week = (loop.controller, stepped, successor, loop.replaced), (weekly.week, dict(weekly.counts))
        return cls(seen_s, sample, command, *who, *counts, operate, *told, *week)


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
        "columns": columns(m),
        "card": _card(controller),
        "folder": str(controller.path.absolute().parent),
        "first": str(station.controller.path.absolute()),
        "trusted": None if (keys := station.settings.trusted) is None else [str(key.absolute()) for key in keys],
        "warnings": [*station.warnings, *station.ending()],
    }


def state(station: Station) -> View:
    """How the loop stands now."""
    seen, now = station.snapshot, time.time()
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
        "law": _plain(command.law_mv),
        "beside": _plain(command.successor_mv),
        "dv": _plain(None if sample is None else sample.dv),
        "info": _plain(command.info if seen.stepped is seen.controller else None),  # of the names in ``about``
        "operate": list(seen.operate),  # of the names in ``about``
        "bridged": dict(command.bridged),
        "shed": dict(command.shed),
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


def _plain(values: Iterable[float] | None) -> list[float | None] | None:
    """Numbers for JSON, which has neither NaN nor infinity."""
    return None if values is None else [float(v) if isfinite(v) else None for v in values]


def _named(controller: Controller) -> View:
    return {"law": controller.manifest.law, "file": controller.path.name, "sha256": controller.sha256}


def _card(controller: Controller) -> View:
    m, evidence = controller.manifest, controller.manifest.evidence
    scenarios = evidence.get("scenarios")
    rows = scenarios if isinstance(scenarios, dict) else {}
    signed = signer(controller)
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
