"""The control laws, and the parameters of one."""

from __future__ import annotations

import argparse

from pipeline.commands.parameters import show
from pipeline.config.params import choose
from pipeline.laws import LAWS


def options(parser: argparse.ArgumentParser) -> None:
    """What the command takes."""
    parser.add_argument("name", metavar="NAME", nargs="?", help="a law: show its parameters (default: list the laws)")


def run(options: argparse.Namespace) -> None:
    """Print the list or one law."""
    if options.name is None:
        for name, law in LAWS.items():
            print(f"{name:28} {law.title}")
        return
    law = choose(LAWS, options.name, "law", "laws")
    print(f"{law.name}: {law.title}\n")
    show(law.Params)
