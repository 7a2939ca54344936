"""The control loop that settings describe, and what is in its way before it is connected."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from loopwright.serving.clock import Clock
from loopwright.serving.controller import Controller
from loopwright.serving.endpoint import Endpoint
from loopwright.serving.errors import LoopError, LoopwrightError
from loopwright.serving.journal.file import lock_of, opened
from loopwright.serving.journal.file_lock import LockTakenError, locked
from loopwright.serving.loop import WARM_LEAD_S, ControlLoop, Mode
from loopwright.serving.opcua.nameplates import Identity
from loopwright.serving.page.settings import listening, require_usable
from loopwright.serving.proof import require_accepted
from loopwright.serving.station.lease import Lease
from loopwright.serving.station.settings import Settings
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
