"""All pictures of a case, drawn from the trajectories and predictions that the stages left."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure as Canvas

from pipeline.evaluation.case import Figure
from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.law_evidence import ReportError
from pipeline.evaluation.model_evidence import candidates
from pipeline.evaluation.verdicts import CasePicture
from pipeline.pictures.drawing import STYLE, save
from pipeline.pictures.loop_pictures import info_picture, loops_picture, overview_picture
from pipeline.pictures.model_pictures import candidates_picture, one_step_picture, predictions_picture
from pipeline.pictures.words import scenario_name
from pipeline.simulation.scenario import NOISE_SUFFIX


def draw_all(evidence: Evidence, folder: Path, models: Path, own: Sequence[CasePicture] = ()) -> dict[str, str]:
    """Draw every figure that the evidence has trajectories for; returns file name -> caption.

    The case's own figures are ``figure_05.png`` and so on, with the best controller added;
    ``closed_loop_<law>.png`` shows each law beside the case's baseline on the test that weighs most, and
    ``closed_loop.png`` the best one; ``candidates_<set>_<part>.png`` the search over a model's
    size; ``own`` are the pictures that only this case has. ``models`` is work/<case>/models.
    Raises ReportError where two pictures have the same file name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn: dict[str, str] = {}
    where, untuned = main_words(evidence)
    with mpl.rc_context(STYLE):
        for figure in evidence.case.figures:
            canvas = _own(evidence, figure, models)
            if canvas is not None:
                name = f"figure_{figure.number:02d}.png"
                save(canvas, folder / name)
                drawn[name] = f"Figure {figure.number}. {figure.title}"
        for law in evidence.laws:
            canvas = overview_picture(evidence, law)
            if canvas is None:
                continue
            name = f"closed_loop_{law}.png"
            save(canvas, folder / name)
            drawn[name] = f"{evidence.laws[law].title} on {where}"
            if law == evidence.best:
                shutil.copyfile(folder / name, folder / "closed_loop.png")
                drawn["closed_loop.png"] = f"{evidence.laws[law].title} on {untuned}"
        for table in (t for name, model in evidence.models.items() for t in candidates(name, model)):
            name = f"candidates_{table['model']}_{table['part']}.png"
            save(candidates_picture(table, evidence.case.plant_class.sp_signals[0].unit), folder / name)
            drawn[name] = f"Lags and widths tried for {table['part']} of the model {table['model']}"
        for picture in own:
            canvas, name = picture.draw(evidence), f"{picture.name}.png"
            if name in drawn:
                raise ReportError(f"picture {picture.name!r} of the claims would overwrite {name}; give another name")
            if canvas is not None:
                save(canvas, folder / name)
                drawn[name] = picture.title
    for path in sorted(models.glob("*/sweep.png")):
        name = f"sweep_{path.parent.name}.png"
        shutil.copyfile(path, folder / name)
        drawn[name] = f"Partition sweep of the model {path.parent.name}"
    return drawn


def main_words(evidence: Evidence) -> tuple[str, str]:
    """What a picture of the main test shows, and what the test is to somebody who doubts a tuning."""
    name, recipe = evidence.main_test, evidence.case.recipe
    if len(evidence.tests[name.removesuffix(NOISE_SUFFIX)]) == 1:
        return (scenario_name(name, recipe, evidence.case.test_words),) * 2
    if recipe:
        return "a held-out recipe", "recipes that nothing was tuned on"
    return "a held-out sequence", "set points that nothing was tuned on"


def _own(evidence: Evidence, figure: Figure, models: Path) -> Canvas | None:
    if figure.model is not None:
        return one_step_picture(figure, models)
    if figure.scenario is None:
        return predictions_picture(evidence.case, figure, models)
    return info_picture(evidence, figure) if figure.info else loops_picture(evidence, figure)
