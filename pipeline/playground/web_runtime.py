"""onnxruntime-web: fetched once by npm, its digests known beforehand, then kept on this machine.

``python -m loopwright.pipeline.playground.web_runtime`` fetches it, so that the playground later needs no network.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.files import draft_folder_of, kept_folder, sha256

VERSION = "1.30.0"  # as in npm/package.json
MODULE, WASM = "ort.wasm.bundle.min.mjs", "ort-wasm-simd-threaded.wasm"
# SHA-256 of the files that the page loads. npm checks the whole package against npm/package-lock.json.
DIGESTS = {
    MODULE: "11e64bd8ffe11bd1a2a2f0d6275fdfbbba7262f0b76b99b53d228a8a22ef3d90",
    WASM: "3398c10d07d229bd91b364548e130e0e51a8e5704b88c7c083ebbeb78842dee2",
}
NPM = Path(__file__).parent / "npm"
LICENCE = NPM / "onnxruntime-LICENSE"
NPM_PATIENCE_S = 600.0  # [s] that npm may take


def kept() -> Path:
    """The folder that holds the files once they were fetched."""
    return kept_folder(f"onnxruntime-web-{VERSION}")


def web_runtime(given: Path | None = None) -> Path:
    """A folder with the files: the ``given`` one, the kept one, or else the one that npm now fetches.

    Raises PipelineError where a file is missing or is another one, and where npm cannot fetch them.
    """
    if given is not None:
        check(given)
        return given
    folder = kept()
    if not folder.exists():
        _fetch(folder)
    check(folder)
    return folder


def check(folder: Path) -> None:
    """PipelineError unless the folder has each file, and no other in its place."""
    for name, digest in DIGESTS.items():
        path = folder / name
        if not path.is_file():
            raise PipelineError(
                f"{path} is missing; give the folder `dist` of the npm package onnxruntime-web {VERSION}, "
                f"or delete {folder} to have it fetched again"
            )
        if sha256(path) != digest:
            raise PipelineError(
                f"{path} is not that of onnxruntime-web {VERSION}: its SHA-256 is {sha256(path)}, not {digest}; "
                "delete the folder to have it fetched again"
            )


def _fetch(folder: Path) -> None:
    npm = shutil.which("npm")
    elsewhere = f"or give the folder `dist` of the npm package onnxruntime-web {VERSION} with --runtime"
    if npm is None:
        raise PipelineError(f"npm is not installed, which fetches onnxruntime-web; install Node.js, {elsewhere}")
    print(f"playground: npm fetches onnxruntime-web {VERSION} into {folder}, once", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory() as place:
        for name in ("package.json", "package-lock.json"):
            shutil.copy(NPM / name, place)
        # Without scripts: nothing that is fetched is run here.
        command = [npm, "ci", "--prefix", place, "--ignore-scripts", "--no-audit", "--no-fund"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=NPM_PATIENCE_S, check=False)
        except subprocess.TimeoutExpired:
            raise PipelineError(f"npm took more than {NPM_PATIENCE_S:g} s; try again, {elsewhere}") from None
        if done.returncode:
            said = [line for line in done.stderr.splitlines() if line.strip()] or ["no reason given"]
            raise PipelineError(f"npm cannot fetch onnxruntime-web: {said[0]}; try again, {elsewhere}")
        dist = Path(place) / "node_modules" / "onnxruntime-web" / "dist"
        check(dist)
        with draft_folder_of(folder) as draft:
            for name in DIGESTS:
                shutil.copyfile(dist / name, draft / name)


if __name__ == "__main__":
    try:
        print(web_runtime())
    except PipelineError as error:
        sys.exit(f"playground: {error}")
