"""The basis of figures of tests on identified models: the models' free-run fit, and what lies beyond the data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from loopwright.pipeline.files import read_json
from loopwright.pipeline.records.old_loops import OldController, Operated

SCREENING = "screening.json"
"""Beside the record of an own plant: what `loopwright new` or stage `screen` found of it."""
ON_MODELS = "on models identified from your data"


@dataclass(frozen=True, slots=True)
class RecordVerdict:
    """The verdict of the screening on a plant's record.

    ``carries``: whether it can carry a model, yes, doubtful or no; ``reasons``: why not yes, a clause each;
    ``operated``: how the plant was run, a clause for each loop whose set point is known; ``old_controllers``: the law
    of each of them.
    """

    carries: str
    reasons: tuple[str, ...] = ()
    operated: tuple[str, ...] = ()
    old_controllers: tuple[OldController, ...] = ()

    @classmethod
    def beside(cls, record: Path) -> Self | None:
        """The verdict on a record, of the file beside it; None where there is none, as for a record of one's own."""
        path = record.with_name(SCREENING)
        if not path.is_file():
            return None
        found = read_json(path)
        verdict = found.get("verdict") or {}
        loops = (Operated(**loop).words for loop in found.get("operated") or ())
        reasons = tuple(map(str, verdict.get("reasons") or ()))
        laws = tuple(OldController(**law) for law in found.get("old_controllers") or ())
        return cls(str(verdict.get("carries", "")), reasons, tuple(loops), laws)

    @property
    def doubt(self) -> str:
        """Why a model of the record is doubtful, to go on a sentence; empty where nothing speaks against one."""
        if self.carries in {"", "yes"}:
            return ""
        words = "a model of these data is doubtful" if self.carries == "doubtful" else "these data carry no model"
        return f"{words}: {'; '.join(self.reasons)}" if self.reasons else words


@dataclass(frozen=True, slots=True)
class Grounds:
    """Free-run fit [%] of the models over rows that their fit never saw, by CV, and what lies beyond the data.

    ``set_points``, ``loops``: how far set points, and PVs and MVs in closed loops, go beyond the range of the record,
    in % of that range, by signal; signals that stay within are left out. ``farthest``: by signal, the law whose loops
    go farthest. ``record``: what its screening said of the record, None without one. A fit is None where the run
    exploded.
    ``unproven``: why the record does not prove the models, each to go on a sentence: ``not proven: ...``.
    """

    fit: Mapping[str, float | None]
    set_points: Mapping[str, float]
    loops: Mapping[str, float]
    unproven: tuple[str, ...] = ()
    record: RecordVerdict | None = None
    farthest: Mapping[str, str] = field(default_factory=dict)
    proven: bool = False  # rows that no fit saw prove the models, whatever its screening said
    ahead: int | None = None  # samples that the fit was predicted ahead at most, where loads were modelled; None: all

    @property
    def doubt(self) -> str:
        """Why a model of the record is doubtful, by its screening; empty where it is not, or nobody screened it.

        Where the models are proven later it stands as what it was: a doubt before there was a model.
        """
        if self.record is None:
            return ""
        if not self.proven or not self.record.doubt:
            return self.record.doubt
        return f"the screening doubted these data ({'; '.join(self.record.reasons)}), and the models are proven since"

    @property
    def operated(self) -> tuple[str, ...]:
        """How the plant was run in the record, a clause for each loop whose set point is known."""
        return () if self.record is None else self.record.operated

    @property
    def old_controllers(self) -> tuple[OldController, ...]:
        """The old law of each loop whose set point is known, believed or not."""
        return () if self.record is None else self.record.old_controllers

    @property
    def words(self) -> str:
        """Where tests ran and what that is worth, to go on a sentence."""
        return "; ".join(filter(None, (f"{ON_MODELS} ({self.figures})", self.doubt, *self.unproven)))

    @property
    def figures(self) -> str:
        """The figures in words."""
        fits = ", ".join(f"{name} {'none' if fit is None else f'{fit:.3g} %'}" for name, fit in self.fit.items())
        inside = "set points stay within the data" if not self.set_points else f"set points go {_far(self.set_points)}"
        left = "PVs and MVs do, too" if not self.set_points else "PVs and MVs stay within"
        loops = left if not self.loops else f"in closed loop {_far(self.loops, 'goes', self.farthest)}"
        how = "free-run fit" if self.ahead is None else f"fit of predictions up to {self.ahead} samples ahead"
        return f"{how} over unseen rows: {fits}; {inside}; {loops}"

    @property
    def warning(self) -> str:
        """Sentences: what is doubtful or not proven, and where set points go beyond the record; else empty."""
        sentences = [f"{why[:1].upper()}{why[1:]}." for why in filter(None, (self.doubt, *self.unproven))]
        return " ".join((*sentences, *self._beyond))

    @property
    def _beyond(self) -> tuple[str, ...]:
        if not self.set_points:
            return ()
        far = ", ".join(f"{name} by {value:.3g} % of its recorded range" for name, value in self.set_points.items())
        return (f"Set points of the tests go beyond the record, {far}: figures there rest on no data.",)

    def to_dict(self) -> dict[str, Any]:
        """For the manifest: the figures, and the sentence."""
        figures = asdict(self)
        left_out = ("unproven", "record", "farthest", "ahead", "proven")
        unproven, record, _, ahead, _ = (figures.pop(name) for name in left_out)
        further = {"unproven": list(unproven)} if unproven else {}
        further |= {} if ahead is None else {"ahead": ahead}
        further |= {"data": record["carries"], "data_reasons": list(record["reasons"])} if record else {}
        return {"words": self.words, **figures, **further}


def _far(of: Mapping[str, float], verb: str = "", under: Mapping[str, str] | None = None) -> str:
    verb, law = f" {verb}" if verb else "", under or {}
    return ", ".join(
        f"{name}{verb} {value:.3g} % of its recorded range beyond it" + (f" under {law[name]}" if name in law else "")
        for name, value in of.items()
    )
