"""The controller files that this project ships; a clone may hold those of a user's own plants beside them."""

from __future__ import annotations

from pathlib import Path

from loopwright.pipeline.cases import CASES

ARTIFACTS = Path(__file__).resolve().parents[1] / "artifacts"
SHIPPED = sorted(file for file in ARTIFACTS.glob("*/*.onnx") if file.parent.name in CASES)
