"""Values that operators had set when a loop last ended: kept in the journal, said at the next start, and taken back."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from loopwright.serving.errors import LoopError
from loopwright.serving.fields import is_number
from loopwright.serving.journal import Journal, JournalReader
from loopwright.serving.loop import ControlLoop
from loopwright.serving.station.change_words import moved_words, operate_words
from loopwright.serving.words import first_line

STEERED = "steered"  # what it is kept under


def kept_at_end(journal: Path, name: str) -> dict[str, Any]:
    """The entries that the last loop of a journal kept under ``name``, its controller's ``sha256`` among them.

    Empty where the journal does not tell.
    """
    kept: Any = None
    with suppress(LoopError, sqlite3.Error, ValueError, RecursionError), closing(JournalReader(journal)) as reader:
        kept = json.loads(reader.learnt(name) or "{}")
    return kept if isinstance(kept, dict) and isinstance(kept.get("sha256"), str) else {}


@dataclass(frozen=True, slots=True)
class Steered:
    """The set points of a loop, and the values of ``operate`` that somebody had set, by name; of which controller."""

    sha256: str = ""
    sp: Mapping[str, float] = field(default_factory=dict)
    operate: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, loop: ControlLoop, before: Steered | None = None) -> Self:
        """The values of a loop now; a set point on its course as it was ``before``, which is what somebody set."""
        controller, courses = loop.controller, loop.courses.ends
        sp = {s.name: v for s, v in zip(controller.manifest.sp, loop.sp.tolist(), strict=True)}
        sp |= {} if before is None else {name: v for name, v in before.sp.items() if name in courses and name in sp}
        return cls(controller.sha256, sp, loop.wishes)

    @classmethod
    def before(cls, journal: Path) -> Self:
        """The values that the last loop of a journal ended with; empty where it does not tell."""
        found = kept_at_end(journal, STEERED)
        return cls(found["sha256"], _numbers(found.get("sp")), _numbers(found.get("operate"))) if found else cls()

    def keep(self, journal: Journal) -> None:
        """Write it down."""
        text = json.dumps({"sha256": self.sha256, "sp": dict(self.sp), "operate": dict(self.operate)})
        journal.keep(STEERED, text)

    def lost(self, loop: ControlLoop) -> Steered:
        """Those of the values that stand otherwise in ``loop``."""
        present = _present(loop)
        return Steered(
            self.sha256,
            {n: v for n, v in self.sp.items() if n in present.sp and present.sp[n] != v},
            {n: v for n, v in self.operate.items() if present.operate.get(n) != v},
        )

    def words(self, before: Steered, loop: ControlLoop) -> str:
        """The values of this one that are others than ``before``, as a change from there; of ``loop``'s signals."""
        m, parts = loop.controller.manifest, []
        points = [s for s in m.sp if s.name in self.sp and s.name in before.sp]
        if points:
            old, new = ([of.sp[s.name] for s in points] for of in (before, self))
            parts.append(moved_words(old, new, points, "set point"))
        if self.operate:
            parts.append(operate_words(m.operate, before.operate, self.operate, m.period_s))
        return "; ".join(parts)

    def compare(self, loop: ControlLoop, note: Callable[[str, str], None]) -> None:
        """Say in a line what the last loop had set that stands otherwise in this one."""
        lost = self.lost(loop)
        if lost:
            now = _present(loop).among(lost)
            gone = [f"{n} {v:g}, which this law does not have" for n, v in lost.operate.items() if n not in now.operate]
            words = "; ".join(filter(None, (now.words(lost, loop), *gone)))
            why = "restore = true in loop.toml takes back what the last one ended with"
            note(f"this loop begins with other values than the last one ended with: {words}", why)

    def restore(self, loop: ControlLoop, note: Callable[[str, str], None]) -> None:
        """Set these values in a loop of the same controller, and say it; one that is not valid is said, and left."""
        lost, before = self.lost(loop), _present(loop)
        if not lost:
            return
        if self.sha256 != loop.controller.sha256:
            note(f"nothing is restored: another controller had {lost.words(before, loop)}", "")
            return
        sp = [self.sp.get(s.name, v) for s, v in zip(loop.controller.manifest.sp, loop.sp.tolist(), strict=True)]
        refused = []
        acts: list[Callable[[], object]] = [lambda: loop.set_sp(sp)]
        acts += [lambda: loop.set_operate(self.operate)] if self.operate else []
        for act in acts:
            try:
                act()
            except LoopError as error:
                refused.append(first_line(error))
        if refused:
            note(f"not restored: {'; '.join(refused)}", "")
        left = self.lost(loop)
        taken = Steered(
            self.sha256,
            {n: v for n, v in lost.sp.items() if n not in left.sp},
            {n: v for n, v in lost.operate.items() if n not in left.operate},
        )
        if taken:
            note(f"restored: {taken.words(before, loop)}", "the last loop ended so")

    def among(self, others: Steered) -> Steered:
        """These values under the names of ``others``."""
        sp = {n: self.sp[n] for n in others.sp if n in self.sp}
        return Steered(self.sha256, sp, {n: self.operate[n] for n in others.operate if n in self.operate})

    def __bool__(self) -> bool:
        return bool(self.sp or self.operate)


def _present(loop: ControlLoop) -> Steered:
    """All values of ``loop`` as they stand, also those that nobody has set."""
    m = loop.controller.manifest
    sp = {s.name: v for s, v in zip(m.sp, loop.sp.tolist(), strict=True)}
    return Steered(
        loop.controller.sha256, sp, {e.name: v for e, v in zip(m.operate, loop.operate.tolist(), strict=True)}
    )


def _numbers(tree: Any) -> dict[str, float]:
    """The numbers by name of what a journal holds, which anybody may have changed."""
    found = tree if isinstance(tree, dict) else {}
    return {str(n): float(v) for n, v in found.items() if is_number(v)}
