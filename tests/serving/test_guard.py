"""Each guard names the one thing that is wrong, and is silent otherwise."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from loopwright.serving import (
    Allowed,
    Complete,
    Fresh,
    Frozen,
    Guard,
    InRange,
    LoopError,
    Manifest,
    Rate,
    Sample,
    Signal,
    default_guards,
)
from loopwright.serving.guard import lasting

PV = (Signal("level", "m", 0.0, 2.0), Signal("T", "K", 250.0, 400.0))
MANIFEST = Manifest(
    case="tank",
    law="none",
    period_s=0.5,
    sp=PV[:1],
    pv=PV,
    dv=(Signal("inflow", "l/s", 0.0, 3.0),),
    mv=(Signal("valve", "%", 0.0, 100.0),),
    n_state=0,
    info=(),
    inputs=("sp", "pv", "dv"),
)


def sample(level: float = 1.0, temperature: float = 300.0, **changed: Any) -> Sample:
    values = {"mv_applied": np.array([50.0]), "dv": np.array([1.0]), **changed}
    return Sample(pv=np.array([level, temperature]), **values)


def reasons(guard: Guard, samples: list[Sample]) -> list[str | None]:
    past: deque[Sample] = deque(maxlen=guard.memory)
    found = []
    for s in samples:
        found.append(guard.check(s, past))
        past.append(s)
    return found


@pytest.mark.parametrize("guard", [*default_guards(MANIFEST), Frozen(PV, 3), Rate(PV, (0.1, 5.0))])
def test_a_good_run_passes_every_guard(guard: Guard) -> None:
    assert reasons(guard, [sample(1 + 0.01 * k, 300 + k) for k in range(10)]) == [None] * 10


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (sample(math.nan), "PV level is nan"),
        (sample(temperature=-math.inf), "PV T is -inf"),
        (sample(mv_applied=np.array([math.nan])), "applied MV valve is nan"),
        (sample(dv=np.array([math.inf])), "DV inflow is inf"),
        (sample(dv=np.zeros(0)), "DV has the shape (0,) instead of (1,)"),
        (Sample(pv=np.zeros(3), dv=np.zeros(1)), "PV has the shape (3,) instead of (2,)"),
        (sample(dv=None), "DV is of the type NoneType; it needs an array of 1 numbers"),
        (sample(mv_applied=[50.0]), "applied MV is of the type list; it needs an array of 1 numbers"),
        (sample(mv_applied=np.array([None])), "applied MV is an array of the type object; it needs numbers"),
    ],
)
def test_complete(bad: Sample, reason: str) -> None:
    assert Complete(MANIFEST).check(bad, ()) == reason


def test_a_disturbance_that_the_law_does_not_use_need_not_be_measured() -> None:
    unused = Complete(replace(MANIFEST, inputs=("sp", "pv")))
    for dv in (np.zeros(0), np.array([math.nan])):
        assert unused.check(Sample(np.array([1.0, 300.0]), dv=dv), ()) is None
        assert Complete(MANIFEST).check(Sample(np.array([1.0, 300.0]), dv=dv), ()) is not None


def test_the_applied_mv_need_not_be_read_back() -> None:
    assert Complete(MANIFEST).check(sample(mv_applied=None), ()) is None


@pytest.mark.parametrize(("level", "good"), [(-0.11, False), (-0.09, True), (2.09, True), (2.11, False)])
def test_in_range_has_a_margin(level: float, good: bool) -> None:
    reason = InRange(PV, margin=0.05).check(sample(level), ())
    assert (reason is None) is good
    assert good or reason == f"PV level is {level} m, outside its range [0, 2] m"


def test_frozen_needs_that_many_equal_samples() -> None:
    samples = [sample(1.0, 300 + k) for k in range(5)]
    assert reasons(Frozen(PV, 4), samples) == [None] * 3 + ["PV level is frozen at 1 m for 4 samples"] * 2
    assert reasons(Frozen(PV, 4), [sample(1.0 + k % 2, 300 + k) for k in range(9)]) == [None] * 9


def test_fresh() -> None:
    assert Fresh(0.5).check(sample(age_s=0.5), ()) is None
    assert Fresh(0.5).check(sample(age_s=0.6), ()) == "the sample is 0.6 s old; allowed are 0.5 s"
    late = replace(sample(age_s=0.6), late="PV T")
    assert Fresh(0.5).check(late, ()) == "the sample of PV T is 0.6 s old; allowed are 0.5 s"
    assert lasting(Fresh(0.5).check(late, ()) or "") == "the sample of PV T is older than 0.5 s"
    assert Fresh(0.5).check(sample(age_s=math.nan), ()) is not None


@pytest.mark.parametrize(
    ("valve", "good"), [(-2.1, False), (-1.9, True), (101.9, True), (102.1, False), (1.7e308, False)]
)
def test_an_applied_mv_beyond_its_range_and_margin_is_implausible(valve: float, good: bool) -> None:
    reason = Allowed(MANIFEST.mv).check(sample(mv_applied=np.array([valve])), ())
    assert reason == (None if good else f"applied MV valve is {valve:.6g} %, outside its range [0, 100] %")


def test_the_default_guards_look_at_the_applied_mv() -> None:
    bad = sample(mv_applied=np.array([1e6]))
    assert [type(g) for g in default_guards(MANIFEST) if g.check(bad, ())] == [Allowed]


@pytest.mark.parametrize("age", [-1e-9, -math.inf, math.inf, math.nan, None, "0.1", np.float64(-1)])
def test_an_age_that_is_none_is_refused(age: Any) -> None:
    reason = f"the sample's age is {age!r}; it must be a finite number of seconds, 0 or more"
    assert Fresh(0.5).check(sample(age_s=age), ()) == reason
    for good in (0, 0.0, np.float32(0.1), np.int64(0)):
        assert Fresh(0.5).check(sample(age_s=good), ()) is None


@pytest.mark.parametrize("limit", [None, math.nan, math.inf, -1.0, "1"])
def test_an_age_guard_needs_a_limit(limit: Any) -> None:
    with pytest.raises(LoopError, match="it must be a finite number of seconds, 0 or more"):
        Fresh(limit)


def test_rate_looks_at_one_step_in_either_direction() -> None:
    guard = Rate(PV, (0.1, 5.0))
    assert reasons(guard, [sample(1.0), sample(1.05), sample(0.9)]) == [
        None,
        None,
        "PV level moved by 0.15 m in one sample; allowed are 0.1 m",
    ]
    assert "T moved by 6 K" in str(reasons(guard, [sample(), sample(temperature=306.0)])[1])
