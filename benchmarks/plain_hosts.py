"""Controllers in plain C as FMUs, on a Cortex-M7 in qemu and as WebAssembly modules: sizes, and the same bits.

``python benchmarks/plain_hosts.py [FILE ...]``: for each file (all shipped ones) the kilobytes of the FMU; code and
constants of step and guard for a Cortex-M7, the sum of all their stack frames, and what the self-test says there;
kilobytes of the WebAssembly module and its largest difference to onnxruntime in the kit, in one step and chained. Needs
what examples/embed/c/cortex_m7 and examples/embed/wasm need. About twelve minutes.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

from loopwright.pipeline.export.plain_code.c_files import c_folder
from loopwright.pipeline.hosts.fmu.compiling import toolchain
from loopwright.pipeline.hosts.fmu.folder import pack, write_folder
from loopwright.serving import Controller
from loopwright.serving.conformance.kit import write_kit

ROOT = Path(__file__).parents[1]
EMBED = ROOT / "examples" / "embed"


def said(*words: str | Path) -> str:
    """What a program prints; its status is in what it says."""
    done = subprocess.run([str(w) for w in words], capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def row(file: Path) -> str:
    """The figures of one file."""
    controller = Controller(file)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for part in ("fmu", "law", "kit"):
            (folder / part).mkdir()
        write_folder(controller, folder / "fmu", 3, toolchain())
        pack(folder / "fmu", folder / "law.fmu")
        for name, text in c_folder(controller, "law").items():
            (folder / "law" / name).write_text(text, encoding="utf-8")
        board = ("make", "-s", "-C", EMBED / "c" / "cortex_m7", f"LAW={folder / 'law'}")
        checked, sizes = said(*board, "check"), said(*board, "size")
        flash = [int(line.split()[0]) for line in sizes.splitlines()[1:]]
        frames = [line for name in ("law.su", "law_guard.su") for line in _lines(folder / "law" / "cortex_m7" / name)]
        stack = sum(int(line.split("\t")[1]) for line in frames)
        said("make", "-s", "-C", EMBED / "wasm", f"LAW={folder / 'law'}")
        write_kit(controller, folder / "kit")
        node = said("node", EMBED / "wasm" / "host.mjs", folder / "law" / "law.wasm", "--conformance", folder / "kit")
        largest = re.search(r"largest difference (\S+), chained (\S+), (\d+) wrong", node)
        node = " ".join(largest.groups()) if largest else node.strip()
        bits = "same bits" if "same bits" in checked and ", 0 wrong" in checked else "OTHER BITS"
        return (
            f"{file.parent.name}/{file.stem:28s} FMU {_kb(folder / 'law.fmu'):4.0f} kB  Cortex-M7 {bits}, flash "
            f"{flash[0] / 1000:5.1f} + {flash[1] / 1000:.1f} kB, stack {stack} bytes"
            f"  wasm {_kb(folder / 'law' / 'law.wasm'):4.0f} kB, {node}"
        )


def _lines(file: Path) -> list[str]:
    return file.read_text(encoding="utf-8").splitlines()


def _kb(file: Path) -> float:
    return file.stat().st_size / 1000


def main(words: list[str]) -> None:
    """Print the figures."""
    for file in [Path(w) for w in words] or sorted((ROOT / "artifacts").glob("*/*.onnx")):
        print(row(file), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
