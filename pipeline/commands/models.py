"""The kinds of model, and the parameters of one."""

from __future__ import annotations

import argparse

from loopwright.pipeline.commands.parameters import first_sentence, list_or_show
from loopwright.pipeline.models import MODELS


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("name", metavar="KIND", nargs="?", help="a kind: show its parameters (default: list the kinds)")


def run(options: argparse.Namespace) -> None:
    """Print the list or one kind."""
    kinds = {kind: (first_sentence(part), part) for kind, part in MODELS.items()}
    list_or_show(kinds, options.name, "kind of model")
