"""An own plant takes the linear model where its record refuses the network and proves that one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from loopwright.pipeline.models.identified.structure_search import Searched, Selection, StructureSearch
from loopwright.pipeline.models.part import Groundwork, Learnt, Part, Source, done
from loopwright.pipeline.stages.fit import Fits


@dataclass
class Saved:
    what: str
    kind: ClassVar[str] = "identified"

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self.what)


@dataclass(frozen=True)
class Search(Groundwork[str]):
    kind: str = "identified"

    def done(self, source: Source, label: str) -> str:
        return "network"

    def plainer(self, found: str) -> str | None:
        return "linear" if found == "network" else None


def answer(sign: float, *regions: float) -> dict[str, Any]:
    """Certain in sign, or of another one in one-step predictions; with regions of such gains, where they turn."""
    found = {"model": 1.0, "low": 0.8, "high": 1.2, "first": 1, "last": 5, "direct": sign, "sd": 0.1, "follows": 0.0}
    found["verdict"] = "proven" if sign > 0 else "opposite"
    told = [{**found, "from": 0.0, "to": 1.0, "small": False, "model": gain} for gain in regions]
    return {**found, "regions": told, "turns": bool(told), **({"verdict": "turns"} if told else {})}


@dataclass(frozen=True, kw_only=True)
class Learns(Part):
    model: ClassVar[Any] = Saved
    proven: tuple[str, ...] = ()
    turns: bool = False
    asks: bool = False

    def groundwork(self) -> Search:
        return Search()

    def learn(self, source: Source) -> Learnt:
        what = source.result(self.groundwork())
        regions = (1.0, -1.0) if self.turns and what == "network" else ()
        proof = {"answers": {"y": {"u": answer(1.0 if what in self.proven else -1.0, *regions)}}}
        known = {"known": [{"question": "y/u: which is it?"}]} if self.asks else {}
        return Learnt(Saved(what), {"what": what, "proof": proof | known})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("proven", "of_case", "of_part", "taken"),
    [
        (("network", "linear"), {}, {}, "network"),
        (("linear",), {}, {}, "linear"),
        ((), {}, {}, "network"),  # neither: the better one stays, and the refusal is about it
        (("linear",), {}, {"asks": True}, "network"),  # no model answers what is asked
        (("linear",), {}, {"turns": True}, "network"),  # a straight model would hide the turn
        (("linear",), {"on_models": False}, {}, "network"),  # laws are tried on the plant itself
        (("linear",), {"stand_in": "simulator"}, {}, "network"),
    ],
)
def test_the_plainer_model_is_taken_where_the_record_proves_it_alone(
    proven: tuple[str, ...], of_case: dict[str, Any], of_part: dict[str, Any], taken: str, tmp_path: Path
) -> None:
    part = Learns(proven=proven, **of_part)
    plant = SimpleNamespace(signals=None)
    own = {"on_models": True, "stand_in": "identified", "plant": plant, "regions": {}, "known": (), "held": {}}
    case: Any = SimpleNamespace(**own | of_case)
    shared = {0: done([part.groundwork()], Source(None, None), "")}  # type: ignore[arg-type]
    results, figures = Fits({"identified": part}, {0: None}, case).proven_if_possible(shared, tmp_path, "fit")
    assert results[0, "identified"][1]["what"] == taken
    assert figures["identified"]["per_seed"]["0"]["what"] == taken
    assert (tmp_path / "seed0" / "identified.npz").read_text() == taken
    assert not (tmp_path / "plainer").exists()


def test_a_network_that_is_refused_leaves_the_choice_to_the_linear_model() -> None:
    trials: Any = [SimpleNamespace(against=frozenset(), error=error) for error in (1.0, 0.5)]
    found = Selection(*trials, [], 0.0, settles=True, drifts=False, innovations=50.0)
    search = StructureSearch("identified", False, None, True, (4,), None, None, 8000)
    plain = search.plainer(Searched(None, found, None, None))  # type: ignore[arg-type]
    assert plain is not None
    assert (found.chosen, plain.selection.chosen) == (trials[1], trials[0])
    assert search.plainer(plain) is None
