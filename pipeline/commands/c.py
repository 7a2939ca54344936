"""A controller file as plain C: readable, without heap and without a library."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopwright.pipeline.export.plain_code.c_files import c_folder, c_name, require_c_name
from loopwright.pipeline.files import require_new_folder, write_text_folder
from loopwright.serving.controller import Controller


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add = parser.add_argument
    add("file", metavar="FILE", type=Path, help="a controller's .onnx file")
    add("out", metavar="OUT", type=Path, help="folder to make")
    add("--name", help="of the files and the functions (case and law)")


def run(options: argparse.Namespace) -> None:
    """Write the folder, unless its statements part from the controller."""
    out: Path = options.out
    require_new_folder(out)
    controller = Controller(options.file)
    name = c_name(controller.manifest) if options.name is None else require_c_name(options.name)
    files = c_folder(controller, name)
    print(f"{out}: {write_text_folder(out, files)}; make -C {out} check runs the self-test")
