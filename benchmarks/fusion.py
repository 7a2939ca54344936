"""What affine fusion makes of each controller's graph: operators, time of a step, difference, seconds of the pass.

``python benchmarks/fusion.py [FILE.onnx ...]``; without files, every controller in artifacts/. It prints a row a
controller. A file that was fused when it was exported gains little here: to see what fusion is worth, give it files
that were exported without.

Times: p50 of a hot step of the session alone, bound buffers, one thread, both graphs in turn, the quietest of
``--rounds`` rounds. Difference: the largest over ``--steps`` steps of random inputs within their ranges, both graphs
given the same state, relative to the entry's range over those steps. float32: what onnxruntime's own optimized graph,
written to a file and read again, holds of float32 numbers and of factors ``alpha`` other than 1. Ends with status 1
where a graph becomes slower by more than ``--noise``, differs by more than 1e-9 or holds float32, or where the median
of the times' ratios is above ``--median``.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray

from pipeline.export.fusion import fused
from serving.manifest import MANIFEST_KEY, Manifest

Array = NDArray[np.float64]
ALLOWED = 1e-9
HOT = 200  # steps of a round


def session(model: bytes, optimized: Path | None = None) -> Any:
    """As serving.controller makes it; its optimized graph goes to a file."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.enable_mem_reuse = False
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4
    if optimized is not None:
        options.optimized_model_filepath = str(optimized)
    return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def narrow(optimized: onnx.ModelProto) -> list[str]:
    """Names of what computes in float32: constants, and products whose factor ``alpha`` is not 1."""
    found = [t.name for t in optimized.graph.initializer if t.data_type == onnx.TensorProto.FLOAT]
    for node in optimized.graph.node:
        if any(a.name == "alpha" and a.f != 1 for a in node.attribute):
            found.append(f"{node.op_type} {node.name}")
        if any(a.name == "to" and a.i == onnx.TensorProto.FLOAT for a in node.attribute):
            found.append(node.name)
    return found


@dataclass
class Bound:
    """A session with bound buffers."""

    session: Any
    inputs: dict[str, Array]

    def __post_init__(self) -> None:
        self.binding = self.session.io_binding()
        self.outputs = {o.name: np.zeros(o.shape) for o in self.session.get_outputs()}
        for name, a in self.inputs.items():
            self.binding.bind_input(name, "cpu", 0, np.float64, list(a.shape), a.ctypes.data)
        for name, a in self.outputs.items():
            self.binding.bind_output(name, "cpu", 0, np.float64, list(a.shape), a.ctypes.data)

    def p50(self) -> float:
        """Median of a round [us]."""
        took = np.empty(HOT)
        for k in range(HOT):
            begun = time.perf_counter_ns()
            self.session.run_with_iobinding(self.binding)
            took[k] = time.perf_counter_ns() - begun
        return float(np.median(took)) / 1e3


def drawn(manifest: Manifest, steps: int) -> Iterator[dict[str, Array]]:
    """Inputs but the state, uniform over their ranges."""
    rng = np.random.default_rng(0)
    for _ in range(steps):
        yield {
            name: np.array([rng.uniform(s.low, s.high) for s in manifest.signals(name)])
            for name in manifest.inputs
            if name != "state"
        }


def difference(before: Any, after: Any, manifest: Manifest, steps: int) -> tuple[float, dict[str, Array]]:
    """The largest difference of the outputs, relative to each entry's range, and the last inputs."""
    names, state, pairs, feed = [o.name for o in before.get_outputs()], np.zeros(manifest.n_state), [], {}
    for inputs in drawn(manifest, steps):
        feed = {**inputs, "state": state} if "state" in manifest.inputs else inputs
        one, two = before.run(names, feed), after.run(names, feed)
        pairs.append((np.concatenate(one), np.concatenate(two)))
        state = one[names.index("state_next")] if "state_next" in names else state
    a, b = (np.array(side) for side in zip(*pairs, strict=True))
    span = np.maximum(np.ptp(a, axis=0), 1e-3 * np.abs(a).max(axis=0))
    gap = np.abs(a - b).max(axis=0)
    return float((gap / np.where(gap > 0, np.maximum(span, np.finfo(float).tiny), 1.0)).max()), feed


def main() -> int:
    """Print the table; 1 if a figure is not what it must be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--steps", type=int, default=1_000)
    parser.add_argument("--noise", type=float, default=0.05, help="of a ratio of times, on a shared machine (0.05)")
    parser.add_argument("--median", type=float, default=1.0, help="of the ratios, at most (1)")
    options = parser.parse_args()
    files = options.files or sorted(Path("artifacts").glob("*/*.onnx"))
    print(
        f"affine fusion of {len(files)} graphs, about {0.06 * options.rounds * len(files) + 1.5 * len(files):.0f} s",
        flush=True,
    )
    head = f"{'p50 [us]':<46}{'nodes':>6}{'after':>6}{'p50':>9}{'after':>8}{'ratio':>7}"
    print(f"{head}{'differs':>9}{'pass s':>8}  float32")
    ratios, good = [], True
    with tempfile.TemporaryDirectory() as folder:
        optimized = Path(folder) / "optimized.onnx"
        for file in files:
            model = onnx.load(file)
            text = next(p.value for p in model.metadata_props if p.key == MANIFEST_KEY)
            del model.metadata_props[:]
            begun = time.perf_counter()
            made = fused(model)
            seconds = time.perf_counter() - begun
            before, after = session(model.SerializeToString()), session(made.SerializeToString(), optimized)
            gap, feed = difference(before, after, Manifest.from_json(text), options.steps)
            sides = [Bound(s, {n: v.copy() for n, v in feed.items()}) for s in (before, after)]
            best = np.min([[side.p50() for side in sides] for _ in range(options.rounds)], axis=0)
            held = narrow(onnx.load(optimized))
            ratios.append(best[1] / best[0])
            good = good and not held and gap <= ALLOWED and ratios[-1] <= 1 + options.noise
            label = f"{file.parent.name}/{file.stem}"
            row = f"{label:<46}{len(model.graph.node):>6}{len(made.graph.node):>6}{best[0]:>9.1f}{best[1]:>8.1f}"
            print(f"{row}{ratios[-1]:>7.2f}{gap:>9.1e}{seconds:>8.2f}  {', '.join(held) or 'none'}", flush=True)
    median = float(np.median(ratios))
    print(f"median of the ratios {median:.3f}, largest {max(ratios):.3f}")
    return 0 if good and median <= options.median else 1


if __name__ == "__main__":
    sys.exit(main())
