"""The control loop that settings describe, what is in its way before it is connected, and where it begins."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.clock import Clock
from loopwright.serving.controller import Controller
from loopwright.serving.endpoint import Endpoint
from loopwright.serving.errors import LoopError, LoopwrightError
from loopwright.serving.guard import implausible
from loopwright.serving.journal import Journal, JournalReader
from loopwright.serving.journal.file import LockTakenError, lock_of, locked, opened
from loopwright.serving.loop import WARM_LEAD_S, ControlLoop, Mode
from loopwright.serving.manifest import Signal
from loopwright.serving.opcua.nameplates import Identity, KnownNode
from loopwright.serving.opcua.sampling import Values
from loopwright.serving.page.process import listening, require_usable
from loopwright.serving.station.mv_lock import Lease, address_of
from loopwright.serving.station.settings import Settings
from loopwright.serving.trust import require_accepted
from loopwright.serving.words import first_line


# ------------------------------------------------------------------------------------------------------------ the loop
def control_loop(
    settings: Settings,
    controller: Controller,
    endpoint: Endpoint | None = None,
    *,
    sp: Sequence[float] | None = None,
    mv: Sequence[float] | None = None,
    clock: Clock | None = None,
) -> ControlLoop:
    """A loop with the guards, the fallback and the transfer of its settings. LoopError where they do not fit.

    ``sp`` (n_sp,) are the set points that it begins with, the middle of their ranges unless given; ``mv`` (n_mv,) is
    the MV that the plant has, None where it is not known.
    """
    s, m = settings, controller.manifest
    if s.start == "AUTO":
        require_accepted(m, s.accept_unproven)
    return ControlLoop(
        controller,
        endpoint,
        sp=[signal.middle for signal in m.sp] if sp is None else sp,
        mv=mv,
        mode=Mode(s.start),
        guards=lambda manifest: s.guards.of(manifest, s.max_age_s(manifest.period_s)),
        recover_after=s.hold.recover_after or None,
        clock=clock,
        warm_lead_s=WARM_LEAD_S * s.speed,
        transfer_s=s.over_s(m.period_s),
        fallback=s.hold.fallback(m.mv),
        operate=s.operate,
        bridge_s=s.fresh.bridge_s,
        critical=s.fresh.critical,
        local_s=s.local.after_s,
    )


# -------------------------------------------------------- obstacles on its own machine: its parts are made, and let go
@dataclass
class Rehearsal:
    """A line for each part. ``wrong`` would stop the loop, ``notes`` a person should know."""

    wrong: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    runs: bool = False  # this very loop does, already

    def tried(self, make: Callable[[], object]) -> None:
        """Make a part, and say once why it cannot be made."""
        try:
            make()
        except (LoopwrightError, OSError) as error:
            if first_line(error) not in self.wrong:
                self.wrong.append(first_line(error))


def rehearsed(settings: Settings, controller: Controller) -> Rehearsal:
    """Make what ``loop run`` makes; the plant, the journal and a loop that runs already are left as they are."""
    found, page = Rehearsal(), settings.served()
    found.tried(lambda: control_loop(settings, controller))
    owner = _owner(settings.journal.file)
    found.runs = bool(owner)
    if owner:
        found.notes.append(
            f"this loop runs already (process {owner}); its MVs, its journal and its page's address are its own"
        )
    else:
        found.tried(lambda: require_free(settings))
        found.tried(lambda: _require_journal(settings.journal.file))
        if page is not None:
            found.tried(lambda: listening(page).close())
    if page is not None:
        found.tried(page.token)
        found.tried(lambda: require_usable(page))
    return found


def _owner(journal: Path) -> str:
    """The process of the loop that writes a journal now; empty: none does."""
    lock = lock_of(journal)
    if not lock.is_file():
        return ""
    try:
        os.close(locked(lock))
    except LockTakenError as error:
        return error.owner
    except (LoopError, OSError):
        return ""
    return ""


def require_free(settings: Settings, found: Identity | None = None) -> None:
    """LoopError where another loop writes one of the MVs, also as the server that was ``found`` calls them."""
    lease = Lease(settings.server.endpoint, [p.node for p in settings.nodes.points("mv").values()])
    try:
        if found is not None:
            lease.claim(found.writes, found.nodes)
        if lease.lost:
            raise LoopError(lease.lost)
    finally:
        lease.release()


def _require_journal(journal: Path) -> None:
    """LoopError where the file is no journal, or none can be written there."""
    if journal.exists():
        with closing(opened(journal, write=False)):
            pass
    folder = journal.resolve().parent
    if not folder.is_dir():
        raise LoopError(f"{journal} cannot be written: there is no folder {folder}; make it, or name another file")
    for path in (folder, journal, lock_of(journal)):
        if path.exists() and not os.access(path, os.W_OK):
            raise LoopError(f"{journal} cannot be written: this user may not write {path}")


Array: TypeAlias = NDArray[np.float64]

NAMESPACES, NODES = "namespaces", "nodes"  # what they are kept under


def usable(values: Values | None) -> bool:
    """Whether a loop may begin where these values say that the plant is."""
    return (
        values is not None
        and not (values.fault or values.bad_pv)
        and bool(np.isfinite(values.pv).all() and np.isfinite(values.mv).all())
    )


def near(values: Array | None, signals: tuple[Signal, ...]) -> list[float]:
    """A start within the ranges: what the plant has, or the middle where it is not known."""
    if values is None or not np.isfinite(values).all():
        return [s.middle for s in signals]
    return [_allowed(v, s) for v, s in zip(values.tolist(), signals, strict=True)]


def begun_at(mv: Array, signals: tuple[Signal, ...]) -> list[float] | None:
    """The MVs that a loop begins with; None where no actuator can stand there: the first good sample then tells."""
    if implausible(signals, mv.tolist()):
        return None
    return [_allowed(v, s) for v, s in zip(mv.tolist(), signals, strict=True)]


def another_before(journal: Path, controller: Controller) -> str:
    """Notice that the last loop of a journal ended with another controller, in one line; else empty."""
    runs: list[dict[str, object]] = []
    with suppress(LoopError, sqlite3.Error), closing(JournalReader(journal)) as reader:
        runs = reader.runs()
    if not runs or runs[-1]["sha256"] == controller.sha256:
        return ""
    last = f"{runs[-1]['controller']} ({str(runs[-1]['sha256'])[:12]})"
    return f"begins with {controller.path.name} ({controller.sha256[:12]}); the journal's last controller was {last}"


def keep_namespaces(journal: Journal, endpoint: str, spaces: Mapping[int, str]) -> None:
    """Write down which namespace each number stands for at a server, for the next run of the loop."""
    journal.keep(NAMESPACES, json.dumps({"endpoint": endpoint, "spaces": spaces}))


def namespaces_before(journal: Path, endpoint: str) -> dict[int, str]:
    """The namespaces by number that the last run found at this server; empty where a journal tells of none.

    The server is the same one however its address is spelt.
    """
    with suppress(LoopError, sqlite3.Error, ValueError, RecursionError), closing(JournalReader(journal)) as reader:
        kept = json.loads(reader.learnt(NAMESPACES) or "{}")
        spaces, at = (kept.get("spaces"), kept.get("endpoint")) if isinstance(kept, dict) else (None, None)
        same = isinstance(at, str) and (at == endpoint or address_of(at) == address_of(endpoint))
        if same and isinstance(spaces, dict):
            return {int(number): uri for number, uri in spaces.items() if isinstance(uri, str) and uri}
    return {}


def keep_nodes(journal: Journal, seen: Mapping[str, KnownNode]) -> None:
    """Write down as what the loop's nodes were seen, for its next run."""
    journal.keep(NODES, json.dumps(seen))


def nodes_before(journal: Path) -> dict[str, KnownNode]:
    """The nodes by row as the last run of the loop saw them; empty where a journal tells of none."""
    with suppress(LoopError, sqlite3.Error, ValueError, RecursionError), closing(JournalReader(journal)) as reader:
        kept = json.loads(reader.learnt(NODES) or "{}")
        if isinstance(kept, dict):
            whole = {
                row: seen
                for row, seen in kept.items()
                if isinstance(seen, list) and len(seen) == len(KnownNode._fields)
            }
            return {row: KnownNode(*map(str, seen)) for row, seen in whole.items()}
    return {}


def _allowed(value: float, signal: Signal) -> float:
    """The nearest value that the signal may have."""
    if signal.values is not None:
        return min(signal.values, key=lambda a: abs(a - value))
    return min(max(value, signal.low), signal.high)
