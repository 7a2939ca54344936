"""The pipeline's stages: each reads, calls and writes; where they write stands here."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

WORK = Path("work")
ARTIFACTS = Path("artifacts")


def record_folder(case: str, record: str) -> Path:
    """Folder of a record: seed<k>.parquet."""
    return WORK / case / "records" / record


def model_folder(case: str, model: str) -> Path:
    """Folder of a model set: seed<k>/<part>.npz."""
    return WORK / case / "models" / model


def controller_folder(case: str, law: str) -> Path:
    """Folder of a controller's files before validation: seed<k>.onnx."""
    return WORK / case / "controllers" / law


def validation_folder(case: str, law: str) -> Path:
    """Folder of a controller's validation."""
    return WORK / case / "validation" / law


def write_json(path: Path, content: Any) -> None:
    """Write JSON through a temporary file, so that no half-written one stays."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".draft")
    draft.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(draft, path)
