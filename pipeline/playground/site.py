"""The page of a case as a folder for any file server, or as one HTML file for a double click."""

from __future__ import annotations

import base64
import gzip
import html
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import loopwright.pipeline.hosts
import loopwright.serving.page
from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.export.plant_graphs import PlantGraphs
from loopwright.pipeline.files import draft_folder_of, write_bytes, write_text
from loopwright.pipeline.playground.web_runtime import LICENCE, MODULE, WASM
from loopwright.serving.controller import Controller

HOST = "127.0.0.1"


class _Files(SimpleHTTPRequestHandler):
    # What the machine's own table says of these differs from system to system; a browser wants exactly these.
    extensions_map: ClassVar[dict[str, str]] = {  # type: ignore[misc]
        "": "application/octet-stream",
        ".html": "text/html; charset=utf-8",
        ".css": "text/css",
        ".js": "text/javascript",
        ".mjs": "text/javascript",
        ".json": "application/json",
        ".svg": "image/svg+xml",
        ".wasm": "application/wasm",
    }

    def end_headers(self) -> None:
        """Add that nothing is to be kept: a page that was written again is to be seen."""
        self.send_header("Cache-Control", "no-cache")
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing of each request."""


def file_server(folder: Path, port: int) -> ThreadingHTTPServer:
    """A server of ``folder`` that listens at ``port``, 0 for any free one; PipelineError where it cannot."""
    try:
        return ThreadingHTTPServer((HOST, port), partial(_Files, directory=str(folder)))
    except OSError as error:
        raise PipelineError(
            f"nothing can listen at {HOST}:{port}: {error.strerror or error}; give another --port, 0 for a free one"
        ) from None


# -------------------------------------------------------------------------------------------------- the page of a case
STATIC = Path(__file__).parent / "static"
# The step and the loop are those of the hosts in Node and the browser.
LOOP = Path(loopwright.pipeline.hosts.__file__).parent / "javascript" / "controller.mjs"
# The operator's page has the same look, and the only copy of uPlot.
OPERATORS = Path(loopwright.serving.page.__file__).parent / "static"
SHARED = ("page.css", "uPlot.min.css", "uPlot.iife.min.js", "uPlot-LICENSE", "format.js", "icon.svg")
PAGE = "index.html"
TRANSITION, MEASUREMENT = "plant-transition.onnx", "plant-measurement.onnx"


@dataclass(frozen=True)
class Playground:
    """A case's page: what it knows of the case, the plant's graphs, the controllers' files."""

    about: Mapping[str, Any]
    graphs: PlantGraphs
    controllers: Sequence[Controller]

    @property
    def name(self) -> str:
        """The case."""
        return str(self.about["case"])

    def files(self) -> dict[str, bytes]:
        """The page's own files but the HTML, by name."""
        return {
            "case.json": json.dumps(self.about, allow_nan=False).encode(),
            TRANSITION: self.graphs.transition.SerializeToString(),
            MEASUREMENT: self.graphs.measurement.SerializeToString(),
            **{controller.path.name: controller.path.read_bytes() for controller in self.controllers},
        }


def write_folder(folder: Path, pages: Sequence[Playground], runtime: Path) -> None:
    """Write ``folder``/<case>/index.html for each case, what they share beside them, and a list of the cases.

    A page that is there already is replaced; PipelineError where ``folder`` holds anything that no playground writes.
    """
    _require_ours(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _replace(folder / "static", {p.name: p.read_bytes() for p in _static()})
    ort = {name: (runtime / name).read_bytes() for name in (MODULE, WASM)}
    _replace(folder / "onnxruntime-web", {**ort, LICENCE.name: LICENCE.read_bytes()})
    for page in pages:
        _replace(folder / page.name, {PAGE: (STATIC / PAGE).read_bytes(), **page.files()})
    cases = [json.loads(path.read_text()) for path in sorted(folder.glob("*/case.json"))]
    write_text(folder / PAGE, _list({case["case"]: case["title"] for case in cases}))


def write_one_file(path: Path, page: Playground, runtime: Path) -> None:
    """Write the page with all that it needs into one HTML file, which a browser opens without a server."""
    text = (STATIC / PAGE).read_text()
    inline = {p.name: p.read_text() for p in _static() if p.suffix in {".css", ".js"}}
    text = re.sub(r'<link rel="stylesheet" href="\.\./static/([^"]+)">', lambda m: _tag("style", inline[m[1]]), text)
    text = re.sub(r'<script src="\.\./static/([^"]+)"></script>', lambda m: _tag("script", inline[m[1]]), text)
    text = re.sub(
        r'<link rel="icon"[^>]*>', f'<link rel="icon" href="{_data("image/svg+xml", OPERATORS / "icon.svg")}">', text
    )
    text = re.sub(r'"\.\./static/([^"]+\.m?js)"', lambda m: f'"{_data("text/javascript", _place(m[1]))}"', text)
    text = text.replace(f'"../onnxruntime-web/{MODULE}"', f'"{_data("text/javascript", runtime / MODULE)}"')
    files = {**page.files(), WASM: (runtime / WASM).read_bytes()}
    # Compressed, as the runtime is 14 MB; a browser can undo it.
    packed = {name: base64.b64encode(gzip.compress(content, mtime=0)).decode() for name, content in files.items()}
    text = text.replace("<!-- files -->", f'<script type="application/json" id="files">{json.dumps(packed)}</script>')
    licences = "\n".join((OPERATORS / "uPlot-LICENSE", LICENCE)[i].read_text() for i in (0, 1))
    write_text(path, text.replace("<!-- licences -->", f"<!--\n{licences}\n-->"))


def _static() -> list[Path]:
    own = [p for p in sorted(STATIC.iterdir()) if p.is_file() and p.name != PAGE]
    return [*own, LOOP, *(OPERATORS / name for name in SHARED)]


def _place(name: str) -> Path:
    return next(p for p in _static() if p.name == name)


def _tag(tag: str, content: str) -> str:
    if f"</{tag}" in content:
        raise PipelineError(f"a file of the page holds </{tag}>, which would end it inside an HTML file")
    return f"<{tag}>{content}</{tag}>"


def _data(kind: str, path: Path) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _replace(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the folder whole."""
    shutil.rmtree(folder, ignore_errors=True)
    with draft_folder_of(folder) as draft:
        for name, content in files.items():
            write_bytes(draft / name, content)


def _require_ours(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise PipelineError(f"{folder} is a file; --out takes a folder")
    strange = [
        p.name
        for p in (sorted(folder.iterdir()) if folder.is_dir() else ())
        if p.name not in {PAGE, "static", "onnxruntime-web"} and not (p / "case.json").is_file()
    ]
    # Many a web site has an index.html and a folder `static`, too.
    if not strange and (folder / "static").exists() and not (folder / "static" / "playground.css").is_file():
        strange = ["static"]
    if strange:
        raise PipelineError(f"{folder} holds {strange[0]}, which no playground wrote; give --out a folder of its own")


def _list(cases: Mapping[str, str]) -> str:
    rows = "\n".join(f'<li><a href="{name}/">{html.escape(title)}</a></li>' for name, title in cases.items())
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Loopwright playground</title>
<link rel="icon" href="static/icon.svg" type="image/svg+xml">
<link rel="stylesheet" href="static/page.css">
<link rel="stylesheet" href="static/playground.css">
<script src="static/theme.js"></script>
</head>
<body>
<header><h1 id="title">Loopwright playground</h1><button id="theme" type="button">Dark</button></header>
<main class="list"><section><h2>Plants</h2><ul>
{rows}
</ul></section></main>
</body>
</html>
"""
