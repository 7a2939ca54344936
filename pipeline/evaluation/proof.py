"""Whether the record of an own plant proves its model, beside what an engineer knows of the plant."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from loopwright.pipeline.config.known import span_words
from loopwright.pipeline.evaluation.model_evidence import Metrics, identified_part
from loopwright.pipeline.evaluation.validation import CheckedStatement

MISSED = 0.5  # of a PV's motion beyond the noise: a model that misses more explains the lesser part of it
# free-run error over the PV's deviation, noise and all: a model that has more hardly needs its inputs
FREE_RUN_SHARE = 0.8
FORESEEN = 10.0  # nats: odds of 20,000 to 1 for a model whose MVs move the PV
COUPLED = 0.25  # of the model's own worth, that integral action of several loops keeps whatever open answers are
SUFFICIENT_SDS = 1.5  # standard deviations of one-step predictions that suffice then
HINTED = 5.0  # nats, odds of 150 to 1, that suffice beside the sign by which the old loop held the plant
BY_REGION = ("turns", "fades")  # verdicts on answers that hold by the regions of the MV's range
FOLLOWING_SHARE = 0.15  # share of an MV's moves that the PV's past explains, from which there is feedback
LITTLE = "the record leaves its sign open; beside the other answers it decides nothing, and all loops stand either"
OLD_LOOP = "the record leaves it open; it holds by the old controller's sign, with which it held the plant"
REMEDY = (
    "move the set point, or the MV in manual, in steps that are held about as long as the plant settles, as "
    "`loopwright new` lists them in step_test.csv, and give these rows too; or say with --known what you know of it"
)


def statements(models: Mapping[str, Metrics]) -> list[CheckedStatement]:
    """A row for each PV's free run, and for each answer of a PV to an MV that a controller uses.

    ``models``: model set -> its metrics.json. Empty where the fit says nothing of it.
    """
    proof = identified_part(models).get("proof") or {}
    return [*_predictions(proof).values(), *(row for row, _ in _signs(proof))]


def sign_doubts(models: Mapping[str, Metrics]) -> str:
    """Why no controller of these models may be shipped: what speaks against the gains that it uses; empty if nothing.

    To go on a sentence: ``not proven: the model's gain is uncertain in sign ...``.
    """
    if asked := question(models):
        return asked
    rows = [(row, pair) for row, pair in _signs(identified_part(models).get("proof") or {}) if not row.holds]
    if not rows:
        return ""
    found = "; ".join(f"{pair}: {row.because}" for row, pair in rows)
    return f"not proven: the model's gain is uncertain in sign ({found}); {REMEDY}"


def wants_a_plainer_model(models: Mapping[str, Metrics]) -> bool:
    """Whether a linear model may be proven where a network is not.

    A network may bend by loads or by what no MV did. Where the gain turns within the range a linear model would hide
    that, and where the record contradicts what an engineer says, it would do so with every model.
    """
    return bool(sign_doubts(models)) and not question(models) and not turns(models)


def turns(models: Mapping[str, Metrics]) -> bool:
    """Whether the gain of an answer turns its sign in the range, or a region speaks against it: ``Answer.turns``."""
    answers = (identified_part(models).get("proof") or {}).get("answers", {})
    return any(found["turns"] for mvs in answers.values() for found in mvs.values())


def fit_doubts(models: Mapping[str, Metrics]) -> str:
    """The part that the predictions miss, to go on a sentence; empty if it is small."""
    proof = identified_part(models).get("proof") or {}
    one_step = proof.get("one_step") or {}
    rows = {name: row.measured for name, row in _predictions(proof).items() if not row.holds}
    missed, little = (
        ", ".join(f"{name} ({words})" for name, words in rows.items() if (name in one_step) is of_one_step)
        for of_one_step in (False, True)
    )
    found = [f"the model misses most of what {missed} does"] * bool(missed)
    found += [f"the inputs foresee too little of {little}"] * bool(little)
    return f"not proven: {'; '.join(found)}" if found else ""


def _predictions(proof: Mapping[str, Any]) -> dict[str, CheckedStatement]:
    """PV -> the row of its free run, or, where loads wander or a controller acts, of its one-step predictions."""
    found = {}
    for name, of in (proof.get("one_step") or {}).items():
        found[name] = CheckedStatement(
            f"model, what its inputs foresee of {name} beyond its own past, over rows that its fit never saw",
            f"≥ {FORESEEN:g} nats",
            f"{of['nats']:.3g} nats: one-step error {of['with_inputs']:.3g} with them, {of['without']:.3g} without",
            of["nats"] >= FORESEEN,
            "where they foresee nothing, the MVs moved by the PVs alone, or by what has nothing to do with them",
        )
    for name, of in (proof.get("free_run") or {}).items():
        missed, limit = of["missed"], MISSED * of["motion"]
        found[name] = CheckedStatement(
            f"model, free-run error of {name} beyond the noise, over rows that its fit never saw",
            f"≤ {limit:.3g}, {100 * MISSED:g} % of its motion there",
            "the run explodes" if missed is None else f"{missed:.3g}",
            missed is not None and missed <= limit,
            "where it misses more, loads that nobody measures or another law moved the variable more than the model",
        )
    return found


def _signs(proof: Mapping[str, Any]) -> Iterator[tuple[CheckedStatement, str]]:
    """The row of each answer, and PV and MV in words."""
    for pv, mvs in (proof.get("answers") or {}).items():
        for mv, found in mvs.items():
            yield _sign(pv, mv, found, proof), f"{pv} to {mv}"


def _foreseen(proof: Mapping[str, Any], pv: str) -> bool:
    """Whether the inputs foresee a PV one row ahead, where free runs do not judge."""
    one_step = proof.get("one_step") or {}
    return pv in one_step and one_step[pv]["nats"] >= FORESEEN


def _followed(proof: Mapping[str, Any], pv: str) -> bool:
    """Whether the free run follows a PV, by its inputs: clearly better than a model without them."""
    of = (proof.get("free_run") or {}).get(pv) or {}
    missed, share = of.get("missed"), of.get("share")
    return missed is not None and share is not None and missed <= MISSED * of["motion"] and share <= FREE_RUN_SHARE


def _holds(found: Mapping[str, Any], known: Mapping[str, Any], *, shown: bool) -> bool:
    """Whether nothing speaks against an answer.

    Where the inputs are ``shown`` to foresee the PV over rows that no fit saw, and all models that are as likely have
    one sign, one-step predictions need not be as certain of it by themselves. An engineer's statement decides where the
    record leaves it uncertain; a model of another sign than said holds nowhere.
    """
    if known and known["way"] * found["model"] < 0:
        return False
    if decides(known, found):
        return True
    if found["verdict"] == "proven":
        return True
    if not shown or found["verdict"] != "uncertain" or found["direct"] is None:
        return False
    of_one_sign = found["low"] * found["high"] > 0 and found["direct"] * found["model"] > 0
    return bool(of_one_sign and abs(found["direct"]) >= SUFFICIENT_SDS * found["sd"])


def _by_region(found: Mapping[str, Any], known: Mapping[str, Any], *, shown: bool) -> bool:
    """Whether an answer whose gain turns or fades holds: in each region where it is not small, the PV ``shown``.

    A region of another sign than an engineer says holds nowhere.
    """
    told = [region for region in found.get("regions") or () if not region["small"]]
    if known and any(known["way"] * region["model"] < 0 for region in told):
        return False
    return shown and bool(told) and all(_holds(region, {}, shown=True) for region in told)


def _sign(pv: str, mv: str, found: Mapping[str, Any], proof: Mapping[str, Any]) -> CheckedStatement:
    known, by_region = known_of(proof, pv, mv), found["verdict"] in BY_REGION
    foreseen = _foreseen(proof, pv)
    shown = foreseen or _followed(proof, pv)
    if by_region:
        holds = _by_region(found, known, shown=shown)
        limit = "certain in sign in each region where it is not small, and of the size that one-step predictions find"
        because = _by_regions_why(found, shown=shown, holds=holds)
        if known and not holds:
            because += f"; an engineer says {known['says']!r}: is it so in all of the range?"
    else:
        little = not known and _matters_little(pv, found, proof, shown=shown)
        held = _by_the_old_loop(pv, found, known, proof)
        holds = little or held or _holds(found, known, shown=foreseen)
        limit = "certain in sign, the same in both halves of the record, and of the size that one-step predictions find"
        because = LITTLE if little else OLD_LOOP if held else _word(found, known, holds=holds) or _why(pv, mv, found)
    return CheckedStatement(
        f"model, gain on the way: answer of {pv} to {mv} {found['first']} to {found['last']} periods after a step of 1",
        limit,
        "; ".join([*([] if by_region else [_measured(found)]), *_regions(mv, found)]),
        holds,
        because,
    )


def _by_the_old_loop(pv: str, found: Mapping[str, Any], known: Mapping[str, Any], proof: Mapping[str, Any]) -> bool:
    """Whether an uncertain answer holds by the sign with which the old loop held the plant, where nobody says another.

    The model, all that are as likely, and one-step predictions must have it, these by ``SUFFICIENT_SDS`` standard
    deviations; and the inputs must foresee something of the PV, by ``HINTED``. A controller that was read backwards has
    the other.
    """
    way, nats = (proof.get("held") or {}).get(pv, 0), ((proof.get("one_step") or {}).get(pv) or {}).get("nats", 0.0)
    if not way or known or nats < HINTED or found["verdict"] != "uncertain" or found["direct"] is None:
        return False
    least = min(way * found[name] for name in ("model", "low", "high"))
    direct = way * found["direct"]
    return bool(
        least > 0
        and direct >= SUFFICIENT_SDS * found["sd"]
        and direct + found["sd"] <= ALLOWED_ANSWER_RATIO * way * found["model"]
    )


def _matters_little(pv: str, found: Mapping[str, Any], proof: Mapping[str, Any], *, shown: bool) -> bool:
    """Whether an uncertain answer of several loops may be what it will: the PV ``shown``, the others hold the plant."""
    margin = (proof.get("sign_margin") or {}).get(pv)
    return shown and found["verdict"] == "uncertain" and margin is not None and margin >= COUPLED


def _measured(found: Mapping[str, Any]) -> str:
    """The models' answer and that of one-step predictions, in words."""
    direct = (
        "too few rows for one-step predictions"
        if found["direct"] is None
        else f"one-step predictions {found['direct']:.3g} ± {found['sd']:.2g}"
    )
    return f"{found['model']:.3g} ({found['low']:.3g} … {found['high']:.3g}); {direct}"


def _regions(mv: str, found: Mapping[str, Any]) -> list[str]:
    """The answer in each region of the MV, in words; empty where it is much the same in all of its range."""
    return [
        f"{mv} at {region['from']:.3g} … {region['to']:.3g}: "
        + (f"{region['model']:.2g}, small" if region["small"] else _measured(region).replace(";", ","))
        for region in found.get("regions") or ()
    ]


def _by_regions_why(found: Mapping[str, Any], *, shown: bool, holds: bool) -> str:
    """Facts on a gain that changes within the range, and reasons against it."""
    changes = "turns its sign" if found["verdict"] == "turns" else "fades"
    against = (
        "" if holds else ", and the record shows too little of it" if shown else ", and the model predicts too little"
    )
    return f"its gain {changes} within the range{against}"


def _word(found: Mapping[str, Any], known: Mapping[str, Any], *, holds: bool) -> str:
    """The part of an answer that an engineer's word has decided; empty without one."""
    if known and known["way"] * found["model"] < 0:
        return f"an engineer says {known['says']!r}, and the model has the other sign"
    if decides(known, found):
        return f"the record leaves it open: it holds by the word of an engineer, who says {known['says']!r}"
    if known and not holds and found["verdict"] == "uncertain" and not known["size"]:
        return f"an engineer says {known['says']!r}, and the record tells too little of the size: say the gain too"
    return ""


def _why(pv: str, mv: str, found: Mapping[str, Any]) -> str:
    """Reasons against an answer; empty without any."""
    verdict, share = found["verdict"], found["follows"]
    if verdict == "proven":
        return ""
    back = "the model may be the controller, read backwards"
    if verdict == "uncertain":
        if share > FOLLOWING_SHARE:
            return f"{mv} follows {pv} ({100 * share:.0f} % of its moves) and hardly moves of its own: {back}"
        return "the record shows too little of it"
    if verdict == "opposite":
        return f"one-step predictions of the same rows find the other sign: {back}"
    if verdict == "halves":
        return "a half of the record speaks for the other sign"
    return f"one-step predictions of the same rows find {found['direct'] / found['model']:.2g} times as much"


ALLOWED_ANSWER_RATIO = 3.0
"""Answer that a record allows over the model's, up to which the model has the size that it needs."""

WHY = {
    "agrees": "the record by itself is certain of it",
    "open": "the record leaves it open and does not contradict it: it holds by the engineer's word",
    "model": "the model contradicts it, and the record is not certain: its tests run on a model that is doubtful here",
    "unused": "no model has this variable as an output, so that it is not used",
}


def known_rows(models: Mapping[str, Metrics]) -> list[CheckedStatement]:
    """A row for each statement of an engineer, on sign and gain or on the dead time.

    ``models``: model set -> its metrics.json.
    """
    rows = []
    for of in _statements(identified_part(models).get("proof") or {}):
        used, dead = of["verdict"] != "unused", "dead_s" in of
        rows.append(
            CheckedStatement(
                f"what is known of the {'dead time' if dead else 'answer'} of {of['pv']} to {of['input']}",
                of["says"],
                (_dead_words(of) if dead else _gain_words(of)) if used else "not compared",
                of["verdict"] in {"agrees", "open"} if used else None,
                of.get("question") or WHY[of["verdict"]],
            )
        )
    return rows


def _gain_words(of: Mapping[str, Any]) -> str:
    """The gains of model and record beside a statement, in words."""
    words = f"model, at the middle, {of['gain']:.3g} ± {of['spread']:.2g}"
    return (
        words
        if of["direct"] is None
        else f"{words}; one-step predictions, on the way, {of['direct']:.3g} ± {of['sd']:.2g}"
    )


def _dead_words(of: Mapping[str, Any]) -> str:
    """The dead times of model and record beside a statement, in words."""
    seen = "never answers" if of["answer_s"] is None else f"first answers after {of['answer_s']:g} s"
    words = f"the model {seen}; it delays the input by {of['model_s']:g} s before its states"
    if of["likely_s"] is not None:
        words += f", {span_words(*of['likely_s'])} as likely"
    if of["record_s"] is None:
        return f"{words}; the record by itself says nothing: too few rows, or more periods than can be compared"
    return f"{words}; the record by itself leaves {span_words(*of['record_s'])}"


def question(models: Mapping[str, Metrics]) -> str:
    """The question on statements that the record is certain to contradict, to go on a sentence; empty without any."""
    asked = [of["question"] for of in _statements(identified_part(models).get("proof") or {}) if "question" in of]
    return f"not proven: {'; '.join(asked)}" if asked else ""


def known_of(proof: Mapping[str, Any], pv: str, mv: str) -> Mapping[str, Any]:
    """The statement on a pair that says a sign; empty where there is none."""
    return next((of for of in _statements(proof) if (of["pv"], of["input"]) == (pv, mv) and of["way"]), {})


def decides(known: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    """Whether a statement decides what the record leaves open of an answer (``Answer`` as a mapping).

    A sign alone is not enough for a controller: the model's size must be known too. Either somebody says the gain, and
    the model has it; or one-step predictions allow, to a standard deviation, no more than ``ALLOWED_ANSWER_RATIO`` of
    the model's.
    """
    if not known or found["verdict"] != "uncertain" or known["way"] * found["model"] <= 0:
        return False
    if known["verdict"] in {"model", "contradicted"}:
        return False
    told = found["direct"] is not None and known["way"] * found["direct"] + found["sd"] <= ALLOWED_ANSWER_RATIO * abs(
        found["model"]
    )
    return bool(known["size"] or told)


def _statements(proof: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return list(proof.get("known") or ())
