"""The guard of a controller in plain C under random samples, requests and states, and by intervals."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from loopwright.pipeline.export.plain_code.c_files import c_folder, c_name
from loopwright.serving import Controller

DRIVER = Path(__file__).with_suffix(".c")
INTERVALS = DRIVER.with_name("plain_c_intervals.c")
# A division by zero is no fault of IEEE 754: a step from a strange state may do it, and the guard refuses the result.
SANITIZERS = "-O1 -g -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all"
# Eva of Frama-C: one state per path, loops unrolled; infinite numbers are values, since the guard refuses them itself.
EVA = (
    "frama-c -eva -eva-precision 6 -eva-slevel 3000 -eva-split-return auto -eva-auto-loop-unroll 200 "
    "-warn-special-float nan"
)


def _filled(file: Path, controller: Controller, name: str) -> str:
    """A C text with the names of a law, and the ranges of its measured disturbances."""
    text = file.read_text(encoding="utf-8").replace("LAW", name).replace("CAP_", f"{name.upper()}_")
    for end in ("low", "high"):
        ends = ", ".join(repr(getattr(s, end)) for s in controller.manifest.dv) or "0.0"
        text = text.replace(f"DV_{end.upper()}", ends)
    return text


def _folder(file: Path, folder: Path, driver: Path) -> tuple[str, str]:
    """Writes the plain C of a controller and the driver, ``driver.c``; the law's name, and its header's text."""
    controller = Controller(file)
    name = c_name(controller.manifest)
    folder.mkdir(parents=True)
    texts = c_folder(controller, name)
    for file_name, text in (texts | {"driver.c": _filled(driver, controller, name)}).items():
        (folder / file_name).write_text(text, encoding="utf-8")
    return name, texts[f"{name}.h"]


def fuzzer(file: Path, folder: Path, flags: str = SANITIZERS, old: str = "", new: str = "") -> Path:
    """The program that draws histories for the guard of ``file``, in which ``old`` of the guard's text is ``new``."""
    name, _ = _folder(file, folder, DRIVER)
    guard = folder / f"{name}_guard.c"
    text = guard.read_text(encoding="utf-8")
    assert old in text
    guard.write_text(text.replace(old, new, 1), encoding="utf-8")
    sources = [f"{name}.c", f"{name}_guard.c", "driver.c"]
    command = ["gcc", "-std=c99", *flags.split(), "-ffp-contract=off", *sources, "-lm", "-o", "fuzz"]
    subprocess.run(command, cwd=folder, check=True)
    return folder / "fuzz"


def histories(program: Path, scans: int, seed: int, *words: str) -> tuple[dict[str, int], str]:
    """Counts of a run by name (scans, written, held, wrong), and all that it said; ``drift`` as a word: see the driver.

    The counts are empty where a sanitizer ended it.
    """
    command = [str(program), str(scans), str(seed), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    last = re.findall(r"(\d+) (scans|written|held|wrong)", done.stdout)
    return {name: int(count) for count, name in last[-4:]}, done.stdout + done.stderr


def jumps(said: str) -> int:
    """How often in a run an operator said where MVs stood that nobody knew of."""
    found = re.search(r"(\d+) jumps", said)
    return int(found[1]) if found else 0


def by_intervals(file: Path, folder: Path) -> tuple[int, int, str]:
    """How many assertions of ``plain_c_intervals.c`` Frama-C proves for ``file``, how many not, and its report."""
    name, header = _folder(file, folder, INTERVALS)
    declared = re.search(rf"void {name}_step\((.*?)\);", header, re.DOTALL)
    assert declared is not None
    outputs = re.findall(r"(?<!const )double (\w+)\[(\d+)\]", declared[1])
    fills = "".join(f"    for (int k = 0; k < {n}; ++k) {{ {out}[k] = any(); }}\n" for out, n in outputs)
    driver = folder / "driver.c"
    step = f"void {name}_step({declared[1]})\n{{\n{fills}}}\n"
    driver.write_text(driver.read_text(encoding="utf-8").replace("STEP\n", step), encoding="utf-8")
    # It looks for relative names where the shell stood.
    command = [*EVA.split(), f"-cpp-extra-args=-I{folder}", str(driver), str(folder / f"{name}_guard.c")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    counts = re.search(r"Assertions\s+(\d+) valid\s+(\d+) unknown\s+(\d+) invalid", done.stdout)
    if counts is None:
        return 0, 0, done.stdout + done.stderr
    return int(counts[1]), int(counts[2]) + int(counts[3]), done.stdout
