"""Controllers as plain C: bits, sizes and times beside onnxruntime, and how exact exp, log and tanh are.

``python benchmarks/plain_code.py [FILE ...] [--points N] [--compiler "gcc -O2"]``: for each file (all shipped ones) the
seconds of the export and of the compiler, bytes of the object, its stack and its tables, whether the self-test finds
the same bits, and medians of a step: of the C, called from C and from Python, and of onnxruntime, in turns in one run.
Then the largest errors of the functions over N points each, in units of the last place, against mpmath. About 20 s a
predictive file.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
from mpmath import mp

from loopwright.pipeline.export.plain_code.c_files import arguments_of, c_folder
from loopwright.pipeline.export.plain_code.c_header import OUTPUTS
from loopwright.pipeline.export.plain_code.c_text import printed_step
from loopwright.pipeline.export.plain_code.elementary import plain_exp, plain_log, plain_tanh
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.statements import OUTPUT
from loopwright.serving import Controller
from loopwright.serving.manifest import INPUTS

_DOUBLES = ctypes.POINTER(ctypes.c_double)
ROOT = Path(__file__).parents[1]
STEPS = 2_000  # timed of each
TURNS = 20  # they change places so often
CALLER = """#include "law.h"
void law_often(int times, const double *const *in, double *const *out)
{
    for (int k = 0; k < times; ++k) {
        LAW_CALL(in, out);
    }
}
"""


def row(file: Path, compiler: str) -> str:
    """The figures of one file."""
    controller, began = Controller(file), time.process_time()
    texts = c_folder(controller, "law")
    printed = time.process_time() - began
    step = printed_step(lowered(onnx.load(file)), "law")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        began = time.monotonic()
        command = [*shlex.split(compiler), "-ffp-contract=off", "-c", "law.c", "-o", "law.o"]
        subprocess.run(command, cwd=folder, check=True)
        compiled = time.monotonic() - began
        said = subprocess.run(["make", "-s", "check"], cwd=folder, capture_output=True, text=True, check=False)
        size = (folder / "law.o").stat().st_size
        (folder / "caller.c").write_text(CALLER, encoding="utf-8")
        shared = [*shlex.split(compiler), "-ffp-contract=off", "-shared", "-fPIC", "law.c", "caller.c", "-lm"]
        subprocess.run([*shared, "-o", "law.so"], cwd=folder, check=True)
        plain, ours, called = _times(controller, ctypes.CDLL(str(folder / "law.so")))
    bits = "same bits" if said.returncode == 0 else "OTHER BITS"
    return (
        f"{file.parent.name}/{file.stem:28s} {bits}  export {printed:5.2f} s  compiled {compiled:5.1f} s  object "
        f"{size / 1000:5.0f} kB  stack {step.work_bytes / 1024:5.1f} KiB  tables {step.table_bytes / 1000:5.0f} kB  "
        f"{step.operations:6d} operations  step {ours:6.2f} us, from Python {called:6.2f} us, "
        f"onnxruntime {plain:6.1f} us"
    )


def _times(controller: Controller, library: ctypes.CDLL) -> tuple[float, float, float]:
    """Medians of a step [us]: of the session that the runtime binds, of the C, and of the C called from Python."""
    m = controller.manifest
    program = lowered(onnx.load(controller.path))
    middle = {"sp": m.sp, "pv": m.pv, "dv": m.dv, "mv_applied": m.mv}
    given = {n: np.array([s.middle for s in signals]) for n, signals in middle.items()}
    given |= {"state": np.zeros(m.n_state), "operate": np.array([e.default for e in m.operate])}
    given |= {"fresh": np.ones(len(m.pv)), "ahead": np.zeros(program.inputs.get("ahead", 0))}
    given = {n: np.ascontiguousarray(v, dtype=np.float64) for n, v in given.items()}
    made = {n.removeprefix(OUTPUT): np.zeros(count) for n, count in program.outputs.items() if count}
    pointers = {n: v.ctypes.data_as(_DOUBLES) for n, v in (given | made).items()}
    arguments = [pointers[n] for n in arguments_of(program)]
    all_in, all_out = ((_DOUBLES * len(names))(*(pointers.get(n) for n in names)) for names in (INPUTS, OUTPUTS))
    flat = np.zeros((1, controller.width))
    for name, at in controller.places.items():
        if name in program.inputs:
            flat[0, at] = given[name]
    calls: dict[str, tuple[int, Callable[[], object]]] = {  # steps of a call, call
        "onnxruntime": (1, lambda: controller.compute(flat)),
        "c": (10, lambda: library.law_often(10, all_in, all_out)),
        "many": (110, lambda: library.law_often(110, all_in, all_out)),
        "python": (1, lambda: library.law_step(*arguments)),
    }
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(TURNS):
        for name, (steps, call) in calls.items():
            for _ in range(max(5, STEPS // TURNS // steps)):
                began = time.perf_counter()
                call()
                taken[name].append(time.perf_counter() - began)
    medians = {name: 1e6 * float(np.median(times)) for name, times in taken.items()}
    return medians["onnxruntime"], (medians["many"] - medians["c"]) / 100, medians["python"]


def worst(ours: Callable[[float], float], exact: Callable[..., float], points: np.ndarray) -> float:
    """The largest error in units of the last place."""
    found = 0.0
    with mp.workprec(140):
        for x in points.tolist():
            true = exact(mp.mpf(x))
            found = max(found, float(abs(mp.mpf(ours(x)) - true) / math.ulp(float(true))))
    return found


def main(argv: list[str]) -> int:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("files", nargs="*", type=Path, help="controller files (all shipped ones)")
    parser.add_argument("--points", type=int, default=100_000, help="of each function (100,000)")
    parser.add_argument("--compiler", default="gcc -std=c99 -O2", help="and its options")
    options = parser.parse_args(argv)
    for file in options.files or sorted((ROOT / "artifacts").glob("*/*.onnx")):
        if not file.name.endswith(".explain.onnx"):
            print(row(file, options.compiler), flush=True)
    rng, n = np.random.default_rng(0), options.points // 2
    print(f"exp  {worst(plain_exp, mp.exp, np.r_[rng.uniform(-1, 1, n), rng.uniform(-745, 709.7, n)]):.3f}")
    print(f"log  {worst(plain_log, mp.log, np.r_[rng.uniform(0.4, 2.5, n), np.exp(rng.uniform(-740, 709, n))]):.3f}")
    print(f"tanh {worst(plain_tanh, mp.tanh, np.r_[rng.uniform(-1.5, 1.5, n), rng.uniform(-21, 21, n)]):.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
