"""How exact exp, log, tanh and softmax of the plain C are, in units of the last place, against mpmath with 40 digits.

``python benchmarks/last_places.py [--points N] [--compiler "gcc -O2"]``: the functions as a controller's text has them,
compiled once; for each the largest error over N results (1,000,000), and where it is. Softmax is the statements that a
Softmax of a graph becomes, of rows of 5 and of 3 numbers, over three spreads; onnxruntime's own stands beside it: the
largest exponent is subtracted there, and a result far below 1 has the rounding of that difference in it. About a minute
a million results of a function on one core, two of a softmax.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from mpmath import mp, mpf
from numpy.typing import NDArray

from loopwright.pipeline.export.plain_code.c_text import printed_step
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.printed_functions import functions_in_c

DIGITS = 40  # of mpmath: a double has 17
CHUNK = 50_000  # results between two lines of progress
COMPARED = 100_000  # results of onnxruntime beside them
ROWS = (5, 3)  # numbers of a softmax: the shipped laws with one have five local models
SPREADS = (1.0, 20.0, 700.0)  # of the exponents of a softmax: to both sides of zero
Doubles = NDArray[np.float64]

MANY = """
void many_{name}(long n, const double *x, double *y)
{{
    for (long k = 0; k < n; ++k) {{
        y[k] = plain_{name}(x[k]);
    }}
}}
"""
ROWS_OF = """
void many_softmax(long n, const double *x, double *y)
{{
    for (long k = 0; k < n; ++k) {{
        softmax_step(x + {n} * k, y + {n} * k);
    }}
}}
"""


def compiled(folder: Path, text: str, compiler: str) -> ctypes.CDLL:
    """The shared library of a C text."""
    (folder / "many.c").write_text(text, encoding="utf-8")
    command = [*shlex.split(compiler), "-ffp-contract=off", "-shared", "-fPIC", "many.c", "-lm", "-o", "many.so"]
    subprocess.run(command, cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "many.so"))


def called(function: Callable[..., None], n: int, x: Doubles) -> Doubles:
    """Results of the C, in the places of ``x``; n calls."""
    y = np.empty_like(x)
    pointers = [v.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for v in (x, y)]
    function(ctypes.c_long(n), *pointers)
    return y


def softmax_graph(n: int) -> onnx.ModelProto:
    """A softmax (n,) in the form of a controller's graph."""
    ends = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.DOUBLE, [n]) for name in ("sp", "mv")]
    node = onnx.helper.make_node("Softmax", ["sp"], ["mv"], axis=-1)
    graph = onnx.helper.make_graph([node], "softmax", ends[:1], ends[1:])
    opset = [onnx.helper.make_opsetid("", 18)]
    return onnx.helper.make_model(graph, opset_imports=opset, ir_version=10)


def softmax_library(folder: Path, model: onnx.ModelProto, n: int, compiler: str) -> ctypes.CDLL:
    """A softmax (n,) by the statements that its graph becomes."""
    step = printed_step(lowered(model), "softmax")
    text = f"#include <math.h>\n{step.definitions}\n{ROWS_OF.format(n=n)}"
    return compiled(folder, text, compiler)


def units(found: float, true: mpf) -> float:
    """Error in units of the last place of the true result."""
    return float(abs(mpf(found) - true) / math.ulp(float(true)))


def worst(pairs: Iterator[tuple[float, float, mpf]], points: int, words: str) -> str:
    """The largest error of (argument, result, true result), with progress on standard error."""
    most, where, over, done, absolute = 0.0, math.nan, 0, 0, 0.0
    for x, found, true in pairs:
        error = units(found, true)
        over += error > 1.0
        absolute = max(absolute, float(abs(mpf(found) - true)))
        if error > most:
            most, where = error, x
        done += 1
        if done % CHUNK == 0:
            print(f"{words}: {done:,} of {points:,}, {most:.3f}", file=sys.stderr, flush=True)
    largest = f"{most:8.3f} ulp at {where!r}, {absolute:.1e} absolute"
    return f"{words:32s} {done:10,d} results  largest error {largest}, {over:,} above 1 ulp"


def main(argv: list[str]) -> int:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--points", type=int, default=1_000_000, help="results of each function (1,000,000)")
    parser.add_argument("--compiler", default="gcc -std=c99 -O2", help="and its options")
    parser.add_argument("--only", default="exp log tanh softmax", help="functions to measure")
    options = parser.parse_args(argv)
    rng, n = np.random.default_rng(0), options.points // 2
    points = {
        "exp": np.r_[rng.uniform(-1, 1, n), rng.uniform(-708, 709.7, n)],
        "log": np.r_[rng.uniform(0.4, 2.5, n), np.exp(rng.uniform(-708, 709, n))],
        "tanh": np.r_[rng.uniform(-1.5, 1.5, n), rng.uniform(-21, 21, n)],
    }
    mp.dps = DIGITS
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        names = [f"plain_{name}" for name in points]
        text = functions_in_c(names) + "".join(MANY.format(name=name) for name in points)
        library = compiled(folder, text, options.compiler)
        for name, x in points.items():
            if name in options.only:
                y, exact = called(library[f"many_{name}"], len(x), x), getattr(mp, name)
                rows = ((a, b, exact(mpf(a))) for a, b in zip(x.tolist(), y.tolist(), strict=True))
                print(worst(rows, len(x), name), flush=True)
    for size in ROWS if "softmax" in options.only else ():
        with tempfile.TemporaryDirectory() as made:
            model = softmax_graph(size)
            library = softmax_library(Path(made), model, size, options.compiler)
            session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
            for spread in SPREADS:
                count = options.points // size
                x = rng.uniform(-spread, spread, (count, size))
                y = called(library.many_softmax, count, x)
                words = f"softmax of {size}, +-{spread:g}"
                print(worst(_of_softmax(x, y), x.size, words), flush=True)
                few = x[: min(count, COMPARED // size)]
                theirs = np.array([session.run(None, {"sp": row})[0] for row in few])
                print(worst(_of_softmax(few, theirs), few.size, f"  the same in onnxruntime {few.size:,}"), flush=True)
    return 0


def _of_softmax(x: Doubles, y: Doubles) -> Iterator[tuple[float, float, mpf]]:
    """Each entry with the true one, where that is a normal double."""
    for given, found in zip(x.tolist(), y.tolist(), strict=True):
        grown = [mp.exp(mpf(v)) for v in given]
        total = mp.fsum(grown)
        for v, result, part in zip(given, found, grown, strict=True):
            if part / total > 1e-300:
                yield v - max(given), result, part / total


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
