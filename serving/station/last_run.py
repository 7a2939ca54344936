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

    def lost(self, loop: ControlLoop) -> dict[str, str]:
        """The values that stand otherwise in ``loop``: each in words, and how it stands now."""
        m, now = loop.controller.manifest, Steered.of(loop)
        entries = {e.name: (e.unit, v) for e, v in zip(m.operate, loop.operate.tolist(), strict=True)}
        units = {s.name: s.unit for s in m.sp}
        found = {
            f"set point {name} {value:g} {units[name]}": f"{now.sp[name]:g}"
            for name, value in self.sp.items()
            if name in units and now.sp[name] != value
        }
        for name, value in self.operate.items():
            unit, present = entries.get(name, ("", None))
            if present != value:
                found[f"{name} {value:g} {unit}".rstrip()] = "no entry" if present is None else f"{present:g}"
        return found

    def compare(self, loop: ControlLoop, note: Callable[[str, str], None]) -> None:
        """Say in a line what the last loop had set that stands otherwise in this one."""
        lost = "; ".join(f"{words}, now {present}" for words, present in self.lost(loop).items())
        if lost:
            note(f"the last loop ended with other values: {lost}", "restore = true in loop.toml takes them")

    def restore(self, loop: ControlLoop, note: Callable[[str, str], None]) -> None:
        """Set these values in a loop of the same controller, and say it; one that is not valid is said, and left."""
        lost = self.lost(loop)
        if not lost:
            return
        if self.sha256 != loop.controller.sha256:
            note(f"nothing is restored: another controller had {'; '.join(lost)}", "")
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
        taken = [words for words in lost if words not in self.lost(loop)]
        if taken:
            note(f"restored: {'; '.join(taken)}", "the last loop ended with them")


def _numbers(tree: Any) -> dict[str, float]:
    """The numbers by name of what a journal holds, which anybody may have changed."""
    found = tree if isinstance(tree, dict) else {}
    return {str(n): float(v) for n, v in found.items() if is_number(v)}
