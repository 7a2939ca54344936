"""For tests that look at no picture: none is drawn, which takes longer than what they are about."""

from __future__ import annotations

import pytest
from matplotlib.figure import Figure

SCREENING = ("trends", "details", "readings", "inputs", "verdict")


def draw_nothing(patch: pytest.MonkeyPatch) -> None:
    """Build every picture of a report, but give its panels no places and write an empty file.

    Build none of a screening: its page is half of what ``loopwright new`` computes: up to 90 panels.
    """
    for name in SCREENING:
        patch.setattr(f"loopwright.pipeline.report.screening.{name}", lambda found: Figure())
    for module in ("loopwright.pipeline.pictures.drawing", "loopwright.pipeline.report.screening"):
        patch.setattr(f"{module}.png", lambda canvas: b"")
    patch.setattr("loopwright.pipeline.pictures.drawing.lay_out", lambda canvas: None)
