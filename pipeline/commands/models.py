"""The kinds of model, and the parameters of one."""

from __future__ import annotations

import argparse

from pipeline.commands.parameters import first_sentence, show
from pipeline.config.params import choose
from pipeline.models import MODELS


def options(parser: argparse.ArgumentParser) -> None:
    """What the command takes."""
    parser.add_argument("name", metavar="KIND", nargs="?", help="a kind: show its parameters (default: list the kinds)")


def run(options: argparse.Namespace) -> None:
    """Print the list or one kind."""
    if options.name is None:
        for kind, part in MODELS.items():
            print(f"{kind:28} {first_sentence(part)}")
        return
    part = choose(MODELS, options.name, "kind of model", "models")
    print(f"{options.name}: {first_sentence(part)}\n")
    show(part)
