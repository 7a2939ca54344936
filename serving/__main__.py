"""``python -m serving inspect FILE`` and ``python -m serving bench FILE``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from serving.bench import bench, table
from serving.card import card, card_json
from serving.controller import Controller
from serving.errors import LoopwrightError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; 0 if it went well, 2 after one line on standard error."""
    parser = argparse.ArgumentParser(prog="python -m serving", description="Look at a controller file.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    inspect = commands.add_parser("inspect", help="what the controller is, and how its validation went")
    inspect.add_argument("file", metavar="FILE", help="a controller's .onnx file")
    inspect.add_argument("--json", action="store_true", help="as JSON, for programs")
    inspect.add_argument("--sha256", metavar="HEX", help="refuse any file but this one")
    timing = commands.add_parser("bench", help="how long a step takes on this machine")
    timing.add_argument("file", metavar="FILE", help="a controller's .onnx file")
    timing.add_argument("--steps", type=_positive, default=5_000, metavar="N", help="hot steps (5000)")
    timing.add_argument("--loop-steps", type=_positive, default=500, metavar="N", help="steps in the loop (500)")
    timing.add_argument("--period-ms", type=_positive, default=10, metavar="MS", help="period of the loop (10)")
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    try:
        if options.command == "inspect":
            controller = Controller(options.file, sha256=options.sha256)
            print(card_json(controller) if options.json else card(controller))
        else:
            timings = bench(
                Controller(options.file),
                steps=options.steps,
                loop_steps=options.loop_steps,
                period_s=options.period_ms / 1e3,
            )
            print(table(timings))
    except LoopwrightError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # `| head`: the reader has seen enough
        sys.stderr.close()
    return 0


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number above zero")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
