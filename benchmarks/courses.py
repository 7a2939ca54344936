"""Known future in the law ``predictive``: the same loops without it, with the last slope going on, and with a course.

``python benchmarks/courses.py [--seeds N]``. A recipe of ramps and steps for one loop with dead time, and steps of a
measured feed that two loops know before. Each loop runs on the model of its law and on plants that differ from it:
gains, time constants and dead times are drawn by the seed, and every seed has its own noise. A forecast is right, comes
late, or is too large. No number of a law is tuned here: all are the defaults. Errors are mean |r - y| in % of the set
points' range in the recipe, in % of the error without a course in the feed steps; travel in % of the MV's range.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.identified import Identified, remembering
from loopwright.pipeline.plants.simulator import Array, Signals
from loopwright.serving import Controller, Signal

NOISE = 0.01  # of the PVs, in their unit
ERROR = 0.3  # of gains and time constants: factors from 1/1.3 to 1.3
MOST_LATE = 2  # samples by which a plant answers later than the model
WARM_UP = 20  # samples that do not count


@dataclass(frozen=True, eq=False)
class LagPlant:
    """Two lags in a row for each output, behind dead times of the inputs [mv, dv].

    s+ = c s + (1 - c) K v(k - dead),   y+ = a y + (1 - a) s,   a = exp(-1/slow), c = exp(-1/quick)
    """

    gain: Array  # (n_y, n_v)
    slow: Array  # (n_y,) samples
    quick: Array  # (n_y,) samples
    dead: tuple[int, ...]  # (n_v,) samples
    n_mv: int

    def equations(self) -> Dynamics:
        """X = [y, s, past inputs]."""
        n_y, n_v = self.gain.shape
        a, c = np.diag(np.exp(-1 / self.slow)), np.diag(np.exp(-1 / self.quick))
        one, none = np.eye(n_y), np.zeros((n_y, n_y))
        whole = np.block([[a, one - a], [none, c]])
        into = np.vstack([np.zeros((n_y, n_v)), (one - c) @ self.gain])
        n_x = 2 * n_y
        bare = Dynamics(whole, into, np.zeros(n_x), np.zeros((0, n_x + n_v)), np.zeros(0), np.zeros((n_x, 0)))
        return remembering(bare, self.dead)

    def model(self) -> Identified:
        """As identification would have it, were it perfect."""
        n_y, n_v = self.gain.shape
        of, n_dv = self.equations(), n_v - self.n_mv
        rest = np.zeros((len(of.a), n_y + n_v + 1))
        rest[:n_y, :n_y] = rest[n_y : 2 * n_y, :n_y] = np.eye(n_y)
        rest[2 * n_y :, n_y : n_y + n_v] = np.repeat(np.eye(n_v), self.dead, axis=0)
        arrays = {name: getattr(of, name) for name in ("a", "b", "c", "w1", "b1", "w2")}
        zeros = {"y_center": n_y, "v_center": n_v, "colour": n_y, "gain_sd": self.n_mv, "pace_sd": 1, "dead_sd": 1}
        arrays |= {name: np.zeros(n) for name, n in (zeros | {"dv_noise": n_dv, "dv_change": n_dv}).items()}
        arrays |= {"y_scale": np.ones(n_y), "v_scale": np.ones(n_v), "noise": np.full(n_y, NOISE), "rest": rest}
        arrays |= {"rest_cov": np.zeros((len(of.a),) * 2), "dead": np.array(self.dead[: self.n_mv], dtype=float)}
        arrays["load_moves"] = np.zeros((0, n_y))
        sizes = {"n_y": n_y, "n_mv": self.n_mv, "n_dv": n_dv, "n_x": len(of.a), "n_hidden": 0, "recorded": 0}
        return Identified.from_arrays(sizes, arrays).eval()

    def signals(self) -> Signals:
        """Outputs within +-3, inputs within +-1."""
        n_y, n_v = self.gain.shape
        y = tuple(Signal(f"y{i}", "K", -3.0, 3.0) for i in range(n_y))
        mv = tuple(Signal(f"u{i}", "-", -1.0, 1.0) for i in range(self.n_mv))
        dv = tuple(Signal(f"d{i}", "-", -1.0, 1.0) for i in range(n_v - self.n_mv))
        return Signals(1.0, y, y, dv, mv)

    def other(self, seed: int) -> LagPlant:
        """A plant that differs from the model."""
        rng = np.random.default_rng(seed)

        def off(of: Array) -> Array:
            return np.asarray(of * (1 + ERROR) ** rng.uniform(-1, 1, of.shape))

        late = tuple(d + int(rng.integers(0, MOST_LATE + 1)) for d in self.dead)
        return replace(self, gain=off(self.gain), slow=off(self.slow), quick=off(self.quick), dead=late)


ONE = LagPlant(np.array([[2.0]]), np.array([10.0]), np.array([4.0]), (3,), 1)
TWO = LagPlant(np.array([[2.0, 0.8, 1.2], [-0.6, 1.8, 1.0]]), np.array([8.0, 12.0]), np.array([3.0, 4.0]), (2, 3, 1), 2)


def recipe() -> Array:
    """Set points (n, 1): ramps, holds and steps of a batch."""
    parts = [(0.0, 40), (1.2, -60), (1.2, 40), (0.4, 60), (-0.6, -50), (-0.6, 40), (0.8, 60)]  # below 0: a ramp
    course = [0.0]
    for value, n in parts:
        course += list(np.linspace(course[-1], value, -n + 1)[1:]) if n < 0 else [value] * n
    return np.array(course)[:, None]


def feed() -> Array:
    """A measured disturbance (n, 1): a step up and a larger one down."""
    return np.repeat([0.0, 0.5, -0.3], [50, 60, 60])[:, None]


def loop(
    law: Predictive, plant: LagPlant, sp: Array, dv: Array, seed: int, forecast: Array | None = None
) -> tuple[float, float]:
    """Mean error [unit of the PV] and travel [% of the MVs' range a sample] of a loop from rest.

    ``forecast`` (n, n_dv) is what the law is told of the disturbance; None: it is told nothing of the future.
    """
    of, n_y, n_mv, rng = plant.equations(), len(plant.gain), plant.n_mv, np.random.default_rng(seed)
    x, state, mv = np.zeros(len(of.a)), torch.zeros(law.n_state, dtype=torch.float64), torch.zeros(n_mv).double()
    errors, travel = [], []
    for k in range(len(sp)):
        errors.append(np.abs(sp[k] - x[:n_y]).mean())
        seen = torch.from_numpy(x[:n_y] + NOISE * rng.normal(size=n_y))
        more: list[torch.Tensor | None] = []
        if law.ahead is not None and forecast is not None:
            at = np.minimum(k + np.arange(1, law.ahead.horizon + 1), len(sp) - 1)
            change = np.hstack([sp[at] - sp[k], forecast[at] - forecast[k]])
            more = [None, None, torch.from_numpy(change.ravel())]
        before = mv
        with torch.no_grad():
            mv, state, _ = law(torch.from_numpy(sp[k]), seen, torch.from_numpy(dv[k]), mv, state, *more)
        travel.append(float((mv - before).abs().mean()))
        x = of.a @ x + of.b @ np.concatenate([mv.numpy(), dv[k]])
    return float(np.mean(errors[WARM_UP:])), 50 * float(np.mean(travel[WARM_UP:]))


def laws_of(plant: LagPlant, words: tuple[str, ...]) -> Mapping[str, Predictive]:
    """The law with each ``preview``."""
    model, signals = plant.model(), plant.signals()
    return {word: Predictive(signals, model, Predictive.Params(preview=word)).eval() for word in words}  # type: ignore[arg-type]


def recipes(seeds: int) -> None:
    """Errors of the recipe."""
    sp = recipe()
    span, none = np.ptp(sp), np.zeros((len(sp), 0))
    print(f"recipe of ramps and steps, {len(sp)} samples: error [% of the set points' range], travel [% a sample]")
    for where in ("the model", f"{seeds} other plants"):
        for word, law in laws_of(ONE, ("held", "ramp", "course")).items():
            plants = [ONE if where == "the model" else ONE.other(s) for s in range(seeds)]
            found = [loop(law, p, sp, none, s, none) for s, p in enumerate(plants)]
            error, travel = 100 * np.array([e for e, _ in found]) / span, [t for _, t in found]
            spread = f"({error.min():.2f} to {error.max():.2f})"
            print(f"  {where:<16} {word:<7} {error.mean():6.2f} {spread}  {np.mean(travel):5.2f}")


def feeds(seeds: int) -> None:
    """Errors under steps of a measured feed."""
    dv = feed()
    sp = np.zeros((len(dv), 2))
    late, large = np.vstack([dv[:1].repeat(5, axis=0), dv[:-5]]), 1.3 * dv
    early = np.vstack([dv[5:], dv[-1:].repeat(5, axis=0)])
    told = {"nothing": None, "right": dv, "5 samples early": early, "5 samples late": late, "30 % too large": large}
    print(f"steps of a measured feed, {len(dv)} samples: error [% of that without a forecast], travel [% a sample]")
    law = laws_of(TWO, ("course",))["course"]
    for where in ("the model", f"{seeds} other plants"):
        plants = [TWO if where == "the model" else TWO.other(s) for s in range(seeds)]
        first = np.array([loop(law, p, sp, dv, s)[0] for s, p in enumerate(plants)])
        for word, forecast in told.items():
            found = [loop(law, p, sp, dv, s, forecast) for s, p in enumerate(plants)]
            share = 100 * np.array([e for e, _ in found]) / first
            travel = np.mean([t for _, t in found])
            print(
                f"  {where:<16} {word:<16} {share.mean():6.1f} ({share.min():.1f} to {share.max():.1f})  {travel:5.2f}"
            )


def steps() -> None:
    """Times of a step of the exported file, with the input and without, in turns."""
    print("a step of the file, least median of 7 turns [us]: held, course without and with something to come, ratio")
    for name, plant in (("one loop", ONE), ("two loops and a feed", TWO)):
        with tempfile.TemporaryDirectory() as folder:
            files = {}
            for word, law in laws_of(plant, ("held", "course")).items():
                files[word] = Path(folder) / f"{word}.onnx"
                export(law, files[word], case="made", provenance={})
            held, course = (Controller(files[word]) for word in ("held", "course"))
        coming = 0.1 * np.ones(course.manifest.sizes()["ahead"])
        turns = np.array([[_median(held), _median(course), _median(course, coming)] for _ in range(7)])
        best = turns.min(axis=0)
        took = " ".join(f"{us:6.1f}" for us in best)
        print(f"  {name:<22} {took}  {best[1] / best[0]:.2f} {best[2] / best[0]:.2f}")


def _median(controller: Controller, coming: Array | None = None) -> float:
    """Median time [us] of 300 steps in a row from the middle of all ranges."""
    m, state, took = controller.manifest, controller.cold_state(), []
    given = {n: np.array(m.usual(n)) for n in ("sp", "pv", "dv", "mv_applied")}
    more = {} if coming is None else {"ahead": coming}
    for _ in range(300):
        before = time.perf_counter()
        state = controller.step(**given, **more, state=state).state
        took.append(1e6 * (time.perf_counter() - before))
    return float(np.median(took))


def main() -> None:
    """All of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="plants and noises (%(default)s)")
    seeds = parser.parse_args().seeds
    torch.set_num_threads(1)
    recipes(seeds)
    feeds(seeds)
    steps()


if __name__ == "__main__":
    main()
