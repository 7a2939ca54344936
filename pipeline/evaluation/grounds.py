"""What figures of tests on identified models rest on: the models' free-run fit, and what lies beyond the data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

ON_MODELS = "on models identified from your data"


@dataclass(frozen=True, slots=True)
class Grounds:
    """Free-run fit [%] of the models over rows that their fit never saw, by CV, and what lies beyond the data.

    ``set_points``, ``loops``: how far set points, and PVs and MVs in closed loops, go beyond the range of the record,
    in % of that range, by signal; signals that stay within are left out. A fit is None where the run exploded.
    ``unproven``: why the record does not prove the models, each to go on a sentence: ``not proven: ...``.
    """

    fit: Mapping[str, float | None]
    set_points: Mapping[str, float]
    loops: Mapping[str, float]
    unproven: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Where tests ran and what that is worth, to go on a sentence."""
        return "; ".join((f"{ON_MODELS} ({self.figures})", *self.unproven))

    @property
    def figures(self) -> str:
        """The figures in words."""
        fits = ", ".join(f"{name} {'none' if fit is None else f'{fit:.3g} %'}" for name, fit in self.fit.items())
        inside = "set points stay within the data" if not self.set_points else f"set points go {_far(self.set_points)}"
        left = "PVs and MVs do, too" if not self.set_points else "PVs and MVs stay within"
        loops = left if not self.loops else f"in closed loop {_far(self.loops, 'goes')}"
        return f"free-run fit over unseen rows: {fits}; {inside}; {loops}"

    @property
    def warning(self) -> str:
        """Sentences: what is not proven, and where set points go beyond the record; empty where there is neither."""
        sentences = [f"{why[:1].upper()}{why[1:]}." for why in self.unproven]
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
        unproven = figures.pop("unproven")
        return {"words": self.words, **figures, **({"unproven": list(unproven)} if unproven else {})}


def _far(of: Mapping[str, float], verb: str = "") -> str:
    verb = f" {verb}" if verb else ""
    return ", ".join(f"{name}{verb} {value:.3g} % of its recorded range beyond it" for name, value in of.items())
