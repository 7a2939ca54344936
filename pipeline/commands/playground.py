"""``loopwright playground``: a plant and its controllers in a browser, from files alone."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.commands.arguments import require_made_for, whole
from loopwright.pipeline.config.params import choose
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.export.plant_graphs import plant_graphs
from loopwright.pipeline.playground.about import about, validation_of
from loopwright.pipeline.playground.site import HOST, Playground, file_server, write_folder, write_one_file
from loopwright.pipeline.playground.web_runtime import web_runtime
from loopwright.serving.controller import Controller
from loopwright.serving.controller_file import controller_files

PORT = 8123  # of the page, where none is given
ALL = "all"


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add = parser.add_argument
    add("cases", metavar="CASE", nargs="+", help=f"a case, several, or {ALL!r}")
    add("--out", metavar="FOLDER", type=Path, help="write the page there, for any file server, and end")
    add("--port", metavar="N", type=whole(0, 65535), help=f"serve the page here ({PORT}); 0: any free port")
    add("--one-file", metavar="FILE", type=Path, help="write the page of one case into one HTML file, and end")
    add("--artifacts", metavar="FOLDER", type=Path, default=Path("artifacts"), help="of the controllers (artifacts)")
    add("--runtime", metavar="FOLDER", type=Path,
        help="with the files of onnxruntime-web (default: npm fetches them once)")  # fmt: skip


def run(options: argparse.Namespace) -> None:
    """Write the page, serve it, or both."""
    if options.one_file is not None and (len(options.cases) > 1 or options.cases == [ALL]):
        raise ParamsError("--one-file takes one case")
    if options.one_file is not None and (options.out is not None or options.port is not None):
        raise ParamsError("--one-file needs neither --out nor --port")
    pages = [page_of(case, options.artifacts) for case in _cases(options.cases, options.artifacts)]
    runtime = web_runtime(options.runtime)
    if options.one_file is not None:
        write_one_file(options.one_file, pages[0], runtime)
        print(f"playground: {options.one_file}, open it in a browser")
    elif options.out is not None:
        write_folder(options.out, pages, runtime)
        print(f"playground: {options.out / pages[0].name / 'index.html'}, for any file server")
        if options.port is not None:
            _serve(options.out, options.port, pages)
    else:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "playground"
            write_folder(folder, pages, runtime)
            _serve(folder, PORT if options.port is None else options.port, pages)


def page_of(case: Case, artifacts: Path) -> Playground:
    """The page of a case with all of its controllers; ParamsError where it has none."""
    folder = artifacts / case.name
    controllers = [Controller(path) for path in controller_files(folder)]
    if not controllers:
        raise ParamsError(f"{folder} has no controller; make some with `loopwright run {case.name}`")
    for controller in controllers:
        require_made_for(controller.manifest, case.equations)
    return Playground(about(case, controllers, validation_of(folder)), plant_graphs(case.equations), controllers)


def _cases(names: list[str], artifacts: Path) -> list[Case]:
    cases = all_cases()
    if names == [ALL]:
        found = [case for name, case in cases.items() if controller_files(artifacts / name)]
        if not found:
            raise ParamsError(f"{artifacts} has no controller; make some with `loopwright run`")
        return found
    return [choose(cases, name, "case") for name in dict.fromkeys(names)]


def _serve(folder: Path, port: int, pages: list[Playground]) -> None:
    with file_server(folder, port) as server:
        where = f"http://{HOST}:{server.server_port}/"
        print(f"playground: {where}{pages[0].name + '/' if len(pages) == 1 else ''} (Ctrl-C ends it)", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("playground: ended", file=sys.stderr)
