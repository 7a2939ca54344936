"""The screening's alarm that a variable drifts, once a model is fitted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.files import read_json
from loopwright.pipeline.historian.cleaning.outliers_and_units import usual
from loopwright.pipeline.historian.drift import Levels, levels_of

SCREENING = "screening.json"  # beside the record
GONE = "the model explains the rest, no drift is left, and there is nothing to do"
FOLLOWED = (
    "a gain or a level that moves explains most of it: the plant drifts inside the record, and no model of these "
    "inputs can follow. Feedback corrects it; a tag that measures the cause as dv makes the model better"
)
LEFT = (
    "it still wanders, and no moving gain or level explains most of it: a load that nobody measures, or dynamics that "
    "the model lacks. Feedback corrects it; a tag that measures such a load as dv, or more minutes for the search, may "
    "make the model better"
)


def drift_answers(evidence: Evidence, part: Mapping[str, Any]) -> tuple[str, ...]:
    """A sentence for each CV of which the screening said that it drifts: what the model's free run leaves of it.

    ``part`` holds the figures of the identified model. A record without a screening beside it has none.
    """
    data, replayed = getattr(evidence.case, "data", None), evidence.case.replayed
    if data is None or replayed is None or not (path := data.with_name(SCREENING)).is_file():
        return ()
    report = read_json(path)
    drifts = bool((part.get("structure") or {}).get("drifts"))
    rows = max((row["settling_s"] for row in report["verdict"]["inputs"]), default=0.0) / report["period_s"]
    runs = [found for name in evidence.models if "free run" in (found := evidence.predictions(name))]
    said, sentences = _alarms(report), []
    for i, cv in enumerate(evidence.case.plant_class.sp_signals):
        if cv.name in said:
            span = float(np.ptp(usual(replayed[0].pv[:, i])))
            left = levels_of(runs[0]["measured"][:, i], runs[0]["free run"][:, i], span, int(rows)) if runs else None
            sentences.append(f"{said[cv.name]} {_answer(left, drifts)}")
    return tuple(sentences)


def _alarms(report: Mapping[str, Any]) -> dict[str, str]:
    """Signal -> what the screening said of it, without its advice."""
    found = {}
    for tag in report["tags"]:
        for finding in report["findings"]:
            if finding["kind"] == "drift" and tag["tag"] in (finding["tag"], *finding["tag"].split(", ")):
                found[tag["name"]] = f"The screening said of {tag['name']}: it {finding['words'].partition(';')[0]}."
    return found


def _answer(left: Levels | None, drifts: bool) -> str:
    """The rest of it: the levels of a free run, None where it has too few rows, and whether gain or level move."""
    if left is None:
        return f"The fitted model: {FOLLOWED if drifts else 'no drift was found in what its free run leaves'}."
    verdict = FOLLOWED if drifts else LEFT if left.wander else GONE
    return (
        "The fitted model's free run over unseen rows leaves levels that move over "
        f"{left.percent:.2g} % of the span; {verdict}."
    )
