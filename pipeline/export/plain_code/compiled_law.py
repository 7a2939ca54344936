"""A controller's plain C, compiled on this machine and stepped from Python: rows as ``Controller.compute`` gives them.

The compiled C takes onnxruntime's place in simulations alone, and only where each step of the conformance kit agrees.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import platform
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from loopwright.pipeline.errors import ExportError, HostError, PipelineError
from loopwright.pipeline.export.plain_code.c_compiler import CCompiler
from loopwright.pipeline.export.plain_code.c_files import arguments_of, c_step
from loopwright.pipeline.export.plain_code.c_header import OUTPUTS
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.files import digest, kept_folder, write_bytes
from loopwright.serving.conformance.kit import KIT_TOLERANCE, KitDifference, entry_scale
from loopwright.serving.conformance.steps import answered
from loopwright.serving.controller import Controller, runtime_version
from loopwright.serving.manifest import INPUTS
from loopwright.serving.vectorized_controller import ComputeRows

Array = NDArray[np.float64]

LAW = "law"  # the name of the step in C
# A predictive law compiles with -O2 twice as long as with -O1, and less than half as long as with -O3; its loops run
# 104, 109 and 114 times a second, those of other laws differ no more (benchmarks/compiled_loops.py --levels 1 2 3).
LEVEL = "-O2"
FLAGS = ("-std=c99", "-ffp-contract=off", "-fPIC", "-shared")
LINKED = ("-lm",)
KEPT = "compiled-laws"  # the folder of the libraries
MOST_KEPT = 64  # libraries, of up to .4 MB each; the ones that were used last stay
_DIGEST_BYTES = 32  # of the SHA-256 before a kept library
_DOUBLES = ctypes.POINTER(ctypes.c_double)

LAW_BY = ("auto", "c", "onnx")


@dataclass(frozen=True)
class CompiledLaw:
    """The compiled plain C of one controller file, which goes to a worker with its bytes.

    ``compute(given (n, n_in)) -> (n, n_out)``: rows as ``Controller.compute`` takes and gives them.
    """

    library: bytes
    machine: str  # that it was compiled for
    compiler: str  # its version
    n_out: int  # numbers of a row that it gives
    worst: float = np.inf  # largest difference from onnxruntime over the kit, a share of an entry's scale

    def compute(self, given: Array) -> Array:
        """The step of each row; one that is not finite gives nan. HostError where this machine is another one."""
        step_rows = _loaded(self.library, self.machine)
        fit = np.all(np.isfinite(given), axis=1)
        rows = np.ascontiguousarray(given[fit], dtype=np.float64)
        made = np.zeros((len(rows), self.n_out))
        step_rows(len(rows), rows.ctypes.data_as(_DOUBLES), made.ctypes.data_as(_DOUBLES))
        if len(rows) == len(given):
            return made
        taken = np.full((len(given), self.n_out), np.nan)
        taken[fit] = made
        return taken


@dataclass(frozen=True)
class LawStepping:
    """Host of a controller's steps in a simulation: ``compute``, None: the session; ``words`` name it for a person."""

    compute: ComputeRows | None
    words: str


def law_stepping(controller: Controller, law_by: str) -> LawStepping:
    """``law_by``: ``c`` the compiled plain C, ``onnx`` onnxruntime, ``auto`` the C where it can be had and agrees.

    HostError where ``c`` is asked for and cannot be had.
    """
    runtime = f"onnxruntime {runtime_version()}"
    if law_by == "onnx":
        return LawStepping(None, runtime)
    try:
        law = compiled_law(controller)
    except PipelineError as error:
        if law_by == "c":
            raise HostError(f"{error}; --law-by onnx needs no compiler") from error
        return LawStepping(None, f"{runtime}, not plain C: {error}")
    words = f"plain C, {law.compiler}, {LEVEL}; at most {law.worst:.1e} of an entry's scale from {runtime}"
    return LawStepping(law.compute, words)


def compiled_law(controller: Controller, level: str = LEVEL) -> CompiledLaw:
    """The plain C of a controller file, compiled once per file, text, compiler and options, and then kept.

    ``level`` is the compiler's option that says how far it optimizes.

    Raises
    ------
    HostError
        No compiler is here, it cannot compile the C, or this machine cannot load the library.
    ExportError
        The graph has an operator without plain statements, or a step of the conformance kit parts from onnxruntime.
    """
    program = lowered(onnx.load(controller.path))
    texts = c_step(controller, program, LAW)
    texts["rows.c"] = _rows_text(controller, arguments_of(program))
    compiler = CCompiler.here()
    version, machine = compiler.version(), _machine()
    key = digest([controller.sha256, texts, version, compiler.words, level, FLAGS, LINKED, machine])
    library = _kept(key)
    if library is None:
        library = _compiled(compiler, level, texts)
        _keep(key, library)
    law = CompiledLaw(library, machine, version, controller.width_out)
    found = kit_difference(controller, law.compute)
    if not found.passed:
        raise ExportError(f"the plain C of {controller.path.name} parts from onnxruntime by {found.text()}")
    return CompiledLaw(library, machine, version, controller.width_out, found.largest)


def kit_difference(controller: Controller, compute: ComputeRows) -> KitDifference:
    """How far ``compute`` is from the controller's session, over each step of the conformance kit from its state.

    A step that is refused for an input must have no number; what the law may not write is compared, too.
    """
    answers, places = answered(controller), controller.places
    scale, given = entry_scale(controller, answers), np.zeros((len(answers), controller.width))
    for row, answer in zip(given, answers, strict=True):
        for name in controller.manifest.inputs:
            row[places[name]] = (answer.given.inputs | {"state": answer.state})[name]
    ours, theirs = controller.compute(given), compute(given)
    both = np.isnan(ours) & np.isnan(theirs)
    ours, theirs = (np.where(both, 0.0, rows) for rows in (ours, theirs))
    found = KitDifference(KIT_TOLERANCE)
    for k, answer in enumerate(answers):
        vectors = [(n, ours[k, places[n]], theirs[k, places[n]], scale[n]) for n in OUTPUTS]
        found.take(f"step {k} ({answer.given.part})", vectors)
    return found


# --------------------------------------------------------------------------------------------------------- the library
def _rows_text(controller: Controller, arguments: list[str]) -> str:
    """``rows.c``: steps of ``n`` rows, whose vectors lie where the controller's do."""
    places = controller.places
    call = [f"{'given' if n in INPUTS else 'taken'} + {places[n].start}" for n in arguments]
    return f"""#include "{LAW}.h"

#if defined(_WIN32)
__declspec(dllexport)
#endif
void {LAW}_rows(int n, const double *given, double *taken)
{{
    for (int k = 0; k < n; ++k) {{
        {LAW}_step({", ".join(call)});
        given += {controller.width};
        taken += {controller.width_out};
    }}
}}
"""


def _machine() -> str:
    return f"{sys.platform} {platform.machine()}"


def _compiled(compiler: CCompiler, level: str, texts: Mapping[str, str]) -> bytes:
    try:
        with tempfile.TemporaryDirectory(prefix="loopwright-law-") as name:
            folder = Path(name)
            for file, text in texts.items():
                (folder / file).write_text(text, encoding="utf-8")
            sources = [file for file in texts if file.endswith(".c")]
            compiler.compile([level, *FLAGS, *sources, "-o", LAW, *LINKED], "the law", folder)
            return (folder / LAW).read_bytes()
    except OSError as error:
        raise HostError(f"the law's C cannot be written and compiled: {error.strerror or error}") from error


def _kept(key: str) -> bytes | None:
    """The library that was kept; None where there is none, or it is not whole."""
    with contextlib.suppress(OSError, RuntimeError):  # RuntimeError: this user has no home
        path = kept_folder(KEPT) / key
        content = path.read_bytes()
        library = content[_DIGEST_BYTES:]
        if hashlib.sha256(library).digest() == content[:_DIGEST_BYTES]:
            with contextlib.suppress(OSError):  # a folder that is only read keeps its times
                path.touch()
            return library
    return None


def _keep(key: str, library: bytes) -> None:
    """Keep a library for the next time, and let the oldest go; where nothing can be written, it is compiled again."""
    with contextlib.suppress(OSError, RuntimeError):
        folder = kept_folder(KEPT)
        write_bytes(folder / key, hashlib.sha256(library).digest() + library)
        newest_first = sorted(folder.glob("[0-9a-f]*"), key=lambda path: path.stat().st_mtime, reverse=True)
        for old in newest_first[MOST_KEPT:]:
            old.unlink()


@lru_cache(maxsize=MOST_KEPT)  # a worker unpickles the same bytes with each piece, and a library is never unloaded
def _loaded(library: bytes, machine: str) -> Callable[..., Any]:
    if machine != _machine():
        raise HostError(
            f"the law was compiled for {machine}, and this machine is {_machine()}; --law-by onnx runs on both"
        )
    try:
        with tempfile.TemporaryDirectory(prefix="loopwright-law-", ignore_cleanup_errors=True) as name:
            path = Path(name) / f"{LAW}{hashlib.sha256(library).hexdigest()[:12]}.so"
            path.write_bytes(library)
            found: Callable[..., Any] = getattr(ctypes.CDLL(str(path)), f"{LAW}_rows")
    except (OSError, AttributeError) as error:
        raise HostError(f"the compiled law cannot be loaded: {error}; --law-by onnx needs none") from error
    found.argtypes, found.restype = (ctypes.c_int, _DOUBLES, _DOUBLES), None  # type: ignore[attr-defined]
    return found
