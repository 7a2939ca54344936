"""The benchmark of the monitor on a continuous and on a batch case; tests/release holds all of them."""

from __future__ import annotations

import pytest
from benchmark_modules import benchmark_script
from monitor_drifts import DRIFTS, assert_found_and_quiet_without

from loopwright.pipeline.cases import CASES


def test_every_case_is_among_them() -> None:
    assert set(DRIFTS) == set(CASES) == set(benchmark_script("monitor").PLANS)


@pytest.mark.parametrize("name", ["reversible_cstr", "batch_reactor"])
def test_a_drift_is_found_and_the_same_run_without_it_is_quiet(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_found_and_quiet_without(name, monkeypatch)
