"""The answers of one reading: values in engineering units, and the first thing that is wrong with them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.guard import Fault
from loopwright.serving.manifest import Manifest
from loopwright.serving.opcua.nameplates import Nameplates
from loopwright.serving.opcua.plan import NodePlan, Role, Row
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.opcua.values import STATUS_BAD, STATUS_GOOD, STATUS_UNCERTAIN, NodeReading

CLOCK_DRIFT = 2e-4  # seconds a second by which two clocks may part
JUMP_S = 600.0  # by more than that no value is late: a clock was set
CONFIRMED = 3  # values of another clock's time before it is believed


@dataclass(slots=True)
class _Course:
    source: float = -inf  # the last source time [s]
    arrived: float = 0.0  # when it was first seen [s]
    age: float = 0.0  # as it was then [s]
    offset: float = inf  # least arrival minus source: the clocks' difference and the shortest way [s]
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=CONFIRMED))  # arrival minus source
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=CONFIRMED - 1))  # from arrival to arrival [s]
    before: float | None = None  # least arrival minus source before a clock was set that is not yet confirmed


class Ages:
    """Ages of values from the source times that come with them, and from when they arrive here.

    The source's clock and ours differ by an unknown offset. The least difference ever seen is that offset and the
    shortest way; what a value takes longer than that is its age. While the same source time comes again, the value
    grows older.

    A value that is late still comes after the one before it, so a source time that goes back tells that a clock was
    set, or that the stamp before it was wrong. The new offset is believed once ``CONFIRMED`` values agree on it that
    came in a steady rhythm; how old the values were before the jump is kept. A clock that is set back by less than the
    time between two values looks like values that take so much longer, and counts as that.
    """

    def __init__(self, n: int) -> None:
        self._courses = [_Course() for _ in range(n)]

    def update(self, arrived: float, sources: Sequence[float | None]) -> list[float]:
        """Age [s] of each value; of one without a source time 0, since only its arrival is known."""
        return [_aged(c, arrived, s) for c, s in zip(self._courses, sources, strict=True)]


def _aged(c: _Course, arrived: float, source: float | None) -> float:
    if source is None:
        return 0.0
    if source == c.source:
        return c.age + arrived - c.arrived
    lag = arrived - source
    relaxed = c.offset + CLOCK_DRIFT * (arrived - c.arrived)
    if source < c.source:
        c.before = min(c.recent) if c.before is None else c.before
        c.recent.clear()
        c.steps.clear()
    elif c.recent:
        c.steps.append(arrived - c.arrived)
    c.recent.append(lag)
    spread = max(c.recent) - min(c.recent) if len(c.recent) == CONFIRMED else inf
    if lag < relaxed:
        c.offset, c.before = lag, None
    elif lag - relaxed > JUMP_S and spread < JUMP_S / 10:
        c.offset, c.before = min(c.recent), None
    elif c.before is not None and spread < min(c.steps, default=0.0):
        c.offset, c.before = relaxed + min(c.recent) - c.before, None
    else:
        c.offset = relaxed
    c.source, c.arrived, c.age = source, arrived, lag - c.offset
    return c.age


# ------------------------------------------------------------------------------------------------------------ sampling
Array: TypeAlias = NDArray[np.float64]

NO_NUMBERS = ("nan", "inf", "-inf")
SLOW = (
    "the plant's watchdog moves, but not within {} scans: the plant runs at another speed than `speed` in loop.toml "
    "says, or `nodes.watchdog_scans` is too small"
)


@dataclass(frozen=True, slots=True)
class Values:
    """Result of one reading. ``quality`` has a status for each PV, then each MV, then each DV that is read.

    ``fault`` speaks against all of it; ``bad_pv`` against single PVs, in a text for each, or empty.
    """

    arrived_s: float  # on the endpoint's clock
    pv: Array  # shape: (n_pv,)
    mv: Array  # shape: (n_mv,)
    dv: Array  # shape: (n_dv,)
    age_s: float
    fault: str
    quality: tuple[int, ...]
    asked_sp: Mapping[str, float] = field(default_factory=dict)
    asked_mode: str = ""
    ages: Mapping[str, float] = field(default_factory=dict)  # [s] of each measured value, by name
    starts: int = 0  # how often the server has started anew since the endpoint did
    unheard: Mapping[str, str] = field(default_factory=dict)  # why a set point or the mode is no request, by name
    bad_pv: tuple[str, ...] = ()
    asked_operate: Mapping[str, float] = field(default_factory=dict)
    local: tuple[str, ...] = ()  # why the plant has each MV itself, or it is read badly alone; or empty
    stamps: Mapping[str, float] = field(default_factory=dict)  # source times [s] of analysers that have one, by PV


class NodeSampling:
    """Makes values of answers. It remembers the plant's watchdog, and the nodes' types, from reading to reading."""

    def __init__(self, manifest: Manifest, server: Server, nodes: Nodes, nameplates: Nameplates | None = None) -> None:
        self.manifest, self.server, self.nodes = manifest, server, nodes
        self.nameplates = nameplates or Nameplates(nodes, manifest)
        self._local: dict[
            str, str
        ] = {}  # why the plant has an MV by its own node; one that cannot be read tells nothing
        self.serve(manifest)
        self._watched = float("nan"), 0  # the watchdog, and for how many readings it has stood there
        self._dead, self._slow = "", False  # why the plant counts as dead; whether its watchdog has moved since

    def serve(self, law: Manifest) -> None:
        """The law in charge: without which readings it goes on, where they alone are bad."""
        self.apart = "fresh" in law.inputs
        able = {e.signal for e in law.operate if e.group == "mv" and e.what == "use" and "operate" in law.inputs}
        self.mvs_apart = able

    def valued(
        self,
        plan: NodePlan,
        answers: Sequence[NodeReading],
        ages: Ages,
        arrived_s: float,
        *,
        unbeaten: str,
        starts: int,
    ) -> Values:
        """Values that arrived at ``arrived_s``; ``unbeaten`` says why the last heartbeat did not arrive."""
        fault, typed, found, unheard = "", "", dict[str, float](), dict[str, str]()
        bad, away = list[str](), dict[str, str]()
        for row, answer in zip(plan.rows, answers, strict=False):
            name, point = row.name, row.point
            usable = answer.quality == STATUS_GOOD or (
                answer.quality == STATUS_UNCERTAIN and self.server.uncertain == "use"
            )
            # What nobody judges, a set point or a mode of the plant's side, is none where its quality is not good; nor
            # is a read-back, which says where the MV stands also while a PV is bad.
            told = usable or row.ages or row.stands
            found[name] = point.scale * answer.number + point.offset if told else np.nan
            if usable and not answer.text and (row.judged or row.request):
                changed = self.nameplates.typed(row, answer.kind)
                changed = changed or (self.nameplates.wrong.get(name, "") if row.request else "")
                if changed:  # another number: no PV to be shown, no place of the MV, no request
                    found[name] = np.nan
                    if row.request:
                        unheard[name] = changed
                    typed = typed or ("" if row.request else changed)
            of = "" if row.signal is None else row.signal.name
            alone = row.role is Role.MV and of in self.mvs_apart
            if row.judged and not (fault and row.role is not Role.PV and not alone):
                why = self._wrong(row, answer)
                if row.role is Role.PV:
                    bad.append(why)
                if alone and why:
                    away[of] = why
                fault = fault or ("" if alone or (self.apart and row.role is Role.PV) else why)
            if row.role is Role.LOCAL:
                self._tells(of, answer, usable=usable)
        judge = self.server.source_time == "judge"
        timed = ages.update(arrived_s, [answers[i].source_s if judge else None for i in plan.timed])
        m = self.manifest
        asked_sp = {s.name: found[f"SP {s.name}"] for s in m.sp if np.isfinite(found.get(f"SP {s.name}", np.nan))}
        mode = ""
        if self.nodes.mode is not None:
            wanted = found["mode"]
            mode = next((name for name, value in self.nodes.mode.values.items() if value == wanted), "")
        if self.nodes.watchdog and not fault:
            fault = self.dead(found["watchdog"])
        fault = fault or typed or self.nameplates.fault or unbeaten
        n = len(m.pv) + len(m.mv) + len(plan.dvs)
        away = {name: why for name, why in (away | self._local).items() if name in self.mvs_apart}
        return Values(
            arrived_s,
            np.array([found[f"PV {s.name}"] for s in m.pv]),
            np.array([found[f"MV {s.name}"] for s in m.mv]),
            np.array([found.get(f"DV {s.name}", 0.0) for s in m.dv]),
            max(timed, default=0.0),
            fault,
            tuple(a.status for a in answers[:n]),
            asked_sp,
            mode,
            {plan.rows[i].name: age for i, age in zip(plan.timed, timed, strict=True)},
            starts,
            unheard,
            tuple(bad) if self.apart and any(bad) else (),
            {
                e.name: found[f"operate {e.name}"]
                for e in m.operate
                if np.isfinite(found.get(f"operate {e.name}", np.nan))
            },
            tuple(away.get(s.name, "") for s in m.mv) if away else (),
            {
                row.signal.name: answer.source_s
                for row, answer in zip(plan.rows, answers, strict=False)
                if row.stands and row.signal is not None and answer.source_s is not None
            },
        )

    def _tells(self, name: str, answer: NodeReading, *, usable: bool) -> None:
        """Keep what an MV's own node says of it; one that is read badly leaves it as it was."""
        if not usable or not (answer.words_held or np.isfinite(answer.number)):
            return
        self._local.pop(name, None)
        if self.nodes.local[name].plants(answer.number, answer.words_held):
            said = answer.words_held or f"{answer.number:g}"
            self._local[name] = Fault(f"MV {name} is the plant's: its node says {said}", "local", f"MV {name}")

    def _wrong(self, row: Row, answer: NodeReading) -> str:
        """Why a value is not used; empty: it is."""
        name = row.name
        if answer.quality == STATUS_BAD or (answer.quality == STATUS_UNCERTAIN and self.server.uncertain == "fault"):
            return Fault(f"{name}: {answer.words}", f"quality {answer.words}", name)
        return Fault(f"{name}: {_given(row, answer.text)}", "number", name) if answer.text else ""

    def dead(self, watchdog: float) -> str:
        """Why the server's side counts as dead; empty while its watchdog moves.

        One that has stood is believed once it moves twice within ``watchdog_scans``: a slow one would else make a fault
        of each of its values.
        """
        last, scans = self._watched
        most = self.nodes.watchdog_scans
        if watchdog != last and not np.isnan(watchdog):  # one that is gone has stopped, too
            self._watched = watchdog, 0
            self._dead, self._slow = ("", False) if scans < most else (self._dead, bool(self._dead))
            return self._dead
        self._watched = watchdog, scans + 1
        if scans + 1 >= most:
            stands = f"the plant's watchdog has stood at {watchdog:g} for {scans + 1} scans"
            self._dead = SLOW.format(most) if self._slow else stands
        return self._dead


def _given(row: Row, text: str) -> str:
    """The kind of a value that is no number; of NaN and infinity also who gives it."""
    by = "read-back" if row.role is Role.MV else "sensor"
    return f"{text}: the {by} gives no number" if text in NO_NUMBERS else text
