"""The part of an own plant's report on its identified model: verdicts, figures by variable and by answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopwright.pipeline.cases.own_model import LATE, GoneWrong
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.model_evidence import identified_part
from loopwright.pipeline.files import read_json
from loopwright.pipeline.historian.cleaning.outliers_and_units import usual
from loopwright.pipeline.historian.drift import Levels, levels_of
from loopwright.pipeline.pictures.drawing import axis_label, gain_unit
from loopwright.pipeline.pictures.numbers import figure, number

SCREENING = "screening.json"  # beside the record
GONE = "the model explains the rest, no drift is left, and there is nothing to do"
CARRIED = "The model has a load that follows it; a tag that measures its cause as dv makes the model better."
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
    """A sentence for each CV of which the screening said that it drifts: what the model leaves of it.

    ``part`` holds the figures of the identified model. A record without a screening beside it has none.
    """
    data, replayed = getattr(evidence.case, "data", None), evidence.case.replayed
    if data is None or replayed is None or not (path := data.with_name(SCREENING)).is_file():
        return ()
    report = read_json(path)
    said, structure = _alarms(report), part.get("structure") or {}
    if structure.get("rows_ahead") is not None:  # no run over all of these rows was made
        return tuple(f"{said[cv.name]} {CARRIED}" for cv in evidence.case.plant_class.sp_signals if cv.name in said)
    drifts = bool(structure.get("drifts"))
    rows = max((row["settling_s"] for row in report["verdict"]["inputs"]), default=0.0) / report["period_s"]
    runs = [found for name in evidence.models if "free run" in (found := evidence.predictions(name))]
    sentences = []
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


# --------------------------------------------------------------------------------------------------------- the section
MOST_CANDIDATES = 12  # candidates in the table, the best first
COLOURED = 0.05  # correlation of noise with that of the sample before, below which it counts as white
NEAREST_ERROR = 1.1  # error over the noise: no model is nearer
APART = 2  # periods between likely dead times from which on the report asks for the true one
SIGNS = {"+": "+", "-": "−", "uncertain": "uncertain"}


FREE_RUN = "in a free run: a model predicts from its own predictions"


@dataclass(frozen=True, slots=True)
class ModelSection:
    """Sentences, and the rows of three tables as texts."""

    verdicts: tuple[str, ...]
    variables: tuple[tuple[str, ...], ...]  # of each controlled variable, see VARIABLES
    answers: tuple[tuple[str, ...], ...]  # of each variable to each input, see ANSWERS
    tried: tuple[tuple[str, ...], ...]  # candidates, see TRIED
    judged: str = "free run"  # what the candidates' held-out errors are errors of
    predicted: str = FREE_RUN  # how the rows of the figures were predicted


VARIABLES = (
    "Variable",
    "Fit",
    "RMSE",
    "RMSE low, middle, high",
    "Noise",
    "Residual with itself",
    "with inputs",
)
ANSWERS = ("Variable", "Input", "Gain at the middle", "Sign", "Gain over the range", "First answer after [s]")
TRIED = ("Start", "States", "Delays", "Hidden units", "Held-out error", "Spread", "Chosen")


def model_section(evidence: Evidence) -> ModelSection | None:
    """The figures of the model that laws are designed on; None for a case without an identified one."""
    part = identified_part(evidence.models)
    if not part:
        return None
    mvs = [s.name for s in evidence.case.plant_class.mv_signals]
    verdicts = (*_verdicts(part), *drift_answers(evidence, part), *_trends(evidence, part), *_left_open(part, mvs))
    sentences = (
        *verdicts,
        *_late(evidence, part),
        *_dead_times(evidence, part),
        *_noisy_disturbances(evidence, part),
        *_asked(evidence),
        *_one_side(evidence),
    )
    structure = part.get("structure") or {}
    judged, rows = str(structure.get("judged") or "free run"), structure.get("rows_ahead")
    predicted = FREE_RUN if rows is None else (
        f"1 to {rows} rows ahead in turn: every {rows} rows a prediction begins from what was measured until then; "
        "the residual's correlations in the table are those of predictions one row ahead"
    )  # fmt: skip
    tables = (_variables(evidence, part), _answers(evidence, part), _tried(part))
    return ModelSection(sentences, *tables, judged, predicted)


def _verdicts(part: Mapping[str, Any]) -> tuple[str, ...]:
    """Linear or not, stable or not, and what the fit itself warns of."""
    structure, stability = part.get("structure") or {}, part.get("stability") or {}
    radius = part.get("spectral_radius")
    words = [structure.get("verdict"), _wandering(structure), stability.get("verdict"), structure.get("row_convention")]
    if not stability and radius is not None:
        words.append(f"the largest pole at rests of the visited range is {radius:.4g}; at most 1 is stable")
    warnings = tuple(f"Warning: {text}." for text in part.get("warnings") or ())
    return (*(f"{text[:1].upper()}{text[1:]}." for text in words if text), *warnings)


def _wandering(structure: Mapping[str, Any]) -> str:
    """Both kinds of model beside each other, where free runs missed more than noise; empty elsewhere."""
    ahead = structure.get("ahead")
    if not ahead:
        return ""
    words = (
        "free runs miss more than noise: a load wanders that nobody measures, the plant drifts, or the models lack "
        f"something. 1 to {ahead['rows']} rows ahead, over held-out rows, a model with loads errs by "
        f"{number(ahead['one_step'])}, the best of free runs by {number(ahead['free_runs'])}, where 1 is the "
        "variable's standard deviation"
    )
    if not ahead["wanders"]:
        return f"{words}: the model of free runs stays"
    return (
        f"{words}: the model with loads is taken. If the plant has changed since the record began, its gains are means"
    )


def _trends(evidence: Evidence, part: Mapping[str, Any]) -> tuple[str, ...]:
    """The gains that changed for certain while the record was taken."""
    plant, gains = evidence.case.plant_class, part.get("gains") or {}
    pairs = [
        (pv, mv, (gains.get(pv.name) or {}).get(mv.name) or {}) for pv in plant.sp_signals for mv in plant.mv_signals
    ]
    return tuple(
        f"The gain of {pv.name} by {mv.name} {'fell' if of['trend']['change'] < 0 else 'rose'} by "
        f"{abs(100 * of['trend']['change']):.0f} ± {100 * of['trend']['sd']:.0f} % of the model's while the record was "
        f"taken: to {axis_label(number(of['trend']['at_end']), gain_unit(pv, mv, bool(of.get('rate'))))} at its end, "
        f"where the model has {number(of['gain'])}. Controllers are tuned on the model. If the plant stays as it is at "
        "the end, add it once more without its first rows (--replace and --leave-out of `loopwright new`), as long as "
        "what is left carries a model."
        for pv, mv, of in pairs
        if (of.get("trend") or {}).get("certain")
    )


def _asked(evidence: Evidence) -> tuple[str, ...]:
    """The set points that tests ask for, where they follow from what the models can hold."""
    if not evidence.case.on_models:
        return ()
    asked = np.concatenate([test.sp for tests in evidence.case.tests().values() for test in tests])
    ends = zip(evidence.case.plant_class.sp_signals, asked.min(axis=0), asked.max(axis=0), strict=True)
    ranges = ", ".join(f"{s.name} from {number(low)} to {number(high)} {s.unit}".rstrip(" -") for s, low, high in ends)
    return (f"The tests ask for {ranges}, which the MVs can hold within the record. Nothing is known of others.",)


def _one_side(evidence: Evidence) -> tuple[str, ...]:
    """The MVs that controllers move over a part of their ranges, because a gain turns its sign beyond it."""
    case = evidence.case
    pairs = zip(case.plant_class.mv_signals, case.plant.mv_signals, strict=True) if case.on_models else ()
    return tuple(
        f"Controllers move {own.name} from {number(own.low)} to {number(own.high)} {own.unit}".rstrip(" -")
        + " alone: beyond that a model of the record has a gain of the other sign, and a loop there would lock up."
        for whole, own in pairs
        if (whole.low, whole.high) != (own.low, own.high)
    )


def _left_open(part: Mapping[str, Any], mvs: Sequence[str]) -> tuple[str, ...]:
    """How far models as likely as this one differ, which is how far tests and tuning go wrong at least."""
    found = part.get("open")
    if not found:
        return ()
    gains = ", ".join(f"{_by(sd)} in the gain of {name}" for name, sd in zip(mvs, found["gain_sd"], strict=True))
    dead, pace = found["dead_sd"][0], _by(found["pace_sd"][0])
    if any(least < most for _, least, most in (found.get("dead_times") or {}).values()):
        later = f"; some answer up to {2 * dead:.2g} periods later" if dead > 0 else ""
        return (f"Models as likely as this one differ by {gains} and by {pace} in speed (standard deviations){later}.",)
    return (
        f"Models as likely as this one differ by {gains}, by {pace} in speed and by {dead:.2g} periods in dead time "
        "(standard deviations).",
    )


def _late(evidence: Evidence, part: Mapping[str, Any]) -> tuple[str, ...]:
    """The lateness of analysers' results that stands in the model, beside its own lags."""
    period_s = evidence.case.plant_class.period_s
    return tuple(
        f"{name} is an analyser: the model hands its results over {periods} periods ({period_s * periods:g} s) after "
        "they were true. Slow lags may hide a part of the lateness, and of the plant's own dead time it holds what all "
        f'inputs share; one that you know is said by --known "{name}/MV=dead FROM..TO".'
        for name, periods in (part.get("late") or {}).items()
        if periods
    )


def _dead_times(evidence: Evidence, part: Mapping[str, Any]) -> tuple[str, ...]:
    """The inputs whose dead time a record in closed loop hardly tells, and how somebody says what it is."""
    plant, found = evidence.case.plant_class, (part.get("open") or {}).get("dead_times") or {}
    wide = {name: plant.period_s * np.array(of) for name, of in found.items() if of[2] - of[1] >= APART}
    if not wide:
        return ()
    spans = (
        f"from {number(low)} to {number(high)} s of {name} (the model delays it by {number(own)} s before its states)"
        for name, (own, low, high) in wide.items()
    )
    return (
        f"Dead times {' and '.join(spans)} explain the record alike. If you know the true one, "
        f"{say_dead_times(evidence)}: the controllers can then be quicker.",
    )


def say_dead_times(evidence: Evidence) -> str:
    """How an engineer states the dead times that the record leaves open, each pair with their ends [s], a clause.

    Where a record in open loop names none, these ends lie after the model's dead time by what its tests go wrong by.
    They stand beside the option, not in it: who copied them would say what the model says, which may be wrong.
    """
    plant, period_s = evidence.case.plant_class, evidence.case.plant_class.period_s
    part = identified_part(evidence.models)
    found = (part.get("open") or {}).get("dead_times") or {}
    ends = {name: (low, high) for name, (_, low, high) in found.items() if high - low >= APART}
    if not ends:
        own, later = part.get("dead_times") or {}, max(_later(evidence), default=0.0)
        first = {s.name: own.get(s.name) or 0.0 for s in plant.mv_signals}
        ends = {name: (periods, periods + later) for name, periods in first.items()}
    pairs = ", ".join(
        f'--known "{pv.name}/{name}=dead FROM..TO" (by the models {period_s * low:.4g} to {period_s * high:.4g})'
        for name, (low, high) in ends.items()
        for pv in plant.sp_signals
    )
    return (
        f"say it in seconds, as near as you know it, by an option of `loopwright new` or column `known` of the table "
        f"of tags: {pairs}"
    )


def _later(evidence: Evidence) -> list[float]:
    """Dead times [periods] by which plants gone wrong are late alone."""
    tests = evidence.case.tests()
    wrong = (test for name in evidence.case.gone_wrong for test in tests.get(name, ()))
    return [GoneWrong.on(test).parameters["dead_time"] for test in wrong if test.kind == LATE]


def _noisy_disturbances(evidence: Evidence, part: Mapping[str, Any]) -> tuple[str, ...]:
    """The noise of measured disturbances, of which a controller follows the level alone."""
    found = part.get("disturbances") or {}
    noisy = [(s, found[s.name]["noise_sd"]) for s in evidence.case.plant_class.dv_signals if s.name in found]
    sizes = ", ".join(f"{number(sd)} {s.unit} of {s.name}".replace("  ", " ") for s, sd in noisy if sd > 0)
    if not sizes:
        return ()
    return (
        f"Measured disturbances have noise, or motion that is gone a period later (standard deviations): {sizes}. "
        "Predictive control follows their levels.",
    )


def _by(sd: float) -> str:
    """A relative standard deviation; a share of a figure that is nearly zero would be a number that says nothing."""
    return f"{100 * sd:.2g} %" if sd <= 1 else "more than 100 %"


def _variables(evidence: Evidence, part: Mapping[str, Any]) -> tuple[tuple[str, ...], ...]:
    rows = []
    for signal in evidence.case.plant_class.sp_signals:
        found = (part.get("outputs") or {}).get(signal.name)
        if found is None:
            continue
        residual = (part.get("residual") or {}).get(signal.name) or {}
        thirds = found.get("rmse_by_third") or ()
        rows.append(
            (
                axis_label(signal.name, signal.unit),
                _fit(found),
                figure(found.get("free_run_rmse")),
                ", ".join(figure(third) for third in thirds),
                _noise(found),
                _share(residual.get("autocorrelated")),
                _share(residual.get("input_correlated")),
            )
        )
    return tuple(rows)


def _answers(evidence: Evidence, part: Mapping[str, Any]) -> tuple[tuple[str, ...], ...]:
    plant, gains = evidence.case.plant_class, part.get("gains") or {}
    proof, answers = (part.get("proof") or {}).get("answers") or {}, part.get("first_answers") or {}
    bent = (part.get("structure") or {}).get("hidden", 1) > 0
    rows = []
    for signal in plant.sp_signals:
        for given in (*plant.mv_signals, *plant.dv_signals):
            found = (gains.get(signal.name) or {}).get(given.name)
            if found is None:
                continue
            first = (answers.get(signal.name) or {}).get(given.name)
            varies = "turns its sign" if found["varies"] is None else f"× {number(found['varies'])}"
            over = f"{number(found['low'])} … {number(found['high'])}, {varies}"
            rows.append(
                (
                    signal.name,
                    given.name,
                    axis_label(
                        f"{number(found['gain'])} ± {number(found['spread'], 2)}",
                        gain_unit(signal, given, bool(found.get("rate"))),
                    ),
                    _sign(found, ((proof.get(signal.name) or {}).get(given.name) or {})),
                    over if bent else "one gain: the model is linear",
                    "–" if first is None else number(first * plant.period_s),
                )
            )
    return tuple(rows)


def _sign(gain: Mapping[str, Any], answer: Mapping[str, Any]) -> str:
    """The sign of a gain; of one that is open, where a control acts on an answer whose sign is proven, that one's."""
    if gain["sign"] == "uncertain" and answer.get("verdict") == "proven":
        return f"{SIGNS['+' if answer['model'] > 0 else '-']}, its end is open"
    return SIGNS.get(gain["sign"], gain["sign"])


def _tried(part: Mapping[str, Any]) -> tuple[tuple[str, ...], ...]:
    tried = [row for row in part.get("candidates_tried") or () if row.get("error") is not None]
    best = sorted(tried, key=lambda row: float(row["error"]))[:MOST_CANDIDATES]
    chosen = [row for row in tried if row.get("chosen") and row not in best]
    return tuple(
        (
            str(row.get("start", "")),
            str(row.get("order", "")),
            ", ".join(map(str, row.get("delays") or ())),
            str(row.get("hidden", "")),
            figure(row["error"]),
            figure(row.get("spread")),
            "yes" if row.get("chosen") else "",
        )
        for row in (*best, *chosen)
    )


def _fit(found: Mapping[str, Any]) -> str:
    """Fit in percent; it says little where the variable hardly moves, so an error no larger than the noise is named."""
    fit, error, noise = (found.get(key) for key in ("fit_percent", "free_run_rmse", "noise_sd"))
    if fit is None:
        return "the run explodes"
    good = error is not None and noise is not None and error <= NEAREST_ERROR * noise
    return f"{fit:.3g} %{', as good as the noise' if good else ''}"


def _noise(found: Mapping[str, Any]) -> str:
    """Standard deviation, and the colour where the noise has one."""
    sd, colour = found.get("noise_sd"), found.get("noise_colour") or 0.0
    return figure(sd) + (f", colour {colour:.2f}" if colour >= COLOURED else "")


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"
