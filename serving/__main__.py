"""``python -m loopwright.serving``: inspect, bench, sign and verify a controller file, or write test vectors of it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from loopwright.serving.arguments import Parser, write_any_text
from loopwright.serving.card import bench, card, card_json, table
from loopwright.serving.conformance.kit import VECTORS, check, write_kit
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.signing import command as signing
from loopwright.serving.trust import Controller
from loopwright.serving.words import plain


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


def conformance_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``conformance``."""
    parser.add_argument("file", metavar="FILE", help="a controller's .onnx file")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the kit: the file, its manifest, vectors.json")
    parser.add_argument(
        "--check", type=Path, metavar="ANSWERS", help="compare a host's answers with the kit in OUT; write nothing"
    )


def run_conformance(options: argparse.Namespace) -> int:
    """Write the kit, or check answers: 0 if the host passed, 1 if not."""
    controller = Controller(options.file)
    if options.check is not None:
        verdict = check(options.out, options.check, sha256=controller.sha256)
        print(verdict.text())
        return 0 if verdict.passed else 1
    vectors = write_kit(controller, options.out)
    print(
        f"{options.out / VECTORS}: {len(vectors['steps'])} steps and {len(vectors['scans'])} scans of {controller.path}"
    )
    print("A host passes if:")
    for words in vectors["pass"]:
        print(f"- {words}")
    return 0


COMMANDS: dict[str, tuple[str, Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], int | None]]]
COMMANDS = {
    "inspect": ("what the controller is, and how its validation went", inspect_options, run_inspect),
    "bench": ("how long a step takes on this machine", bench_options, run_bench),
    "conformance": ("test vectors for a host in any language", conformance_options, run_conformance),
    "keygen": ("make a key to sign controller files with", signing.keygen_options, signing.run_keygen),
    "sign": ("sign a controller file and its manifest", signing.sign_options, signing.run_sign),
    "verify": ("which of some keys signed a controller file", signing.verify_options, signing.run_verify),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; 0 if it went well, 1 if a host failed, 2 after one line on standard error."""
    write_any_text()
    parser = Parser(prog="python -m loopwright.serving", description="Look at a controller file.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name, (words, add, _) in COMMANDS.items():
        add(commands.add_parser(name, help=words))
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    try:
        return COMMANDS[options.command][2](options) or 0
    except LoopwrightError as error:
        print(f"error: {plain(str(error))}", file=sys.stderr)
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
