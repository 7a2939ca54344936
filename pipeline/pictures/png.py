"""The file of a picture."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.figure import Figure as Canvas
from PIL import Image

from loopwright.pipeline.files import write_bytes
from loopwright.pipeline.pictures.drawing import lay_out

DPI = 100.0  # MLflow shows pictures in their own size
COLOURS = 128  # lines in some colours, each with the shades of its edges
FLAT = Image.Dither.NONE


def png(canvas: Canvas) -> bytes:
    """The picture as a PNG; without date and version inside, so that equal data give equal files."""
    canvas.dpi = DPI
    # Matplotlib draws a canvas with a layout twice, the first time only to find it.
    lay_out(canvas)
    canvas.set_layout_engine(None)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


def fewer_colours(picture: bytes) -> bytes:
    """A PNG in COLOURS colours, in a third of its bytes: for a page or a notebook that holds it within.

    Maximum coverage keeps the colours of thin lines and small patches; the usual median cut mixes them.
    """
    few = Image.open(io.BytesIO(picture)).convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=FLAT)
    buffer = io.BytesIO()
    few.save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def save(canvas: Canvas, path: Path) -> None:
    """Write the PNG whole or not at all."""
    write_bytes(path, png(canvas))
