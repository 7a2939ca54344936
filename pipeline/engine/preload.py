"""Libraries that a worker loads while it waits: ``dask worker ADDRESS --preload loopwright.pipeline.engine.preload``.

torch, casadi, pandas and the like take a stage longer to import than most take to work. A worker begins with them as it
starts and goes on whenever it is idle, so that a task waits for one of them at most. A worker of this machine's own
cluster, which is told in STAGES what comes, imports no more than that needs.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import pkgutil
import signal
import threading
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from loopwright.pipeline.engine.cluster import STAGES, unwatched
from loopwright.pipeline.engine.fingerprint import fingerprint
from loopwright.pipeline.engine.output import listen

if TYPE_CHECKING:
    from distributed import Worker

# What stages import late and for long, the longest last; one that is missing or broken costs time alone.
LIBRARIES = (
    *("onnxruntime", "casadi", "scipy.signal", "jinja2", "pandas", "pyarrow.parquet", "matplotlib.figure"),
    *("sklearn.linear_model", "onnx", "onnx_ir", "torch", "torch._dynamo", "torch.export._trace"),
    *("torch.onnx._internal.exporter._compat", "onnxscript.optimizer", "onnxscript.function_libs.torch_lib.ops"),
)
# Of these, what stages of some kinds import. Those of a kind that is not named may need all; those without any run on
# no worker. Models need nothing of the exporter, and trials none of torch: each takes half of the time.
MODELS = ("casadi", "pandas", "pyarrow.parquet", "matplotlib.figure", "torch")
TRIALS = ("onnxruntime", "casadi", "pyarrow.parquet", "onnx")
OF_KIND = {
    "excite": ("casadi", "pandas", "pyarrow.parquet"),
    "fit": MODELS,
    "design": (*TRIALS, *LIBRARIES[LIBRARIES.index("onnx_ir") :]),
    "validate": TRIALS,
    **dict.fromkeys(("code", "screen", "report", "overview", "publish"), ()),
}
IDLE_S = 0.05  # until a worker that has a task looks again whether it may go on importing
# The ends of the pipeline that no worker runs.
APART = tuple(
    f"loopwright.pipeline.{name}"
    for name in ("__main__", "commands", "tracking", "stages.publish", "playground", "hosts", "simulation.opcua_server")
)


def dask_setup(worker: Worker) -> None:
    """Called by Dask as the worker starts."""
    unwatched(worker)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which ends its workers in order
    listen()
    fingerprint()  # of the sources as they are now
    steps, tasks = loading(), worker.executors["default"]

    def go_on() -> None:
        """The next import where nothing else is to be done; in the tasks' thread: two might wait for each other's."""
        if worker.state.executing or worker.state.ready or worker.state.long_running:
            worker.loop.call_later(IDLE_S, go_on)
        else:
            with contextlib.suppress(RuntimeError):  # the worker is ending
                tasks.submit(one)

    def one() -> None:
        gc.disable()  # what is imported stays: looking for garbage in it takes a sixth of the time
        try:
            more = next(steps, None) is not None
        finally:
            gc.enable()
        if more:
            worker.loop.add_callback(go_on)
        else:
            gc.freeze()  # nor need tasks look through it

    worker.loop.add_callback(go_on)


def load() -> None:
    """All of it at once, for whoever measures what tasks take afterwards: ``Client.run(load)``."""
    for _ in loading():
        pass


def loading() -> Iterator[str]:
    """Import the libraries and all sources that a task may need, a step each; their names."""
    kinds = [kind for kind in os.environ.get(STAGES, "").split(",") if kind]
    for name in _needed(kinds) if kinds and OF_KIND.keys() >= set(kinds) else _everything():
        # A broken source is the error of the task that needs it: a worker that did not start would be waited for.
        with contextlib.suppress(Exception):
            importlib.import_module(name)
        yield name


def _needed(kinds: Sequence[str]) -> Iterator[str]:
    """The libraries of some kinds of stages, in the usual order, and the stages themselves."""
    needed = {name for kind in kinds for name in OF_KIND[kind]}
    yield from (name for name in LIBRARIES if name in needed)
    yield from (f"loopwright.pipeline.stages.{kind}" for kind in kinds if OF_KIND[kind])


def _everything() -> Iterator[str]:
    yield from LIBRARIES
    from loopwright import pipeline

    for module in pkgutil.walk_packages(pipeline.__path__, f"{pipeline.__name__}.", onerror=lambda _: None):
        if not module.name.startswith(APART):
            yield module.name
