"""Controllers in plain C as WebAssembly modules, built as examples/embed/wasm says."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

from kits import EMBED

from loopwright.pipeline.__main__ import main

ABSENT = [program for program in ("clang", "wasm-ld", "node", "make") if shutil.which(program) is None]
MISSING = f"{ABSENT[0]} is not installed (Debian: apt install clang lld nodejs make)" if ABSENT else ""


def module_of(file: Path, folder: Path) -> Path:
    """law.wasm of a controller, in a new folder."""
    assert main(["c", str(file), str(folder), "--name", "law"]) == 0
    words = ["make", "-C", str(EMBED / "wasm"), f"LAW={folder}"]
    made = subprocess.run(words, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    return folder / "law.wasm"
