"""The pipeline's stages: each reads, calls and writes; where they write stands here."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError

WORK = Path("work")
ARTIFACTS = Path("artifacts")
TIMING = Path("timing")  # durations; apart from WORK, because no stage may depend on them
BASE = "base"  # the form of a controller that is shipped; the others are its variants


def record_folder(case: str, record: str) -> Path:
    """Folder of a record: seed<k>.parquet."""
    return WORK / case / "records" / record


def model_folder(case: str, model: str) -> Path:
    """Folder of a model set: seed<k>/<part>.npz."""
    return WORK / case / "models" / model


def design_folder(case: str, law: str) -> Path:
    """Folder of a controller's files before validation, one folder a form inside."""
    return WORK / case / "controllers" / law


def controller_file(case: str, law: str, form: str, seed: int) -> Path:
    """The exported file of one form (``base`` or a variant's name) and data seed."""
    return design_folder(case, law) / re.sub(r"[^\w.=]+", "_", form) / f"seed{seed}.onnx"


def analysis_file(case: str, law: str, form: str, seed: int) -> Path:
    """The arrays of a form's analysis, beside its exported file; there only where the law has some."""
    return controller_file(case, law, form, seed).with_suffix(".analysis.npz")


def validation_folder(case: str, law: str) -> Path:
    """Folder of a controller's validation."""
    return WORK / case / "validation" / law


def step_time_file(case: str, law: str) -> Path:
    """The time of one step of a shipped controller [us], as validate measured it: {"p50": ..., "p99": ...}.

    An output of validate that is no dependency of any stage: a rerun gives other microseconds,
    and these must not mark the report as changed. The report shows what it finds here.
    """
    return TIMING / case / f"{law}-step.json"


def receipt_file(case: str) -> Path:
    """What a report leaves for the overview to wait for, in one folder because DVC cannot list a file a case."""
    return WORK / "reports" / f"{case}.json"


def write_json(path: Path, content: Any) -> None:
    """Write JSON through a temporary file, so that no half-written one stays."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".draft")
    draft.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(draft, path)


def read_json(path: Path) -> Any:
    """What ``write_json`` wrote; PipelineError where an earlier stage has not run."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise PipelineError(f"{path} cannot be read ({error}); run the stages before this one: dvc repro") from None
