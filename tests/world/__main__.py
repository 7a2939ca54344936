"""Walk the modes of a loop, or play random histories of loops and stations, until a rule is broken.

``python -m tests.world --depth 8`` walks every sequence of that many periods; ``--seed N --histories M`` plays random
ones of a loop, and tells one that breaks a rule as short as it gets. ``--years Y --seed N`` plays stations with their
connections, journals and leases over so many years of virtual time, each history by its own seed from N on: the seed
plays it again. ``--planted`` says how soon planted bugs are found.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # what all tests share

from world.planted import PLANTED
from world.planted_stations import PLANTED_STATIONS
from world.story import drawn, found_in, played_from, rules, shortened
from world.walk import starts, walked, wandered

YEAR_S = 365.25 * 86_400.0
MOST_TRIED = 200  # histories in which a planted bug of a station is sought
EACH = 25  # histories from one line of progress to the next


def main(argv: list[str]) -> int:
    """Print what was walked; 1 where a rule was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.world", description=__doc__)
    parser.add_argument("--depth", type=int, default=0, help="periods of every sequence")
    parser.add_argument("--seed", type=int, default=0, help="of the random histories (0)")
    parser.add_argument("--histories", type=int, default=0, help="random ones, of twelve periods")
    parser.add_argument("--years", type=float, default=0.0, help="of virtual time of stations")
    parser.add_argument("--workers", type=int, default=1, help="processes that play them (1)")
    parser.add_argument("--planted", action="store_true", help="find the bugs put in on purpose instead")
    options = parser.parse_args(argv)
    began = time.monotonic()
    if options.planted:
        for bug, plant in PLANTED.items():
            with plant():
                rule, path, ran = wandered(options.seed, options.histories or 100_000)
            took = time.monotonic() - began
            print(f"{bug}: {rule or 'NOT FOUND'} after {ran:,} periods, {took:.1f} s in all: {_told(path)}", flush=True)
        for bug, plant in PLANTED_STATIONS.items():
            since = time.monotonic()
            with plant():
                seed, told = found_in(options.seed, options.histories or MOST_TRIED)
            rule = rules(told.broken)[0] if told.broken else "NOT FOUND"
            print(f"{bug}: {rule}, history {seed}, {time.monotonic() - since:.0f} s", flush=True)
        return 0
    broken = _years(options.years, options.seed, options.workers) if options.years else False
    if options.depth:

        def tell(depth: int, states: int, periods: int) -> None:
            took = time.monotonic() - began
            print(f"depth {depth}: {states:,} loops that differ, {periods:,} periods, {took:.0f} s", flush=True)

        walk = walked(options.depth, starts(), tell=tell)
        for rule, path in walk.broken.items():
            print(f"broken: {rule}: {_told(path)}")
        broken = broken or bool(walk.broken)
    if options.histories:
        rule, path, ran = wandered(options.seed, options.histories)
        print(f"{ran:,} periods, {time.monotonic() - began:.0f} s: {rule or 'no rule is broken'}: {_told(path)}")
        broken = broken or bool(rule)
    return int(broken)


def _years(years: float, seed: int, workers: int) -> bool:
    """Play histories of stations, and say of each that breaks a rule what happened in it at least."""
    began, first, virtual_s, scans, faults, broken = time.monotonic(), seed, 0.0, 0, 0, False
    # A process is renewed now and then: a loop that is killed leaves a thread that waits for ever.
    with ProcessPoolExecutor(workers, get_context("spawn"), max_tasks_per_child=EACH) as pool:
        while virtual_s < years * YEAR_S:
            for told in pool.map(played_from, range(seed, seed + EACH)):
                virtual_s, scans, faults = virtual_s + told.virtual_s, scans + told.scans, faults + told.faults
                if told.broken:
                    broken, rule = True, rules(told.broken)[0]
                    setting, happenings = drawn(seed)
                    print(f"history {seed} broke: {'; '.join(told.broken)}\n  {setting}")
                    print(*(f"  {h}" for h in shortened(setting, happenings, rule)), sep="\n", flush=True)
                seed += 1
            took = time.monotonic() - began
            print(
                f"{seed - first} histories, {virtual_s / YEAR_S:.3f} years, {scans:,} scans ({faults:,} with a fault), "
                f"{took:.0f} s", flush=True,
            )  # fmt: skip
    return broken


def _told(path: tuple[object, ...]) -> str:
    return " | ".join(map(str, path))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
