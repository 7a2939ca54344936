"""The page of a screening: one HTML file with its pictures inside."""

from __future__ import annotations

import base64
from pathlib import Path

from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.files import write_text
from loopwright.pipeline.historian.files.rejection_codes import Reason
from loopwright.pipeline.historian.screening import Screened
from loopwright.pipeline.historian.step_test import StepTest
from loopwright.pipeline.pictures.excitation_pictures import inputs, verdict
from loopwright.pipeline.pictures.png import png
from loopwright.pipeline.pictures.screening_pictures import details, readings, times_of, trends
from loopwright.pipeline.report.templating import render

VERDICTS = {
    "yes": "These data can carry a model.",
    "doubtful": "A model of these data is doubtful.",
    "no": "These data cannot carry a model.",
}


def write_page(path: Path, found: Screened, test: StepTest | None) -> None:
    """Write the page of a screening, whole or not at all."""
    report = found.report
    pictures = {
        "trends": trends(found),
        "details": details(found),
        "readings": readings(found),
        "inputs": inputs(found),
        "verdict": verdict(found),
    }
    content = {
        "r": report,
        "verdict": VERDICTS[report.verdict.carries],
        "words": {r.name.lower(): r.words for r in Reason},
        "pictures": {name: _inline(canvas) for name, canvas in pictures.items() if canvas is not None},
        "kept_percent": 100.0 * report.kept_rows / report.grid_rows,
        "when": times_of(found).words,
        "test": test,
    }
    write_text(path, render("screening.html.j2", content))


def _inline(canvas: Canvas) -> str:
    return "data:image/png;base64," + base64.b64encode(png(canvas)).decode()
