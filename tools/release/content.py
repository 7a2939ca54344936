"""List what a wheel holds, and refuse what does not belong there: ``python content.py WHEEL``.

A wheel has two packages. ``loopwright.serving`` is the runtime, ``loopwright.pipeline`` makes controllers. Each holds
its modules and the few files that they open; no test, no record, and no bounds of a case, which are read in the
repository alone.
"""

from __future__ import annotations

import sys
import zipfile
from collections import Counter
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).parents[2]
TOP, PACKAGES = "loopwright", ("pipeline", "serving")
# The folders of files that the modules open, and the kinds of these files.
OPENED = {
    "loopwright/serving/page/static": {".js", ".css", ".html", ".svg"},
    "loopwright/pipeline/report/templates": {".j2"},
    "loopwright/pipeline/export/plain_code": {".c", ".h"},
    "loopwright/pipeline/export/structured_text": {".st"},
    "loopwright/pipeline/hosts/c": {".c"},
    "loopwright/pipeline/hosts/c/onnxruntime": {".h"},
    "loopwright/pipeline/hosts/javascript": {".mjs"},
    "loopwright/pipeline/hosts/fmu/sources": {".c"},
    "loopwright/pipeline/playground/static": {".js", ".css", ".html"},
    "loopwright/pipeline/playground/npm": {".json"},
}
FEW = {
    *("loopwright/serving/py.typed", "loopwright/pipeline/py.typed", "loopwright/serving/page/static/uPlot-LICENSE"),
    *("loopwright/pipeline/playground/npm/onnxruntime-LICENSE", "loopwright/pipeline/hosts/c/onnxruntime/LICENSE"),
}
DIST_INFO = {
    *("METADATA", "WHEEL", "RECORD", "entry_points.txt", "top_level.txt"),
    *("licenses/LICENSE", "licenses/serving/page/static/uPlot-LICENSE"),
    "licenses/pipeline/hosts/c/onnxruntime/LICENSE",
}


def faults(names: set[str], modules: set[str]) -> list[str]:
    """What is wrong with a wheel of these files, where the sources have these modules."""
    lost = [f"{name}: not in the wheel" for name in sorted((modules | FEW) - names)]
    return lost + [f"{name}: does not belong in a wheel" for name in sorted(names) if not _belongs(name, modules)]


def named_cases(wheel: zipfile.ZipFile) -> list[str]:
    """The files of the runtime that name a case."""
    cases = [p.parent.name.encode() for p in (ROOT / "pipeline/cases").glob("*/case.py")]
    ours = [name for name in wheel.namelist() if name.startswith(f"{TOP}/serving/")]
    return [f"{name}: names a case" for name in ours if any(case in wheel.read(name) for case in cases)]


def sources() -> set[str]:
    """The modules of the sources, as a wheel names them."""
    return {f"{TOP}/{p.relative_to(ROOT).as_posix()}" for package in PACKAGES for p in (ROOT / package).rglob("*.py")}


def _belongs(name: str, modules: set[str]) -> bool:
    path = PurePosixPath(name)
    if path.parts[0].endswith(".dist-info"):
        return name.partition("/")[2] in DIST_INFO
    return name in modules | FEW or path.suffix in OPENED.get(path.parent.as_posix(), set())


def listing(wheel: zipfile.ZipFile) -> str:
    """Files and bytes of each package by kind, then every file with its bytes."""
    sizes = {row.filename: row.file_size for row in wheel.infolist()}
    kinds: Counter[tuple[str, str]] = Counter()
    packed: Counter[str] = Counter()
    for row in wheel.infolist():
        path = PurePosixPath(row.filename)
        top = "/".join(path.parts[:2]) if path.parts[0] == TOP else path.parts[0]
        kinds[top, path.suffix or path.name] += 1
        packed[top] += row.compress_size
    heads = [f"{packed[top]:9,} bytes packed  {top}: {_kinds(kinds, top)}" for top in sorted(packed)]
    return "\n".join([*heads, "", *(f"{size:9,}  {name}" for name, size in sorted(sizes.items()))])


def _kinds(kinds: Counter[tuple[str, str]], top: str) -> str:
    return ", ".join(f"{count} {kind}" for (where, kind), count in sorted(kinds.items()) if where == top)


def main(path: str) -> int:
    """Print the listing; 1 after a line on standard error for each file that is wrong."""
    with zipfile.ZipFile(path) as wheel:
        print(listing(wheel))
        wrong = faults(set(wheel.namelist()), sources()) + named_cases(wheel)
    for line in wrong:
        print(f"content: {line}", file=sys.stderr)
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
