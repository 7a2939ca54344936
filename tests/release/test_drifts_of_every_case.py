"""The monitor finds a drift on every case, and is quiet without it."""

from __future__ import annotations

import pytest
from monitor_drifts import DRIFTS, assert_found_and_quiet_without


@pytest.mark.parametrize("name", DRIFTS)
def test_a_drift_is_found_and_the_same_run_without_it_is_quiet(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_found_and_quiet_without(name, monkeypatch)
