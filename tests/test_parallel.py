"""Independent pieces side by side: order, errors, and what stands in for a cluster."""

from __future__ import annotations

import math

import pytest

from pipeline.errors import PipelineError
from pipeline.parallel import parallel_map


def test_results_come_in_the_order_of_the_items() -> None:
    assert parallel_map(math.sqrt, [4.0, 1.0, 9.0], "roots") == [2.0, 1.0, 3.0]
    assert parallel_map(math.sqrt, [], "none") == []


def test_an_error_of_one_piece_is_the_error_of_all() -> None:
    with pytest.raises(ValueError, match=r"math domain error|nonnegative"):
        parallel_map(math.sqrt, [1.0, -1.0], "roots")


def test_a_cluster_without_its_package_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "tcp://127.0.0.1:1")
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(PipelineError, match="needs the package distributed"):
        parallel_map(math.sqrt, [1.0], "roots")
