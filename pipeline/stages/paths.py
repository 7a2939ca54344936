"""Where the stages read and write: one function for each kind of folder or file."""

from __future__ import annotations

import re
from pathlib import Path

WORK = Path("work")
DATA = Path("data")  # a plant's report of `loopwright new`, and the record of its simulator
ARTIFACTS = Path("artifacts")
TIMING = Path("timing")  # durations; apart from WORK, because no stage may depend on them


def record_folder(case: str, record: str) -> Path:
    """Folder of a record: seed<k>.parquet."""
    return WORK / case / "records" / record


def model_folder(case: str, model: str) -> Path:
    """Folder of a model set: seed<k>/<part>.npz."""
    return WORK / case / "models" / model


def design_folder(case: str, name: str) -> Path:
    """Folder of a controller's files before validation, one folder a form inside."""
    return WORK / case / "controllers" / name


def controller_file(case: str, name: str, form: str, seed: int) -> Path:
    """The exported file of one form (``base`` or a variant's name) and data seed."""
    return design_folder(case, name) / re.sub(r"[^\w.=]+", "_", form) / f"seed{seed}.onnx"


def old_loop_file(case: str, name: str, seed: int) -> Path:
    """The loop that an own plant was run by before, beside a controller's own files, which its tests compare it with.

    There only where the record shows such a loop.
    """
    return controller_file(case, name, "before", seed)


def calm_file(case: str, name: str, seed: int) -> Path:
    """The law with calmer numbers, beside an own plant's controller: shipped where that one does not hold."""
    return controller_file(case, name, "calm", seed)


def analysis_file(case: str, name: str, form: str, seed: int) -> Path:
    """The arrays of a form's analysis, beside its exported file; there only where the law has some."""
    return controller_file(case, name, form, seed).with_suffix(".analysis.npz")


def validation_folder(case: str, name: str) -> Path:
    """Folder of a controller's validation."""
    return WORK / case / "validation" / name


def step_time_file(case: str, name: str) -> Path:
    """The time of one step of a shipped controller [us], as validate measured it: {"p50": ..., "p99": ...}.

    An output of validate that is no dependency of any stage: a rerun gives other microseconds,
    and these must not mark the report as changed. The report shows what it finds here.
    """
    return TIMING / case / f"{name}-step.json"


def receipt_file(case: str) -> Path:
    """Receipt of a report, which the overview waits for; in one folder because DVC cannot list a file a case."""
    return WORK / "reports" / f"{case}.json"
