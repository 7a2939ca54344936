"""What affine fusion and plainly written laws make of the controllers: operators, time of a step, float32.

``python benchmarks/fusion.py`` compares every controller in artifacts/ with the file of the same name at an earlier
commit, ``--before``: by default the last one whose laws were matrices made by hand, and whose graphs were exported as
they stood. ``python benchmarks/fusion.py FILE.onnx ...`` fuses files that were exported without, and compares them with
what comes out: also the largest difference over ``--steps`` steps of random inputs within their ranges, both graphs
given the same state, relative to the entry's range over those steps, and the seconds of the pass.

Times: p50 of a hot step of the session alone, bound buffers, one thread, both graphs in turn, the quietest of
``--rounds`` rounds. float32: what onnxruntime's own optimized graph, written to a file and read again, holds of float32
numbers and of factors ``alpha`` other than 1. Ends with status 1 where a graph becomes slower by more than ``--noise``,
differs by more than 1e-9 or holds float32, or where the median of the times' ratios is above ``--median``.
"""

from __future__ import annotations

import argparse
import subprocess
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

from loopwright.pipeline.export.fusion import fused
from loopwright.serving.manifest import MANIFEST_KEY, Manifest

Array = NDArray[np.float64]
ALLOWED = 1e-9
HOT = 200  # steps of a round
BY_HAND = "8fdd8e22cfe429fbf278fe536fceb5618d9e2b89"


def session(model: bytes, optimized: Path | None = None) -> Any:
    """As loopwright.serving.controller makes it; its optimized graph goes to a file."""
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
    """Inputs but the state, uniform over their ranges; `operate` by default, and all readings fresh."""
    rng = np.random.default_rng(0)
    for _ in range(steps):
        yield {
            name: np.array([rng.uniform(s.low, s.high) for s in manifest.signals(name)] or manifest.usual(name))
            for name in manifest.inputs
            if name != "state"
        }


def difference(before: Any, after: Any, manifest: Manifest, steps: int) -> float:
    """The largest difference of the outputs, relative to each entry's range."""
    names, state, pairs = [o.name for o in before.get_outputs()], np.zeros(manifest.n_state), []
    for inputs in drawn(manifest, steps):
        feed = {**inputs, "state": state} if "state" in manifest.inputs else inputs
        one, two = before.run(names, feed), after.run(names, feed)
        pairs.append((np.concatenate(one), np.concatenate(two)))
        state = one[names.index("state_next")] if "state_next" in names else state
    a, b = (np.array(side) for side in zip(*pairs, strict=True))
    span = np.maximum(np.ptp(a, axis=0), 1e-3 * np.abs(a).max(axis=0))
    gap = np.abs(a - b).max(axis=0)
    return float((gap / np.where(gap > 0, np.maximum(span, np.finfo(float).tiny), 1.0)).max())


def earlier(file: Path, commit: str) -> onnx.ModelProto | None:
    """The file as it was at a commit; None where there was none."""
    shown = subprocess.run(["git", "show", f"{commit}:{file.as_posix()}"], capture_output=True)
    return onnx.load_from_string(shown.stdout) if shown.returncode == 0 else None


def manifest_of(model: onnx.ModelProto) -> Manifest:
    """Its manifest, which the graph keeps no more: a session of one graph is as large as that of the other."""
    text = next(p.value for p in model.metadata_props if p.key == MANIFEST_KEY)
    del model.metadata_props[:]
    return Manifest.from_json(text)


def stepped(session: Any, feed: dict[str, Array]) -> dict[str, Array]:
    """The inputs with the state after three steps, so that there is a past."""
    names = [o.name for o in session.get_outputs()]
    for _ in range(3 if "state_next" in names else 0):
        feed = {**feed, "state": session.run(names, feed)[names.index("state_next")]}
    return feed


@dataclass
class Row:
    """One controller's figures; ``gap`` and ``seconds`` only where the second graph is the first one, fused."""

    label: str
    nodes: tuple[int, int]
    times: tuple[float, float]
    held: list[str]
    gap: float | None = None
    seconds: float | None = None

    @property
    def ratio(self) -> float:
        """Of the times."""
        return self.times[1] / self.times[0]

    def good(self, noise: float) -> bool:
        """Whether no figure is one that it must not be."""
        return not self.held and (self.gap or 0.0) <= ALLOWED and self.ratio <= 1 + noise

    def __str__(self) -> str:
        figures = f"{self.nodes[0]:>6}{self.nodes[1]:>6}{self.times[0]:>9.1f}{self.times[1]:>8.1f}{self.ratio:>7.2f}"
        more = "" if self.gap is None else f"{self.gap:>9.1e}{self.seconds:>8.2f}"
        return f"{self.label:<46}{figures}{more}  {', '.join(self.held) or 'none'}"


def compared(file: Path, options: argparse.Namespace, folder: Path) -> Row | None:
    """A controller beside itself at an earlier commit, or of given files beside what fusion makes of it."""
    after = onnx.load(file)
    manifest = manifest_of(after)
    before, gap, seconds = after, None, None
    if options.files:
        begun = time.perf_counter()
        after = fused(before)
        seconds = time.perf_counter() - begun
    else:
        found = earlier(file, options.before)
        if found is None or manifest_of(found).sizes() != manifest.sizes():
            return None
        before = found
    sessions = [session(before.SerializeToString()), session(after.SerializeToString(), folder / "optimized.onnx")]
    feeds = [{**next(drawn(manifest, 1))} for _ in sessions]
    if "state" in manifest.inputs:
        feeds = [
            stepped(s, {**feed, "state": np.zeros(manifest.n_state)}) for s, feed in zip(sessions, feeds, strict=True)
        ]
    if options.files:
        gap = difference(*sessions, manifest, options.steps)
    sides = [Bound(s, feed) for s, feed in zip(sessions, feeds, strict=True)]
    best = np.min([[side.p50() for side in sides] for _ in range(options.rounds)], axis=0)
    nodes = (len(before.graph.node), len(after.graph.node))
    held = narrow(onnx.load(folder / "optimized.onnx"))
    return Row(f"{file.parent.name}/{file.stem}", nodes, (float(best[0]), float(best[1])), held, gap, seconds)


def main() -> int:
    """Print the table; 1 if a figure is not what it must be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    parser.add_argument(
        "--before", default=BY_HAND, metavar="COMMIT", help=f"the commit to compare with ({BY_HAND[:7]})"
    )
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--steps", type=int, default=1_000)
    parser.add_argument("--noise", type=float, default=0.05, help="of a ratio of times, on a shared machine (0.05)")
    parser.add_argument("--median", type=float, default=1.0, help="of the ratios, at most (1)")
    options = parser.parse_args()
    files = options.files or sorted(Path("artifacts").glob("*/*.onnx"))
    print(f"{len(files)} graphs, about {0.06 * options.rounds * len(files) + 1.5 * len(files):.0f} s", flush=True)
    head = f"{'p50 [us]':<46}{'nodes':>6}{'after':>6}{'p50':>9}{'after':>8}{'ratio':>7}"
    print(f"{head}{'differs':>9}{'pass s':>8}  float32" if options.files else f"{head}  float32")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for file in files:
            row = compared(file, options, Path(folder))
            if row is None:
                print(f"{file.parent.name}/{file.stem}: {options.before[:7]} has no such file with as large a state")
                continue
            rows.append(row)
            print(row, flush=True)
    if not rows:
        print(f"nothing to compare: this repository has no commit {options.before} with artifacts")
        return 1
    ratios = [row.ratio for row in rows]
    median = float(np.median(ratios))
    print(f"median of the ratios {median:.3f}, largest {max(ratios):.3f}")
    return 0 if all(row.good(options.noise) for row in rows) and median <= options.median else 1


if __name__ == "__main__":
    sys.exit(main())
