"""Why a predictive law moves: first causes of made-up situations, sums of parts, what-if beside what happens, cost.

``python benchmarks/explain.py [--seeds 11 12] [--files FOLDER]``. Plants are random stable models on which the loop
comes to rest within its limits; others are left out and told. Each is the law's own model, so that nothing here says
how well a model predicts a plant. With ``--files`` laws are exported: their what-if is then compared with the loop
itself, and their steps are timed.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from _situations import SITUATIONS, MadeLoop, law_over, made_model

from loopwright.pipeline.export.explain_graph import export_explanation
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.serving.explain import Explainer

PLANTS = {"2x2": (2, 2, 0), "2x2 network": (2, 2, 5), "1x2": (1, 2, 0), "3x3": (3, 3, 0)}  # n_y, n_mv, units
CHANGES = (
    {"y0": 0.2},
    {"y0": -0.3, "y1": 0.1},
    {"y0.track": 0, "y0.high": -0.1},
    {"u0.use": 0, "y0": 0.15},
    {"u0.high": -0.1},
    {"u0.max_move": 0.03, "y1": 0.3},
    {"speed": 2.0, "y1": -0.2},
    {"y0.track": 0, "u0.cost": 1.0},
)  # set points and ends of ranges count from where these stand
RELATIVE = ("high", "low", "rest")
STEPS = 300  # that are timed


def situations(seeds: list[int]) -> None:
    """Print which first causes are right."""
    right, tried, wrong, left_out = Counter[str](), Counter[str](), [], []
    for seed in seeds:
        for plant, (n_y, n_mv, units) in PLANTS.items():
            model = made_model(seed, n_y, n_mv, units)
            law = law_over(model)
            if not MadeLoop(model, law).rests:
                left_out.append(f"{plant} seed {seed}")
                continue
            tried[plant] += len(SITUATIONS)
            for situation in SITUATIONS:
                good, asked = situation.right(MadeLoop(model, law))
                right[plant] += good
                if not good:
                    parts = ", ".join(f"{p.cause} {p.signal} {p.value:.3f}" for p in asked.parts[:3])
                    wrong.append(
                        f"  wrong, {plant} seed {seed}: {situation.words}; {asked.mv} {asked.move:.3f}: {parts}"
                    )
    each = ", ".join(f"{plant} {right[plant]}/{tried[plant]}" for plant in PLANTS)
    print(f"first cause right: {right.total()} of {tried.total()}; {each}")
    print(f"left out, not at rest: {', '.join(left_out) or 'none'}")
    print("\n".join(wrong))


def sums(seeds: list[int]) -> None:
    """Print the largest gap between a move and the sum of its parts, and how large the parts are."""
    gap = most = 0.0
    for seed in seeds:
        for n_y, n_mv, units in PLANTS.values():
            model = made_model(seed, n_y, n_mv, units)
            loop, rng = MadeLoop(model, law_over(model)), np.random.default_rng(seed)
            for _ in range(40):
                for i, entry in enumerate(loop.law.operate):
                    if entry.what not in ("low", "high") and rng.uniform() < 0.1:
                        loop.operate[i] = round(rng.uniform(entry.low, entry.high), 0 if entry.high <= 1 else 3)
                loop.sp += torch.from_numpy(0.2 * rng.normal(size=n_y))
                loop.sp.clamp_(-3, 3)
                loop.dv += 0.1 * rng.normal()
                for move in loop.moves():
                    gap = max(gap, abs(sum(p.value for p in move.parts) - move.move) / 2)
                    most = max(most, abs(move.parts[0].value) / 2)
                loop.step()
    print(f"largest gap between a move and its parts' sum: {gap:.1e} of the MV's range; largest part {most:.2f} of it")


def files(seed: int, folder: Path) -> None:
    """Export two laws; print their what-if beside the loop, and the time of a step."""
    for plant in ("2x2", "2x2 network"):
        n_y, n_mv, units = PLANTS[plant]
        model = made_model(seed, n_y, n_mv, units)
        law, file = law_over(model), folder / f"{plant.replace(' ', '_')}.onnx"
        export(law, file, case="made", provenance={})
        path = export_explanation(law, file)
        assert path is not None
        explainer = Explainer(path)
        what_if(plant, explainer, model, law)
        given = {name: v.numpy() for name, v in _given(MadeLoop(model, law)).items()}
        took = []
        for step in (explainer.controller.step, explainer.explain):
            each = []
            for _ in range(STEPS):
                started = time.perf_counter()
                step(**given)
                each.append(time.perf_counter() - started)
            took.append(1e6 * min(each))
        nodes = [explainer.controller.summary.nodes, explainer.summary.nodes]
        print(
            f"{plant}: a step {took[0]:.0f} us ({nodes[0]} operators), with its explanation {took[1]:.0f} us "
            f"({nodes[1]} operators in the second graph); the least of {STEPS}"
        )


def what_if(plant: str, explainer: Explainer, model: Identified, law: Predictive) -> None:
    """Print by how much what-if is off what then happens, in % of what changes; at rest and in a transient."""
    for moved in (False, True):
        worst, plans = [], []
        for change in CHANGES:
            loop = MadeLoop(model, law)
            if moved:
                loop.load[0] = 0.05
                loop.dv += 0.2
                loop.step(6)
            changes = {name: _absolute(loop, name, value) for name, value in change.items()}
            given = {name: v.numpy() for name, v in _given(loop).items()}
            found = explainer.what_if(changes, **given).after
            known = dict(
                zip(("sp", "operate"), explainer.changed_inputs(changes, given["sp"], given["operate"]), strict=True)
            )
            plan = explainer.explain(**{**given, **known})
            loop.sp, loop.operate = (torch.from_numpy(known[name]).clone() for name in ("sp", "operate"))
            ys, mvs = [], []
            first_y, first_mv = loop.pv.numpy().copy(), loop.mv.numpy().copy()
            for _ in range(law.moves.horizon):
                loop.step()
                ys.append(loop.pv.numpy().copy())
                mvs.append(loop.mv.numpy().copy())
            happened = [*zip(np.array(ys).T, first_y, strict=True), *zip(np.array(mvs).T, first_mv, strict=True)]
            span = max(np.abs(of - begin).max() for of, begin in happened)
            off = max(np.abs(np.array(c.values) - of).max() for c, (of, _) in zip(found.courses, happened, strict=True))
            worst.append(100 * off / span)
            ahead = plan.courses[: model.n_y]
            off = max(np.abs(np.array(c.values) - of).max() for c, (of, _) in zip(ahead, happened, strict=False))
            plans.append(100 * off / span)
        where = "six samples after a load and a disturbance" if moved else "from rest"
        print(
            f"{plant}: what-if {where} is off by {max(worst):.2g} % of what changes, at most, the single plan by "
            f"{max(plans):.0f} % ({len(CHANGES)} changes)"
        )


def _absolute(loop: MadeLoop, name: str, value: float) -> float:
    """A change as the explainer takes it: set points, ends and rests count from where the signal stands."""
    signal, _, what = name.partition(".")
    if not signal.startswith(("y", "u")) or (what and what not in RELATIVE):
        return value
    at = (loop.sp if not what else loop.pv if signal[0] == "y" else loop.mv)[int(signal[1:])]
    return float(at) + value


def _given(loop: MadeLoop) -> dict[str, torch.Tensor]:
    names = ("sp", "pv", "dv", "mv_applied", "state", "operate", "fresh")
    return dict(zip(names, loop.inputs(), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11])
    parser.add_argument("--files", type=Path, help="folder for the exported laws")
    options = parser.parse_args()
    torch.set_num_threads(1)
    situations(options.seeds)
    sums(options.seeds)
    if options.files is not None:
        files(options.seeds[0], options.files)


if __name__ == "__main__":
    main()
