"""A controller file as a Functional Mock-up Unit for co-simulation."""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

from loopwright.pipeline.errors import ExportError, HostError
from loopwright.pipeline.files import draft_of, size_words
from loopwright.pipeline.hosts.fmu.compiling import toolchain
from loopwright.pipeline.hosts.fmu.folder import check, pack, problems, write_folder
from loopwright.pipeline.hosts.fmu.law_sources import plain_answers
from loopwright.serving.conformance.steps import StepResult, answered
from loopwright.serving.controller import Controller


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add = parser.add_argument
    add("file", metavar="FILE", type=Path, help="a controller's .onnx file")
    add("--out", metavar="FILE.fmu", type=Path, help="what to write (the controller's name with .fmu, here)")
    add("--fmi", choices=(2, 3), type=int, default=3, help="version of FMI: 2 for 2.0, 3 for 3.0 (3)")
    add(
        "--onnxruntime",
        action="store_true",
        help="put onnxruntime into the FMU, 15 MB, and compute by it",
    )


def run(options: argparse.Namespace) -> None:
    """Write the FMU, unless it differs from the controller by a bit."""
    controller = Controller(options.file)
    out: Path = Path(f"{options.file.stem}.fmu") if options.out is None else options.out
    _require_free(out)
    tools = toolchain(onnxruntime=options.onnxruntime)
    plain = None if options.onnxruntime else _plain_answers(controller)
    with draft_of(out) as draft, tempfile.TemporaryDirectory(prefix="loopwright-fmu-") as made:
        folder = Path(made)
        write_folder(controller, folder, options.fmi, tools)
        pack(folder, draft)
        wrong = problems(draft)
        if wrong:
            raise HostError(f"the FMU's description is not valid FMI {options.fmi}.0: {'; '.join(wrong)}")
        steps = check(controller, draft, folder, answered(controller) if plain is None else plain)
    size, of = size_words(out.stat().st_size), "controller file" if plain is None else "plain C's statements"
    print(f"{out}: FMI {options.fmi}.0, {size}, {steps} steps give the same bits as the {of}")


def _plain_answers(controller: Controller) -> list[StepResult]:
    try:
        return plain_answers(controller)
    except ExportError as error:
        raise HostError(f"{error}; with --onnxruntime an FMU needs no plain C") from error


def _require_free(out: Path) -> None:
    """HostError, before anything is compiled, for a file that cannot be written."""
    if out.suffix != ".fmu":
        raise HostError(f"{out} does not end in .fmu, by which tools know an FMU")
    if out.exists():
        raise HostError(f"{out} is there already; remove it, or name another file with --out")
    if not out.parent.is_dir():
        raise HostError(f"{out.parent} is no folder, so {out.name} cannot be written there")
    if not os.access(out.parent, os.W_OK):
        raise HostError(f"{out.parent} is not writable, so {out.name} cannot be written there")
