"""What a worker loads before its first task: ``dask worker ADDRESS --nthreads 1 --preload pipeline.engine.preload``.

torch, casadi, pandas and the like take a stage longer to import than most take to work. All sources are imported at
once, so that a worker's fingerprint is that of what it runs.
"""

from __future__ import annotations

import contextlib
import importlib
import pkgutil
import signal
import threading
from typing import TYPE_CHECKING

from pipeline.engine.fingerprint import fingerprint
from pipeline.engine.spoken import listen

if TYPE_CHECKING:
    from distributed import Worker

# What stages import late and for long; one that is missing or broken costs time alone.
LIBRARIES = (
    *("pandas", "pyarrow.parquet", "casadi", "jinja2", "matplotlib.figure", "torch._dynamo", "torch.export._trace"),
    *("torch.onnx._internal.exporter._compat", "sklearn.linear_model", "onnx", "onnx_ir", "onnxruntime"),
    *("onnxscript.optimizer", "onnxscript.function_libs.torch_lib.ops"),
)
PROFILING = ("profile", "profile-cycle")
# The ends of the pipeline that no worker runs.
APART = ("pipeline.__main__", "pipeline.commands", "pipeline.tracking")


def dask_setup(worker: Worker) -> None:
    """Called by Dask as the worker starts."""
    unwatched(worker)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which ends its workers in order
    listen()
    load()


def unwatched(worker: Worker) -> None:
    """End Dask's sampling profiler of a worker; of one that was started without this module, a task does it.

    The profiler looks into the frames of running tasks. torch.export then now and then loses track of a tensor and
    fails: 4 of 40 first exports of a process did, and none of 120 without it.
    """
    for name in PROFILING:
        callback = worker.periodic_callbacks.pop(name, None)
        if callback is not None:
            worker.loop.add_callback(callback.stop)


def load() -> None:
    """Import the libraries and all sources that a task may need."""
    fingerprint()
    for name in LIBRARIES:
        with contextlib.suppress(Exception):
            importlib.import_module(name)
    import pipeline

    for module in pkgutil.walk_packages(pipeline.__path__, "pipeline.", onerror=lambda _: None):
        if not module.name.startswith(APART):
            # A broken source is the error of the task that needs it: a worker that did not start would be waited for.
            with contextlib.suppress(Exception):
                importlib.import_module(module.name)
