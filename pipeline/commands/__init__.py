"""The commands of ``loopwright``: ``options`` says what one takes, ``run`` does it. Most are a module here.

Importing this list loads none of them, so that ``loopwright --help`` answers at once.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple, NoReturn

from loopwright.serving import arguments

COMMANDS = {
    "new": "make a record of a historian's export: read, screened, judged, and added to params.yaml",
    "run": "run the pipeline, or a part of it, and say beforehand what runs and why",
    "check": "read every section of params.yaml and list its mistakes",
    "results": "show the figures of every controller, and where to look",
    "simulate": "close the loop of a controller file over its plant",
    "loop": "run a controller on a plant over OPC UA: init, check, run, export, events",
    "plant": "serve a simulated plant over OPC UA, to try a loop on",
    "playground": "try a plant and two of its controllers by hand in a browser",
    "stress": "close the loops of a controller file over many plants drawn at random",
    "certify": "bound the share of plants on which a controller file fails: fixed beforehand, drawn, counted",
    "inspect": "show what a controller file is and how its validation went",
    "bench": "measure how long a step of a controller file takes here",
    "keygen": "make a key to sign controller files with",
    "sign": "sign a controller file and its manifest, so that others can tell who made it",
    "verify": "say which of some keys signed a controller file, or fail",
    "conformance": "write test vectors of a controller file for a host in any language, or check its answers",
    "c": "write a controller file as plain C without heap and library, for microcontrollers and programs of your own",
    "st": "write a controller file as Structured Text for a PLC: blocks, guard, test vectors, PLCopen XML",
    "fmu": "write a controller file as a Functional Mock-up Unit, for Simulink, Modelica tools and test benches",
    "laws": "list the control laws, or the parameters of one",
    "models": "list the kinds of model, or the parameters of one",
    "bounds": "compute what no controller of a case can beat",
    "registry": "serve, list, promote, fetch or publish registered controllers",
}


OF_THE_RUNTIME = dict.fromkeys(
    ("inspect", "bench", "conformance", "keygen", "sign", "verify"), "loopwright.serving.__main__"
)
"""Commands that a machine without the pipeline has, too, as ``python -m loopwright.serving``."""

MODULES = {"loop": "loopwright.serving.station.command", **OF_THE_RUNTIME}
"""Modules of the commands that have none here."""


class Subcommand(NamedTuple):
    """The options of a command, and the function that does it and gives the exit status (None: 0)."""

    options: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int | None]


def loaded(name: str) -> Subcommand:
    """A command with its module, which stays: looking through its imports for garbage took a sixth of the time."""
    module = MODULES.get(name, f"loopwright.pipeline.commands.{name}")
    found = sys.modules.get(module)
    if found is None:  # frozen at each call, a caller's garbage would pile up
        looking = gc.isenabled()
        gc.disable()
        try:
            found = importlib.import_module(module)
        finally:
            if looking:
                gc.freeze()
                gc.enable()
    return _of(found, name)


def _of(module: ModuleType, name: str) -> Subcommand:
    if name in OF_THE_RUNTIME:
        return Subcommand(*module.COMMANDS[name][1:])
    return Subcommand(module.options, module.run)


class OneLineParser(arguments.Parser):
    """Says what is wrong in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        """End with status 2 and one line."""
        self.exit(2, f"{self.prog}: {message}\n")
