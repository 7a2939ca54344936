"""All pictures of a case, drawn from the trajectories and predictions that the stages left."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.errors import ReportError
from loopwright.pipeline.evaluation.case import Figure
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import BASE
from loopwright.pipeline.evaluation.model_evidence import candidates, identified_part
from loopwright.pipeline.pictures.drawing import STYLE, CasePicture, Draw, save
from loopwright.pipeline.pictures.identified_pictures import free_run_picture, gains_picture, step_responses_picture
from loopwright.pipeline.pictures.loop_pictures import (
    cycle_picture,
    disturbance_picture,
    info_picture,
    loops_picture,
    overview_picture,
)
from loopwright.pipeline.pictures.model_pictures import (
    candidates_picture,
    one_step_picture,
    predictions_picture,
    replay_picture,
)
from loopwright.pipeline.pictures.operated_pictures import operated_picture
from loopwright.pipeline.pictures.tuning_pictures import TravelCurve, travel_picture
from loopwright.pipeline.pictures.words import law_name, scenario_name
from loopwright.pipeline.report.operated_tables import picture_name
from loopwright.pipeline.report.own_acceptance import shipped_laws, worst_test
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX

MODEL_PICTURES: tuple[tuple[str, Draw, str], ...] = (
    ("free_run", free_run_picture, "Predictions over rows that the fit never saw, and their residual"),
    ("step_responses", step_responses_picture, "Step responses, with the band of all fits that are as good"),
    (
        "gains",
        gains_picture,
        "Gains over each MV, from 10 to 90 % of its values in the record; the other MVs at their medians",
    ),
)
"""Figures of identified models."""


def draw_all(evidence: Evidence, folder: Path, own: Iterable[CasePicture] = ()) -> dict[str, str]:
    """Draw every figure that the evidence has trajectories for; returns file name -> caption.

    The case's own figures are ``figure_05.png`` and so on, with the best controller added;
    ``closed_loop_<law>.png`` shows each law beside the case's baseline on the test that weighs most, and
    ``closed_loop.png`` the best one; ``worst_<law>.png`` the test that says most against it, ``cycle_<law>.png`` its
    worst limit cycle, ``tuning_<law>.png`` the numbers that its search tried; ``candidates_<set>_<part>.png`` the
    search over a model's size; ``operated_<law>_<test>.png`` a test in which operators change more than set points;
    ``closed_loop_test_<test>.png`` a test that moves measured disturbances; ``own`` are the
    pictures that only this case has.
    Raises ReportError where two pictures have the same file name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn: dict[str, str] = {}
    where, untuned = main_words(evidence)
    shipped = shipped_laws(evidence)

    def keep(name: str, canvas: Canvas, caption: str) -> None:
        save(canvas, folder / f"{name}.png")
        drawn[f"{name}.png"] = caption

    with mpl.rc_context(STYLE):
        for name, draw, words in MODEL_PICTURES if identified_part(evidence.models) else ():
            with suppress(NotMeasuredError):
                keep(f"model_{name}", draw(evidence), words)
        for figure in evidence.case.figures:
            with suppress(NotMeasuredError):
                title = f"Figure {figure.number}. {figure.title}"
                keep(f"figure_{figure.number:02d}", _own(evidence, figure), title)
        for name, law in evidence.laws.items():
            title = "The old loop" if name == evidence.old_loop else law.title
            with suppress(NotMeasuredError):
                keep(f"closed_loop_{name}", overview_picture(evidence, name), f"{title} on {where}")
                if name == evidence.best:
                    shutil.copyfile(folder / f"closed_loop_{name}.png", folder / "closed_loop.png")
                    drawn["closed_loop.png"] = f"{title} on {untuned}"
            with suppress(NotMeasuredError):
                if name in shipped and (test := worst_test(evidence, name)) is not None:
                    words = scenario_name(test, evidence.case.recipe, evidence.case.test_words)
                    keep(f"worst_{name}", overview_picture(evidence, name, test), f"{title} on {words}")
            with suppress(NotMeasuredError):
                keep(f"cycle_{name}", *cycle_picture(evidence, name))
            for test, result in law.metrics.operated.items():
                with suppress(NotMeasuredError):
                    canvas, words = operated_picture(evidence, name, test)
                    keep(picture_name(name, test).removesuffix(".png"), canvas, f"{title}. {result.title}{words}")
            with suppress(NotMeasuredError):
                keep(f"replay_{name}", replay_picture(evidence, name), f"{title}, replayed over the record")
            with suppress(NotMeasuredError):
                curve = TravelCurve.of(law.analyses.get(BASE))
                keep(f"tuning_{name}", travel_picture(curve, law_name(name)), curve.words(title))
        for test, sequences in evidence.tests.items():
            if sequences[0].dv is not None:
                with suppress(NotMeasuredError):
                    keep(f"closed_loop_test_{test}", disturbance_picture(evidence, test), evidence.scenarios[test])
        for table in (t for name, model in evidence.models.items() for t in candidates(name, model)):
            words = f"Lags and widths tried for {table['part']} of the model {table['model']}"
            keep(
                f"candidates_{table['model']}_{table['part']}", candidates_picture(table, evidence.case.cv_unit), words
            )
        for picture in own:
            if (name := f"{picture.name}.png") in drawn:
                raise ReportError(f"the case's own picture {picture.name!r} would overwrite {name}; give another name")
            with suppress(NotMeasuredError):
                keep(picture.name, picture.draw(evidence), picture.title)
    for path in sorted(evidence.model_folder.glob("*/sweep.png")):
        name = f"sweep_{path.parent.name}.png"
        shutil.copyfile(path, folder / name)
        drawn[name] = f"Partition sweep of the model {path.parent.name}"
    return drawn


def main_words(evidence: Evidence) -> tuple[str, str]:
    """The main test in words: as a picture shows it, and for a reader who doubts a tuning."""
    name, recipe = evidence.main_test, evidence.case.recipe
    if len(evidence.tests[name.removesuffix(NOISE_SUFFIX)]) == 1:
        return (scenario_name(name, recipe, evidence.case.test_words),) * 2
    if recipe:
        return "a held-out recipe", "recipes that nothing was tuned on"
    return "a held-out sequence", "set points that nothing was tuned on"


def _own(evidence: Evidence, figure: Figure) -> Canvas:
    if figure.model is not None:
        return one_step_picture(evidence, figure)
    if figure.scenario is None:
        return predictions_picture(evidence, figure)
    return info_picture(evidence, figure) if figure.info else loops_picture(evidence, figure)
