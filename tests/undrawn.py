"""For tests that look at no picture: none is drawn, which takes longer than what they are about."""

from __future__ import annotations

import pytest


def draw_nothing(patch: pytest.MonkeyPatch) -> None:
    """Build every picture, but give its panels no places and write an empty file."""
    for module in ("pipeline.pictures.png", "pipeline.report.screening"):
        patch.setattr(f"{module}.png", lambda canvas: b"")
    patch.setattr("pipeline.pictures.drawing.lay_out", lambda canvas: None)
