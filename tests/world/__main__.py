"""Walk the modes of a loop, or play random histories of it, until a rule is broken.

``python -m tests.world --depth 8`` walks every sequence of that many periods; ``--seed N --histories M`` plays random
ones, and tells one that breaks a rule as short as it gets; ``--planted`` says how soon they find planted bugs.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # what all tests share

from world.planted import PLANTED
from world.walk import starts, walked, wandered


def main(argv: list[str]) -> int:
    """Print what was walked; 1 where a rule was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.world", description=__doc__)
    parser.add_argument("--depth", type=int, default=0, help="periods of every sequence")
    parser.add_argument("--seed", type=int, default=0, help="of the random histories (0)")
    parser.add_argument("--histories", type=int, default=0, help="random ones, of twelve periods")
    parser.add_argument("--planted", action="store_true", help="find the bugs put in on purpose instead")
    options = parser.parse_args(argv)
    began = time.monotonic()
    if options.planted:
        for bug, plant in PLANTED.items():
            with plant():
                rule, path, ran = wandered(options.seed, options.histories or 100_000)
            took = time.monotonic() - began
            print(f"{bug}: {rule or 'NOT FOUND'} after {ran:,} periods, {took:.1f} s in all: {_told(path)}", flush=True)
        return 0
    broken = False
    if options.depth:

        def tell(depth: int, states: int, periods: int) -> None:
            took = time.monotonic() - began
            print(f"depth {depth}: {states:,} loops that differ, {periods:,} periods, {took:.0f} s", flush=True)

        walk = walked(options.depth, starts(), tell=tell)
        for rule, path in walk.broken.items():
            print(f"broken: {rule}: {_told(path)}")
        broken = bool(walk.broken)
    if options.histories:
        rule, path, ran = wandered(options.seed, options.histories)
        print(f"{ran:,} periods, {time.monotonic() - began:.0f} s: {rule or 'no rule is broken'}: {_told(path)}")
        broken = broken or bool(rule)
    return int(broken)


def _told(path: tuple[object, ...]) -> str:
    return " | ".join(map(str, path))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
