"""A controller file as Structured Text of IEC 61131-3: blocks for a PLC, and PLCopen XML to import them."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopwright.pipeline.export.structured_text.iec_names import require_st_name, st_name
from loopwright.pipeline.export.structured_text.st_files import st_folder
from loopwright.pipeline.files import require_new_folder, write_text_folder
from loopwright.serving.controller import Controller


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add = parser.add_argument
    add("file", metavar="FILE", type=Path, help="a controller's .onnx file")
    add("out", metavar="OUT", type=Path, help="folder to make")
    add("--name", help="with which all blocks begin (case and law)")


def run(options: argparse.Namespace) -> None:
    """Write the folder, unless its statements part from the controller."""
    out: Path = options.out
    require_new_folder(out)
    controller = Controller(options.file)
    name = st_name(controller.manifest) if options.name is None else require_st_name(options.name)
    files, durations = st_folder(controller, name)
    print(f"{out}: {write_text_folder(out, files)}; run {name}_test on the PLC before the first start")
    print("A step, estimated from published figures and not measured:")
    for line in durations:
        print(f"  {line}")
