"""Every shipped controller in every host: loaded, same bits, largest difference, step, and what a host must ship.

``python benchmarks/hosts.py [FILE.onnx ...]``; without files, every controller in artifacts/. About three minutes.
A host whose parts are missing is named and left out: C needs cmake, a C compiler and ONNXRUNTIME_DIR
(``tools/onnxruntime_c.sh build/onnxruntime``), Node and the browser ``npm ci`` in examples/embed/node and
examples/embed/browser. Each host runs the kit of ``loopwright conformance`` and ``loopwright.serving.conformance``
compares its answers. Step: the median over the kit's steps; in Node over 600 equal ones, in the browser over 30 blocks
of 20, because its clock counts in 100 us; the lowest of three rounds, because on a shared machine whole rounds run
slower. A difference is a share of the entry's scale, in one step from the kit's state and chained; same bits: in every
number of the file.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from loopwright.serving import Controller, LoopwrightError
from loopwright.serving.conformance.kit import KitVerdict, check, write_kit

ROOT = Path(__file__).resolve().parents[1]
EMBED = ROOT / "examples" / "embed"
ONNXRUNTIME = Path(os.environ.get("ONNXRUNTIME_DIR", ROOT / "build" / "onnxruntime"))
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, BROWSERS)), None)

ROUNDS = 3

Run = Callable[[Path, Path], None]  # (kit, answers): writes the answers


@dataclass(frozen=True)
class Cell:
    """What one host made of one file; no verdict: it did not load."""

    verdict: KitVerdict | None
    p50_us: float


def size(*paths: Path) -> int:
    """Bytes of files, and of all files in folders; compiled Python does not count."""
    files = (file for path in paths for file in ([path] if path.is_file() else path.rglob("*")))
    return sum(file.stat().st_size for file in files if file.is_file() and "__pycache__" not in file.parts)


def call(*words: str | Path) -> None:
    done = subprocess.run([str(w) for w in words], capture_output=True, text=True, timeout=300)
    if done.returncode not in {0, 1}:  # 1: the host itself says that it does not pass; the check says why
        raise RuntimeError(done.stderr.strip() or done.stdout.strip())


@contextmanager
def python_host(folder: Path) -> Iterator[tuple[Run, int]]:
    """Our runtime, in a process of its own."""
    parts = [Path(spec.origin).parent for n in ("numpy", "onnxruntime") if (spec := find_spec(n)) and spec.origin]
    libraries = [path for part in parts if (path := part.parent / f"{part.name}.libs").is_dir()]
    yield (
        lambda kit, out: call(sys.executable, EMBED / "python" / "conformance.py", kit, out),
        size(*parts, *libraries, *(ROOT / "serving").glob("*.py"), ROOT / "serving" / "journal"),
    )


@contextmanager
def c_host(folder: Path) -> Iterator[tuple[Run, int]]:
    """examples/embed/c/onnxruntime, built for speed."""
    call("cmake", "-S", EMBED / "c" / "onnxruntime", "-B", folder / "c", f"-DONNXRUNTIME_DIR={ONNXRUNTIME}")
    call("cmake", "--build", folder / "c")
    host = folder / "c" / "host"
    yield (
        lambda kit, out: call(host, "--conformance", kit, out),
        size(host, ONNXRUNTIME / "lib" / "libonnxruntime.so.1"),
    )


@contextmanager
def node_host(folder: Path) -> Iterator[tuple[Run, int]]:
    """examples/embed/node."""
    node, packages = shutil.which("node"), EMBED / "node" / "node_modules"
    if node is None or not packages.is_dir():
        raise FileNotFoundError("node or examples/embed/node/node_modules")
    machine = {"x86_64": "x64", "aarch64": "arm64"}.get(os.uname().machine, os.uname().machine)
    parts = [packages / "onnxruntime-common" / "dist" / "cjs", packages / "onnxruntime-node" / "dist"]
    binary = packages / "onnxruntime-node" / "bin" / "napi-v6" / sys.platform / machine
    script = EMBED / "javascript" / "controller.mjs"
    yield (
        lambda kit, out: call(node, EMBED / "node" / "host.mjs", "--conformance", kit, out),
        size(*parts, binary, script),
    )


class Quiet(SimpleHTTPRequestHandler):
    """Serves files without a word."""

    def log_message(self, format: str, *words: object) -> None:
        """Nothing."""


@contextmanager
def browser_host(folder: Path) -> Iterator[tuple[Run, int]]:
    """examples/embed/browser in chromium, headless."""
    from playwright.sync_api import sync_playwright

    files = EMBED / "browser" / "node_modules" / "onnxruntime-web" / "dist"
    names = ("ort.wasm.min.mjs", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm")
    if CHROMIUM is None or not files.is_dir():
        raise FileNotFoundError("chromium or examples/embed/browser/node_modules")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=EMBED))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        with sync_playwright() as p:
            browser = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
            page = browser.new_page()
            page.goto(f"http://127.0.0.1:{server.server_port}/browser/")
            page.wait_for_selector("body[data-ready=yes]")

            def run(kit: Path, out: Path) -> None:
                page.evaluate("window.answers = null")
                page.set_input_files("#files", [str(file) for file in kit.iterdir()])
                page.click("#conform")
                page.wait_for_selector("#conform:enabled", timeout=120_000)
                answers = page.evaluate("window.answers")
                if answers is None:
                    raise RuntimeError(page.text_content("#said"))
                out.write_text(json.dumps(answers))

            yield run, size(*(files / n for n in names), EMBED / "javascript" / "controller.mjs")
            browser.close()
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


HOSTS = {"Python": python_host, "C": c_host, "Node": node_host, "browser": browser_host}


def measured(run: Run, file: Path, kit: Path, out: Path) -> Cell:
    """One file in one host."""
    p50 = np.inf
    for _ in range(ROUNDS):
        try:
            run(kit, out)
        except RuntimeError as error:
            print(f"{file.parent.name}/{file.stem}: {error}", file=sys.stderr)
            return Cell(None, np.nan)
        p50 = min(p50, float(json.loads(out.read_text())["p50_us"]))
    return Cell(check(kit, out, Controller(file).sha256), p50)


def main() -> int:
    """Print the tables; 1 if a file does not pass in a host."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    files = parser.parse_args().files or sorted((ROOT / "artifacts").glob("*/*.onnx"))
    print(f"{len(files)} controllers in {len(HOSTS)} hosts; about three minutes", flush=True)
    cells: dict[str, list[Cell]] = {}
    sizes: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            kits = [folder / str(k) for k in range(len(files))]
            for file, kit in zip(files, kits, strict=True):
                write_kit(Controller(file), kit)
        except LoopwrightError as error:
            print(error, file=sys.stderr)
            return 2
        for host, opened in HOSTS.items():
            try:
                with opened(folder) as (run, sizes[host]):
                    pairs = zip(files, kits, strict=True)
                    cells[host] = [measured(run, file, kit, folder / "answers.json") for file, kit in pairs]
            except (ImportError, OSError, RuntimeError) as error:
                sizes.pop(host, None)
                print(f"{host} is left out: {error}", file=sys.stderr)
    print(summary(cells, sizes), table(files, cells), sep="\n\n")
    return 0 if all(cell.verdict and cell.verdict.passed for row in cells.values() for cell in row) else 1


def summary(cells: dict[str, list[Cell]], sizes: dict[str, int]) -> str:
    """A row a host."""
    lines = [
        "| host | onnxruntime | loaded | passed | same bits | one step | chained | step p50 [us] | to ship [MB] |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for host, row in cells.items():
        good = [cell.verdict for cell in row if cell.verdict]
        runtime = good[0].runtime if good else "-"
        same = sum(v.identical for v in good)
        one_step = max((v.one_step.largest for v in good), default=np.nan)
        chained = max((v.chained.largest for v in good), default=np.nan)
        times = [cell.p50_us for cell in row if cell.verdict] or [np.nan]
        lines.append(
            f"| {host} | {runtime} | {len(good)} of {len(row)} | {sum(v.passed for v in good)} | {same} | "
            f"{one_step:.1g} | {chained:.1g} | {min(times):.0f} .. {max(times):.0f} | {sizes[host] / 1e6:.0f} |"
        )
    return "\n".join(lines)


def table(files: list[Path], cells: dict[str, list[Cell]]) -> str:
    """A row a file: in each host the step's median, and the largest differences where not all bits are equal."""
    lines = ["| step p50 [us], one step, chained | " + " | ".join(cells) + " |", "|---|" + "---:|" * len(cells)]
    for k, file in enumerate(files):
        row = [_words(cells[host][k]) for host in cells]
        lines.append(f"| `{file.parent.name}/{file.stem}` | " + " | ".join(row) + " |")
    return "\n".join(lines)


def _words(cell: Cell) -> str:
    v = cell.verdict
    if v is None:
        return "not loaded"
    difference = "" if v.identical else f", {v.one_step.largest:.0e}, {v.chained.largest:.0e}"
    return f"{cell.p50_us:.0f}{difference}{'' if v.passed else ' FAILED'}"


if __name__ == "__main__":
    sys.exit(main())
