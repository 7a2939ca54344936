"""The partition sweep against a straightforward one, and one network against a scikit-learn pipeline.

python benchmarks/rbf_sweep.py                 c = 4..100 on 42,000 samples
python benchmarks/rbf_sweep.py --every 12      fewer partitions, for a quick look

It prints a line a turn and a line a network, and takes about ``--seconds``: turns that the time does
not suffice for are left out, and so are the last networks.

Each sweep runs in a process of its own, so that the thread pools of numpy and torch do not meet,
and the two take turns, so that both see the same load of the machine. Ends with status 1 where the
sweep needs more than a third of the straightforward time or does not come to the same result.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stderr
from io import StringIO
from multiprocessing import get_context
from typing import Any

import _straightforward as straightforward
import numpy as np

LIMITS = (0.0, 500.0)
SHARE, NEAR, AGREE = 1 / 3, 2, 0.01
TURNS = 8
SWEEPS = 0.7  # of the time, for the two sweeps


def data(seed: int) -> tuple[Any, ...]:
    """X and y for training, then for validation: the paper's 60,000 random steps, 70 % of them for training."""
    from loopwright.pipeline.cases import PLANTS
    from loopwright.pipeline.excitation import EXCITATIONS
    from loopwright.pipeline.models.training.regressors import inverse_pairs

    plant = PLANTS["thiosulfate_cstr"]()
    record = EXCITATIONS["random_steps"](samples=60_000).run(plant, seed)
    train, validation = inverse_pairs(record).split(0.7, "random", seed)
    return train.x, train.y[:, 0], validation.x, validation.y[:, 0]


def ours(x: Any, y: Any, x_val: Any, y_val: Any, counts: list[int]) -> Any:
    """The same rows and seconds from Loopwright."""
    from loopwright.pipeline.models.static.sweep import sweep

    begun = time.perf_counter()
    with redirect_stderr(StringIO()):  # its closing line, once a turn
        result = sweep(x, y, x_val, y_val, partitions=counts, limits=LIMITS)
    seconds = time.perf_counter() - begun
    return [(r.partitions, r.centres, r.train.rmse, r.validation.rmse) for r in result.rows], seconds


def one_network(x: Any, y: Any, x_val: Any, y_val: Any, c: int, seconds: float) -> None:
    """Print centres, seconds of the fit and RMSE of ours and of what one writes with scikit-learn alone.

    No further network is begun after ``seconds``.
    """
    from sklearn.cluster import KMeans
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import FunctionTransformer, MinMaxScaler

    from loopwright.pipeline.models.static.fuzzy_means import FuzzyMeansRBF

    mine, end = FuzzyMeansRBF(c), time.monotonic() + seconds

    def measure(name: str, model: Any) -> None:
        begun = time.perf_counter()
        model.fit(x, y)
        spent = time.perf_counter() - begun
        error = float(np.sqrt(np.mean((model.predict(x_val).clip(*LIMITS) - y_val) ** 2)))
        print(f"{name:<34}{len(mine.centres_):>8}{spent:>9.2f}{error:>21.3f}", flush=True)

    measure("fuzzy means, thin plate, QR", mine)
    clusters = len(mine.centres_)
    # KMeans transforms to distances, so a radial basis is one function behind it.
    for name, basis, alpha in (
        ("KMeans, thin plate, Ridge(1e-6)", thin_plate, 1e-6),
        ("KMeans, Gaussian, Ridge(1e-6)", gaussian, 1e-6),
        ("KMeans, Gaussian, Ridge()", gaussian, 1.0),
    ):
        if time.monotonic() > end:
            print(f"{name:<34}left out: no time left", flush=True)
            continue
        means = KMeans(clusters, n_init=1, random_state=0)
        measure(name, make_pipeline(MinMaxScaler((-1, 1)), means, FunctionTransformer(basis), Ridge(alpha)))


def thin_plate(d: Any) -> Any:
    return d**2 * np.log(np.maximum(d, 1e-15))


def gaussian(d: Any) -> Any:
    return np.exp(-0.5 * (d / 0.2) ** 2)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--every", type=int, default=1, help="take every n-th number of partitions")
    parser.add_argument("--seconds", type=float, default=150.0, help="about what all of it may take (150)")
    parser.add_argument("--seed", type=int, default=0, help="of the excitation and the split")
    options = parser.parse_args()
    counts = list(range(4, 101, options.every))
    started = time.monotonic()
    print(f"two sweeps over {len(counts)} partitions and four networks; about {options.seconds:.0f} s", flush=True)
    samples = data(options.seed)
    print(f"{len(samples[0]):,} samples, {len(samples[2]):,} for validation", flush=True)
    spawn = get_context("spawn")
    found: dict[str, list[Any]] = {"ours": [], "straightforward": []}
    seconds = dict.fromkeys(found, 0.0)
    with ProcessPoolExecutor(1, spawn) as fast, ProcessPoolExecutor(1, spawn) as plain:
        # Starting the process and importing torch is nobody's sweep.
        fast.submit(ours, *samples, [4]).result()
        plain.submit(straightforward.sweep, *samples, [4], LIMITS).result()
        turns = min(TURNS, len(counts))
        for turn in range(turns):
            part = counts[turn::TURNS]
            # Submitted one after the other: each has the machine to itself.
            rows, spent = fast.submit(ours, *samples, part).result()
            found["ours"] += rows
            seconds["ours"] += spent
            rows, spent = plain.submit(straightforward.sweep, *samples, part, LIMITS).result()
            found["straightforward"] += rows
            seconds["straightforward"] += spent
            spent_so_far = ", ".join(f"{name} {total:.1f} s" for name, total in seconds.items())
            print(f"turn {turn + 1} of {turns}: {spent_so_far}", flush=True)
            if time.monotonic() - started > SWEEPS * options.seconds and turn + 1 < turns:
                print(f"the other turns are left out: {len(found['ours'])} partitions were swept", flush=True)
                break
    best = {name: min(rows, key=lambda row: row[3]) for name, rows in found.items()}
    print(f"\n{'sweep':<18}{'seconds':>9}{'best c':>8}{'centres':>9}{'RMSE train [K]':>16}{'validation [K]':>16}")
    for name, (c, n, train, validation) in best.items():
        print(f"{name:<18}{seconds[name]:>9.1f}{c:>8}{n:>9}{train:>16.3f}{validation:>16.3f}")
    pairs = list(zip(sorted(found["ours"]), sorted(found["straightforward"]), strict=True))
    worst = max(abs(a[3] / b[3] - 1) for a, b in pairs)
    share = seconds["ours"] / seconds["straightforward"]
    mine, theirs = best["ours"], best["straightforward"]
    apart, gap = abs(mine[0] - theirs[0]), abs(mine[3] / theirs[3] - 1)
    checks = {
        f"share of the straightforward time {share:.3f} (allowed {SHARE:.3f})": share <= SHARE,
        f"best c differs by {apart} (allowed {NEAR})": apart <= NEAR,
        f"RMSE differs by {gap:.1e} at the best c, {worst:.1e} at most (allowed {AGREE})": gap <= AGREE,
    }
    print()
    for text, passed in checks.items():
        print(f"{'ok  ' if passed else 'FAIL'} {text}")
    print(f"\n{'one network':<34}{'centres':>8}{'fit [s]':>9}{'validation RMSE [K]':>21}", flush=True)
    with ProcessPoolExecutor(1, spawn) as peers:
        left = options.seconds - (time.monotonic() - started)
        peers.submit(one_network, *samples, mine[0], left).result()
    return 0 if all(checks.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
