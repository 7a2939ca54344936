"""A row for a plant in a closed-loop record: what the product makes of the file, beside what others do.

The record, the wandering loads of the tests and the set points are of different seeds. MAE of the true output in % of
the set points' range, in brackets the MV's travel in % of its range a minute.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import statistics
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any

import closed_plant
import closed_product
import closed_record
import loops
import plant as plant_module
import torch
from _project import withheld
from closed_development import CLOSED_DEVELOPMENT
from closed_plant import ClosedPlant, closed_tests_of
from closed_product import Delivered, by_fit, by_run, columns_of
from closed_record import OldLaw, closed_record_of, write_export
from closed_untouched import CLOSED_UNTOUCHED
from loops import Steps, closed, scores
from store import FOLDER, bound_of
from torch import Tensor

from loopwright.pipeline.files import write_json
from loopwright.pipeline.laws.base import ControlLaw

PLANTS: Mapping[str, type[ClosedPlant]] = {p.name: p for p in (*CLOSED_DEVELOPMENT, *CLOSED_UNTOUCHED)}
TESTS = ("set points", "loads", "day")
FIRST = "first set points"  # one sequence of three: a load that wanders makes the NMPC solve at each sample
ROOT = Path(__file__).parents[2]
OWN_CODE = (plant_module, loops, closed_plant, closed_record)
PID_CODE = ("pipeline/laws/pid", "pipeline/tuning", "pipeline/plants")

LINE = 160  # letters of what was said that are shown

Scores = dict[str, dict[str, list[float]]]
"""Controller -> test -> [MAE, travel]."""


def digest_of(parts: Iterable[str]) -> str:
    """Of texts and of the sources in folders of the repository, which begin with a folder's name."""
    found = hashlib.sha256()
    for part in parts:
        folder = ROOT / part if len(part) < 100 and "\n" not in part else None
        if folder is not None and folder.is_dir():
            for file in sorted(folder.rglob("*.py")):
                found.update(file.read_bytes())
        else:
            found.update(part.encode())
    return found.hexdigest()[:12]


@cache
def yardstick_of(plant: ClosedPlant) -> str:
    """Digest of a plant and of how its record and tests are made."""
    return digest_of([inspect.getsource(type(plant)), *(inspect.getsource(m) for m in OWN_CODE)])


@cache
def product_digest() -> str:
    """Digest of the product, and of how it is called here."""
    return digest_of(["pipeline", "serving", inspect.getsource(closed_product)])


def kept(name: str, make: Callable[[], Any]) -> Any:
    """What the store has under a name, or what is made now."""
    path = FOLDER / f"{name}.json"
    if not path.exists():
        write_json(path, make())
    return json.loads(path.read_text())


def scored(law: Steps, plant: ClosedPlant) -> dict[str, list[float]]:
    """Of one law, by test."""
    found = {}
    for name, tests in closed_tests_of(plant).items():
        y, u = closed(law, plant, tests)
        score = scores(plant, tests, y[0], u[0])
        found[name] = [score.nmae, score.travel * 60 / plant.period_s]
        if name == TESTS[0]:
            found[FIRST] = [scores(plant, tests[:1], y[0, :1], u[0, :1]).nmae]
    return found


class Within:
    """A law whose output keeps within the ends that the old loops' have."""

    def __init__(self, law: Steps, plant: ClosedPlant) -> None:
        self.law, self.n_state = law, law.n_state
        self.low, self.high = (torch.tensor([getattr(o, end) for o in plant.loops]) for end in ("low", "high"))

    def __call__(self, sp: Tensor, pv: Tensor, dv: Tensor, mv: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as of any law."""
        moved, after, info = self.law(sp, pv, dv, mv, state)
        return torch.minimum(torch.maximum(moved, self.low), self.high), after, info


def others_of(plant: ClosedPlant, pid_of: Callable[[ClosedPlant], ControlLaw | None]) -> Scores:
    """The old loop, the PID tuned on the true plant, and on set points the NMPC that knows it."""
    key = f"{plant.name}-closed-{yardstick_of(plant)}"
    found: Scores = {"old loop": kept(f"{key}-old", lambda: scored(OldLaw(plant.loops, plant.period_s), plant))}

    def tuned() -> dict[str, list[float]]:
        # A search in closed loop over a valve that sticks ends in chatter: the better one stands for an engineer's.
        pids = [pid for p in dict.fromkeys([plant, plant.bounding]) if (pid := pid_of(p)) is not None]
        found = [scored(Within(pid, plant), plant) for pid in pids]
        return min(found, key=lambda score: score[TESTS[0]][0], default={})

    if by_pid := kept(f"{key}-pid-{digest_of([*PID_CODE, inspect.getsource(others_of)])}", tuned):
        found["tuned PID"] = by_pid
    return found | {"NMPC": {FIRST: [bound_of(plant.bounding, 1)]}}


def ours_of(plant: ClosedPlant, rows: int, *, fit: bool, seed: int = 0) -> dict[str, Any]:
    """What the product makes of the record: ``scores`` by controller, what it ``said``, and ``seconds``."""
    code = product_digest()
    way = "fit" if fit else "run"
    key = f"{plant.name}-closed-{yardstick_of(plant)}-{rows}-{seed}-{way}-{code}"

    def make() -> dict[str, Any]:
        file = FOLDER / f"{key}-export" / f"{plant.name}.csv"
        write_export(plant, closed_record_of(plant, rows, seed), file)
        project = FOLDER / f"{key}-project"
        done: Delivered = by_fit(plant, file) if fit else by_run(plant, file, project, columns_of(plant))
        why = [] if fit else withheld(project, plant.name)
        of = {name: scored(law, plant) for name, law in done.laws.items()}
        where = "" if fit else str(project)
        return {"scores": of, "said": done.said, "withheld": why, "seconds": done.seconds, "project": where}

    found: dict[str, Any] = kept(key, make)
    return found


def text_of(plant: ClosedPlant, rows: int, way: str, others: Scores, ours: Mapping[str, Any]) -> str:
    """The rows of one plant."""
    head = f"{plant.name}, {plant.title}, {rows} rows, by {way}: {ours['seconds']:.0f} s of processor time"
    lines = [head, f"  {'':22}" + "".join(f"{test:>20}" for test in (*TESTS, FIRST)) + f"{'over NMPC':>12}"]
    bound = others["NMPC"][FIRST][0]
    for name, score in (others | {f"ours: {n}": s for n, s in ours["scores"].items()}).items():
        cells = [f"{_cell(score.get(test)):>20}" for test in (*TESTS, FIRST)]
        lines.append(f"  {name:22}" + "".join(cells) + f"{score[FIRST][0] / bound:12.2f}")
    if not ours["scores"]:
        lines.append("  ours: nothing is shipped")
    said = [f"withheld: {line}" for line in ours["withheld"]]
    if not said and (way == "fit" or not ours["scores"]):
        said = ours["said"][-4:]
    lines += [f"  {line[:LINE]}" for line in [*said, ours["project"]] if line]
    return "\n".join(lines)


def _cell(score: list[float] | None) -> str:
    return "-" if score is None else f"{score[0]:.2f}" + (f" ({score[1]:.2f})" if score[1:] else "")


def best_of(scores_by_law: Scores) -> dict[str, list[float]] | None:
    """Of the shipped ones the predictive law, else the PID; None where nothing is shipped."""
    return scores_by_law.get("predictive") or next(iter(scores_by_law.values()), None)


def summary(rows: list[tuple[Scores, Scores]]) -> str:
    """Over plants (others, ours): how many have a controller, are ahead of others, and how far the NMPC is."""
    pairs = [(others, best) for others, ours in rows if (best := best_of(ours)) is not None]
    lines = [f"a controller for {len(pairs)} of {len(rows)}"]
    for other, tests in (("old loop", TESTS), ("tuned PID", TESTS)):
        have = [(others[other], best) for others, best in pairs if other in others]
        ahead = [f"{test} {sum(b[test][0] < o[test][0] for o, b in have)} of {len(rows)}" for test in tests]
        lines.append(f"ahead of the {other}: {', '.join(ahead)}")
    bounds = [(others["NMPC"][FIRST][0], best[FIRST][0]) for others, best in pairs]
    ratios = [error / bound for bound, error in bounds if isfinite(bound)]
    if ratios:
        lines.append(
            f"over the NMPC on set points: {statistics.median(ratios):.2f} in the median, {max(ratios):.2f} at worst"
        )
    return "\n".join(lines)


def closed_main(
    names: Iterable[str], rows: int, *, fit: bool, seed: int, pid_of: Callable[[ClosedPlant], ControlLaw | None]
) -> int:
    """Print the rows of plants as they come, and their summary."""
    found = []
    for name in names:
        plant = PLANTS[name]()
        ours = ours_of(plant, rows, fit=fit, seed=seed)
        others = others_of(plant, pid_of)
        print(text_of(plant, rows, "fit" if fit else "new and run", others, ours), flush=True)
        found.append((others, ours["scores"]))
    if len(found) > 1:
        print(summary(found))
    return 0
