"""A controller file as Structured Text of IEC 61131-3: blocks for a PLC, and PLCopen XML to import them."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopwright.pipeline.errors import HostError
from loopwright.pipeline.export.structured_text.iec_names import require_st_name, st_name
from loopwright.pipeline.export.structured_text.st_files import st_folder
from loopwright.pipeline.files import draft_folder_of, write_text
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
    if out.exists():
        raise HostError(f"{out} is there already; remove it, or name another folder")
    controller = Controller(options.file)
    name = st_name(controller.manifest) if options.name is None else require_st_name(options.name)
    files, durations = st_folder(controller, name)
    with draft_folder_of(out) as draft:
        for file, text in files.items():
            write_text(draft / file, text)
    size = sum(len(text.encode()) for text in files.values()) / 1000
    print(f"{out}: {', '.join(files)}, {size:.0f} kB; run {name}_test on the PLC before the first start")
    print("A step, estimated from published figures and not measured:")
    for line in durations:
        print(f"  {line}")
