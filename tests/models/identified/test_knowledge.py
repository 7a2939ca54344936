"""What an engineer knows, in the search: delays, inputs without an effect, candidates behind, and the last word."""

from __future__ import annotations

from functools import cache
from typing import Any

import made_plants
import numpy as np
import pytest
from closed_loop_records import LOOPS, SIGNALS, OperatedLoop

from loopwright.pipeline.config.known import stated
from loopwright.pipeline.evaluation.proof import known_rows, sign_doubts, statements
from loopwright.pipeline.historian.stated_answers import Beside, DeadTimeBounds
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.identified.knowledge import Knowledge, ModelDelay, Pair, known_figures
from loopwright.pipeline.models.identified.linear_search import smallest_first
from loopwright.pipeline.models.identified.output_error import Fitted
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord
from loopwright.pipeline.models.identified.structure import CandidateFits, Structure, best_of
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record

QUICK = IdentifiedPart(minutes=0.2, orders=(2, 2), units=())
UNCERTAIN = OperatedLoop(gain=2.0, dead=3, kc=0.5, ti=10.0, hold=200, sp=4.0)
CERTAIN = LOOPS["steps by hand, small loads"]  # of gain -2
INF = float("inf")


def learnt(record: Record, signals: Signals, *known: tuple[str, str, str]) -> dict[str, Any]:
    """metrics.json of the model set."""
    said = tuple(stated(*of) for of in known)
    metrics = QUICK.learn(Source(record, signals, known=said)).metrics
    return {"": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": metrics}}}}}


def figures(models: dict[str, Any]) -> Any:
    return models[""]["parts"]["identified"]["per_seed"]["0"]


def test_the_word_of_an_engineer_decides_what_the_record_leaves_open() -> None:
    record = UNCERTAIN.record(1_500, 0)
    alone, right, wrong = (learnt(record, SIGNALS, *([("y", "u", sign)] if sign else [])) for sign in ("", "+", "-"))
    assert sign_doubts(alone)
    assert known_rows(alone) == []
    assert sign_doubts(right) == ""
    (row,) = known_rows(right)
    assert (row.limit, row.holds) == ("+", True)
    assert [r.holds for r in statements(right)][-1] is True
    assert figures(right)["proof"]["known"][0]["verdict"] == "open"
    # Nothing of the record is certain of the other sign, so that there is no question; but no model has it either.
    assert sign_doubts(wrong)
    assert "question" not in figures(wrong)["proof"]["known"][0]
    assert [r.holds for r in known_rows(wrong)] == [False]
    # The same models were fitted to the same rows.
    assert figures(alone)["gains"] == figures(right)["gains"]
    assert "known" not in figures(alone)["proof"]


@cache
def certain(said: str) -> dict[str, Any]:
    return learnt(CERTAIN.record(1_500, 0), SIGNALS, ("y", "u", said))


@pytest.mark.parametrize("said", ["+", "gain -0.6..-0.2"])
def test_what_the_record_is_certain_to_contradict_is_a_question_and_bends_no_model(said: str) -> None:
    asked, true = certain(said), certain("gain -3..-1")
    (of,) = figures(asked)["proof"]["known"]
    assert of["verdict"] == "contradicted"
    assert of["question"] in sign_doubts(asked)
    (row,) = known_rows(asked)
    assert (row.holds, row.because) == (False, of["question"])
    assert figures(asked)["gains"]["y"]["u"]["gain"] == pytest.approx(-2.0, rel=0.1)
    assert sign_doubts(true) == ""
    assert figures(true)["proof"]["known"][0]["verdict"] == "agrees"


def disturbed(n: int = 1_000) -> tuple[Record, Signals]:
    """One output that u0 moves by .5; d0, which does nothing, goes with u0."""
    rng = np.random.default_rng(0)
    signals = made_plants.signals_of(1, 1, 1)
    u = made_plants.random_holds(rng, n, 20)
    d = (u - 50) / 8 + rng.normal(0, 0.3, n)
    y = np.empty(n)
    x = u[0]
    for k in range(n):
        y[k] = 20 + 0.5 * x + 0.3 * rng.normal()
        x += 0.1 * (u[k] - x)
    return Record.of(signals, y[:, None], u[:, None], dv=d[:, None]), signals


def test_an_input_without_effect_has_none_in_the_model() -> None:
    record, signals = disturbed()
    guessed = figures(learnt(record, signals))["gains"]["y0"]
    known = figures(learnt(record, signals, ("y0", "d0", "none")))
    assert guessed["d0"]["gain"] != 0
    assert (known["gains"]["y0"]["d0"]["gain"], known["gains"]["y0"]["d0"]["sign"]) == (0.0, "none")
    assert known["gains"]["y0"]["u0"]["gain"] == pytest.approx(0.5, rel=0.05)
    assert np.abs(known["step_responses"]["y0"]["d0"]["high"]).max() == 0.0
    assert known["proof"]["known"][0]["verdict"] == "open"


def test_an_effect_that_the_record_is_certain_of_is_asked() -> None:
    record = made_plants.two_by_two(1_200)
    found = learnt(record, made_plants.signals_of(2, 2), ("y0", "u1", "none"), ("y1", "u1", "+"))
    assert [of["verdict"] for of in figures(found)["proof"]["known"]] == ["contradicted", "agrees"]
    assert figures(found)["gains"]["y0"]["u1"]["gain"] == pytest.approx(-0.3, abs=0.05)


def test_a_dead_time_limits_the_delays_on_offer() -> None:
    record, signals = made_plants.second_order(800, delay=4), made_plants.signals_of(1, 1)  # periods of 2 s
    free = {tuple(c["delays"]) for c in figures(learnt(record, signals))["candidates_tried"]}
    spanned = {
        tuple(c["delays"]) for c in figures(learnt(record, signals, ("y0", "u0", "dead 6..8")))["candidates_tried"]
    }
    exact = figures(learnt(record, signals, ("y0", "u0", "dead 8..8")))
    assert min(free) < (3,)
    assert (3,) <= min(spanned) <= max(spanned) <= (4,)
    assert {tuple(c["delays"]) for c in exact["candidates_tried"]} == {(4,)}
    assert exact["gains"]["y0"]["u0"]["gain"] == pytest.approx(0.5, rel=0.02)
    (of,) = exact["proof"]["known"]
    assert (of["says"], of["verdict"], of["model_s"], of["way"]) == ("dead 8..8", "open", 8.0, 0)
    assert of["record_s"][0] <= 8.0 <= of["record_s"][1]


@pytest.mark.parametrize(("said", "least_s", "most_s"), [("dead 0..6", 10, None), ("dead 40..50", None, 26)])
def test_a_dead_time_that_the_record_contradicts_is_a_question_and_limits_no_delay(
    said: str, least_s: float | None, most_s: float | None
) -> None:
    """The dead time is 20 s, 10 periods."""
    record, signals = made_plants.second_order(800, delay=10), made_plants.signals_of(1, 1)
    asked = learnt(record, signals, ("y0", "u0", f"+, {said}"))
    sign, dead = figures(asked)["proof"]["known"]
    assert (sign["says"], sign["verdict"]) == ("+", "agrees")
    assert (dead["says"], dead["verdict"]) == (said, "contradicted")
    assert dead["model_s"] == pytest.approx(20.0, abs=4.0)
    assert least_s is None or dead["record_s"][0] >= least_s
    assert most_s is None or dead["record_s"][1] <= most_s
    assert dead["question"] in sign_doubts(asked)
    of_sign, of_dead = known_rows(asked)
    assert (of_sign.holds, of_dead.holds, of_dead.because) == (True, False, dead["question"])
    assert f"{dead['model_s']:g} s" in of_dead.measured


def test_a_model_later_than_said_is_open_to_doubt_where_the_record_is_not_certain() -> None:
    gains = {name: {"u0": {"gain": 1.0, "spread": 0.1, "rate": False}} for name in ("y0", "y1")}
    record = made_plants.two_by_two(60)

    def verdict(periods: int, *pvs: str, answer: int = 1) -> dict[str, Any]:
        """The row; the PV first answers ``answer`` periods after a delay of ``periods``."""
        beside = Beside(stated("y0", "u0", "dead 4..8"), dead=DeadTimeBounds(), period_s=2.0)
        of_pvs = {name: gains[name] for name in pvs}
        (row,) = known_figures([beside], of_pvs, record, {"u0": ModelDelay(periods, (1, 3), {"y0": periods + answer})})
        return row

    assert [verdict(n, "y0")["verdict"] for n in (1, 2, 4, 5)] == ["model", "open", "open", "model"]
    assert verdict(1, "y0", answer=2)["verdict"] == "open"  # slow states hide a dead time
    assert verdict(1, "y0", "y1", answer=2)["verdict"] == "open"  # the input's delay is that of its quickest output
    assert verdict(3, "y1")["verdict"] == "unused"
    row = verdict(3, "y0")
    assert (row["dead_s"], row["model_s"], row["likely_s"], row["record_s"]) == ([4, 8], 6.0, [2.0, 6.0], [0.0, None])


@pytest.mark.parametrize(
    ("pairs", "n_y", "wanted"),
    [
        ([], 1, (0, 7)),
        ([Pair(0, 0, -INF, INF, delays=(2, 4))], 1, (2, 7)),
        ([Pair(0, 1, -INF, INF, delays=(2, 4))], 1, (0, 4)),
        ([Pair(0, 0, -INF, INF, delays=(2, 4)), Pair(1, 0, -INF, INF, delays=(3, 9))], 2, (2, 7)),
        ([Pair(0, 0, -INF, INF, delays=(2, 4))], 2, (0, 7)),  # the other output may answer at once
        ([Pair(0, 0, -INF, INF, delays=(2, 4)), Pair(1, 0, 0.0, 0.0, none=True)], 2, (2, 7)),
    ],
)
def test_an_input_has_one_delay_for_all_outputs(pairs: list[Pair], n_y: int, wanted: tuple[int, ...]) -> None:
    assert Knowledge(tuple(pairs), n_y).delays((0, 7)) == wanted


def first_order(gain: float, pole: float = 0.8) -> Dynamics:
    return Dynamics.linear(np.array([[pole]]), np.array([[(1 - pole) * gain if pole < 1 else gain]]))


@pytest.mark.parametrize(
    ("pair", "model", "against"),
    [
        (Pair(0, 0, 0.0, INF), first_order(0.5), False),
        (Pair(0, 0, 0.0, INF), first_order(-0.5), True),
        (Pair(0, 0, 1.0, 2.0), first_order(0.5), True),
        (Pair(0, 0, 0.2, 0.4), first_order(0.5), True),
        (Pair(0, 0, 0.0, 0.0, none=True), first_order(0.5), True),
        (Pair(0, 0, 0.0, 0.0, none=True), first_order(0.05), False),
        (Pair(0, 0, 0.0, INF), first_order(-0.01, 1.0), True),  # of an integrating output the way it goes
        (Pair(0, 0, 1.0, 2.0), first_order(0.01, 1.0), False),  # and no more
        (Pair(0, 0, -INF, INF, delays=(1, 2)), first_order(-0.5), False),
    ],
)
def test_a_model_contradicts_what_is_known_by_its_gain(pair: Pair, model: Dynamics, against: bool) -> None:
    v = np.random.default_rng(0).uniform(-1, 1, (200, 1))
    rows = ScaledRecord(np.zeros((200, 1)), v, np.zeros(200, dtype=np.int64))
    assert bool(Knowledge((pair,), 1).against(model, rows)) is against


def trial(order: int, error: float, *against: bool) -> CandidateFits:
    """With a fit a fold."""
    fits = {
        (k, 0): Fitted(first_order(1.0), [], error, error, 1, frozenset({0}) if a else frozenset())
        for k, a in enumerate(against)
    }
    return CandidateFits(Structure("balanced", order, (0, 0), (0,)), fits)


def test_candidates_that_contradict_what_is_known_rank_behind_all_that_agree() -> None:
    both, one, none = trial(2, 0.1, True, True), trial(3, 0.2, False, True), trial(4, 0.3, False, False)
    assert smallest_first([both, one, none]) == [none, one, both]
    assert best_of([both, one, none]) is none
    assert best_of([both, one]) is one
    agreeing = [trial(2, 0.1, False, False), trial(3, 0.2, False, False)]
    assert smallest_first(agreeing) == agreeing
