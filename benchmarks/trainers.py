"""The three trainers beside each other at equal wall time.

python benchmarks/trainers.py                  15 s a trainer, seed 0
python benchmarks/trainers.py --seconds 5 --seeds 3

(a) The thiosulfate CSTR's CA(k+3) from CA(k), T(k) and Tj held for 3 periods, at states that a
    feedback loop visits: RMSE of the best network by validation, on an experiment of another seed.
(b) z(t) = z(t-1) / (1 + z(t-1)^2) + u(t-1)^3 seen through noise [chen2004, eq. 15]:
    free-run RMSE over 20 steps without noise, after training on 1 and on 8 steps.
(c) The pH tank sampled every 15 s, 2,000 samples: RMSE of one step and of a free run over 30 steps,
    on an experiment of another seed.
Every trainer starts from the same weights and keeps the network that was best on validation data
within its seconds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import torch
from numpy.typing import NDArray

from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.models.training.fit import LBFGS, Adam, LevenbergMarquardt, Trainer
from loopwright.pipeline.models.training.objectives import FreeRunWindows, Objective, Samples

Array = NDArray[np.float64]
ROWS = 8_000


class OutOfTimeError(Exception):
    """Ends a fit whose seconds are used up."""


def trainers() -> dict[str, Trainer]:
    """All with early stopping off: the clock stops them. Adam's epochs are set by ``tuned_adam``."""
    endless = 1_000_000
    return {
        "lm": LevenbergMarquardt(iterations=endless, patience=endless, restarts=0),
        "lbfgs": LBFGS(iterations=endless, patience=endless, restarts=0),
        "adam": Adam(iterations=endless, patience=endless, restarts=0),
    }


def timed(
    trainer: Trainer, net: MLP, train: Objective, validation: Objective, seconds: float, seed: int
) -> tuple[int, float]:
    """Train for ``seconds``; leave ``net`` with its best parameters. Returns iterations and seconds used."""
    begun = time.perf_counter()
    best, kept, count = np.inf, net.state_dict(), 0

    def watch(iteration: int, _: float, error: float) -> None:
        nonlocal best, kept, count
        count = iteration + 1
        if error < best:
            best, kept = error, {k: v.clone() for k, v in net.state_dict().items()}
        if time.perf_counter() - begun > seconds:
            raise OutOfTimeError

    with suppress(OutOfTimeError):
        trainer.fit(net, train, validation, seed=seed, progress=watch)
    used = time.perf_counter() - begun
    net.load_state_dict(kept)
    return count, used


def tuned_adam(net: MLP, train: Objective, validation: Objective, seconds: float, seed: int) -> Adam:
    """Adam whose cosine ends with the seconds, its best case; an epoch's time is measured on three."""
    start = {k: v.clone() for k, v in net.state_dict().items()}
    begun = time.perf_counter()
    Adam(iterations=3, restarts=0).fit(net, train, validation, seed=seed)
    epochs = max(10, int(3 * seconds / (time.perf_counter() - begun)))
    net.load_state_dict(start)
    return Adam(iterations=epochs, patience=epochs, restarts=0)


def compare(
    title: str,
    make: Callable[[int], MLP],
    train: Objective,
    validation: Objective,
    score: Callable[[MLP], float],
    seconds: float,
    seeds: int,
) -> None:
    """Print one line per trainer: median over the seeds."""
    print(f"\n{title}; {len(train):,} rows, {seconds:g} s each, median of {seeds} seed(s)", flush=True)
    print(f"{'trainer':10}{'iterations':>12}{'RMSE':>12}{'worst':>12}")
    for name, plain in trainers().items():
        counts, scores = [], []
        for seed in range(seeds):
            net = make(seed)
            trainer = tuned_adam(net, train, validation, seconds, seed) if name == "adam" else plain
            count, _ = timed(trainer, net, train, validation, seconds, seed)
            counts.append(count)
            scores.append(score(net))
        print(f"{name:10}{np.median(counts):12.0f}{np.median(scores):12.2e}{np.max(scores):12.2e}", flush=True)


def cstr(seconds: float, seeds: int) -> None:
    from loopwright.pipeline.cases import PLANTS
    from loopwright.pipeline.excitation import EXCITATIONS
    from loopwright.pipeline.models.training.regressors import forward_pairs

    plant = PLANTS["thiosulfate_cstr"]()
    pairs = [
        forward_pairs(EXCITATIONS["operating_point"](samples=40_000, restarts=60_000).run(plant, seed), 3, 0)
        for seed in (0, 1)
    ]
    order = np.random.default_rng(0).permutation(len(pairs[0]))
    parts = [pairs[0].take(order[:ROWS]), pairs[0].take(order[ROWS : ROWS + 4_000])]
    train, validation = (Samples(p.x, p.y) for p in parts)

    def make(seed: int) -> MLP:
        net = MLP.scaled_to(train.x, train.y, hidden=(10, 10, 10), residual=(0,))
        net.reset(torch.Generator().manual_seed(seed))
        return net

    def score(net: MLP) -> float:
        with torch.no_grad():
            error = net(torch.from_numpy(pairs[1].x)).numpy() - pairs[1].y
        return float(np.sqrt(np.mean(error**2)))

    compare("(a) CA(k+3) of the thiosulfate CSTR [mol/l]", make, train, validation, score, seconds, seeds)


def eq_15(n: int, seed: int, steps: int, noise: float) -> FreeRunWindows:
    """Windows over one run; u uniform in [-1.2, 1.2]."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.2, 1.2, n)
    z = np.zeros(n)
    for t in range(1, n):
        z[t] = z[t - 1] / (1 + z[t - 1] ** 2) + u[t - 1] ** 3
    y = z + noise * rng.normal(size=n)
    k = np.arange(1, n - steps)
    index = k[:, None] + np.arange(steps)
    return FreeRunWindows(y[k - 1, None], u[index - 1][:, :, None], y[index])


def example(seconds: float, seeds: int) -> None:
    test = eq_15(1_000, 9, 20, 0.0)
    one = eq_15(2_000, 0, 1, 0.2)

    def make(seed: int) -> MLP:
        net = MLP.scaled_to(np.column_stack([one.past[:, 0], one.u[:, 0, 0]]), one.future, hidden=(10,))
        net.reset(torch.Generator().manual_seed(seed))
        return net

    for steps in (1, 8):
        train, validation = eq_15(2_000, 0, steps, 0.2), eq_15(1_000, 5, steps, 0.2)
        title = f"(b) eq. 15 with noise 0.2, trained on {steps} step(s); free run over 20 steps"
        compare(title, make, train, validation, lambda net: _free_run(net, test), seconds / 5, seeds)


def ph(seconds: float, seeds: int) -> None:
    from loopwright.pipeline.cases import PLANTS
    from loopwright.pipeline.excitation import EXCITATIONS
    from loopwright.pipeline.models.training.regressors import nnarx_pairs, split_in_time

    plant = PLANTS["ph_neutralization_15s"]()
    record, other = (EXCITATIONS["random_steps"](samples=2_000, hold=8).run(plant, seed) for seed in (0, 1))
    pairs = [nnarx_pairs(part, 2, 2) for part in split_in_time(record, 0.7)]
    train, validation = (Samples(p.x, p.y) for p in pairs)

    def make(seed: int) -> MLP:
        net = MLP.scaled_to(train.x, train.y, hidden=(10,), residual=(0,))
        net.reset(torch.Generator().manual_seed(seed))
        return net

    for steps in (1, 30):
        test = FreeRunWindows.of(other, 2, 2, steps)
        title = f"(c) pH of the tank, RMSE over {steps} step(s)"
        compare(title, make, train, validation, lambda net, test=test: _free_run(net, test), seconds / 5, seeds)


def _free_run(net: MLP, test: FreeRunWindows) -> float:
    with torch.no_grad():
        return float(torch.sqrt(test.loss(net)) * net.y_scale)


TASKS = 1.0 + 4 * 1 / 5
"""Of ``--seconds`` a trainer and seed: (a) takes them, (b) and (c) each two fifths."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(1)
    every = trainers()
    seconds = TASKS * options.seconds * options.seeds * len(every)
    print(f"trainers {', '.join(every)} on five tasks; about {seconds:.0f} s and the tasks' data", flush=True)
    cstr(options.seconds, options.seeds)
    example(options.seconds, options.seeds)
    ph(options.seconds, options.seeds)


if __name__ == "__main__":
    main()
