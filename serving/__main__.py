"""``python -m serving``: inspect and bench a controller file; make keys, sign it, verify it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from serving.bench import bench, table
from serving.card import card, card_json
from serving.errors import LoopwrightError
from serving.signing import command as signing
from serving.trust import Controller


def inspect_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``inspect``."""
    parser.add_argument("file", metavar="FILE", help="a controller's .onnx file")
    parser.add_argument("--json", action="store_true", help="as JSON, for programs")
    parser.add_argument("--sha256", metavar="HEX", help="refuse any file but this one")
    parser.add_argument("--key", metavar="PUBLIC", nargs="+", help="refuse a file that none of these keys signed")


def run_inspect(options: argparse.Namespace) -> None:
    """Print the controller's card."""
    controller = Controller(options.file, sha256=options.sha256, trusted=options.key)
    print(card_json(controller) if options.json else card(controller))


def bench_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``bench``."""
    parser.add_argument("file", metavar="FILE", help="a controller's .onnx file")
    parser.add_argument("--steps", type=_positive, default=20_000, metavar="N", help="hot steps (20000)")
    parser.add_argument("--loop-steps", type=_positive, default=1_000, metavar="N", help="steps in the loop (1000)")
    parser.add_argument("--period-ms", type=_positive, default=10, metavar="MS", help="period of the loop (10)")


def run_bench(options: argparse.Namespace) -> None:
    """Print how long a step takes."""
    period_s = options.period_ms / 1e3
    timings = bench(Controller(options.file), steps=options.steps, loop_steps=options.loop_steps, period_s=period_s)
    print(table(timings))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; 0 if it went well, 2 after one line on standard error."""
    parser = argparse.ArgumentParser(prog="python -m serving", description="Look at a controller file.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    inspect_options(commands.add_parser("inspect", help="what the controller is, and how its validation went"))
    bench_options(commands.add_parser("bench", help="how long a step takes on this machine"))
    signing.keygen_options(commands.add_parser("keygen", help="make a key to sign controller files with"))
    signing.sign_options(commands.add_parser("sign", help="sign a controller file and its manifest"))
    signing.verify_options(commands.add_parser("verify", help="which of some keys signed a controller file"))
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    try:
        _COMMANDS[options.command](options)
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


_COMMANDS = {
    "inspect": run_inspect,
    "bench": run_bench,
    "keygen": signing.run_keygen,
    "sign": signing.run_sign,
    "verify": signing.run_verify,
}


if __name__ == "__main__":
    sys.exit(main())
