"""A controller file as plain C: readable, without heap and without a library."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopwright.pipeline.errors import HostError
from loopwright.pipeline.export.plain_code.c_files import c_folder, c_name, require_c_name
from loopwright.pipeline.files import draft_folder_of, write_text
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
    if out.exists():
        raise HostError(f"{out} is there already; remove it, or name another folder")
    controller = Controller(options.file)
    name = c_name(controller.manifest) if options.name is None else require_c_name(options.name)
    files = c_folder(controller, name)
    with draft_folder_of(out) as draft:
        for file, text in files.items():
            write_text(draft / file, text)
    size = sum(len(text.encode()) for text in files.values()) / 1000
    print(f"{out}: {', '.join(files)}, {size:.0f} kB; make -C {out} check runs the self-test")
