"""Independent pieces side by side: order, errors, and what stands in for a cluster."""

from __future__ import annotations

import math
import multiprocessing
import os
from functools import partial
from pathlib import Path
from threading import Event

import pytest

from pipeline.engine import parallel
from pipeline.engine.parallel import parallel_map
from pipeline.errors import PipelineError


def test_results_come_in_the_order_of_the_items() -> None:
    assert parallel_map(math.sqrt, [4.0, 1.0, 9.0], "roots") == [2.0, 1.0, 3.0]
    assert parallel_map(math.sqrt, [], "none") == []


def test_an_error_of_one_piece_is_the_error_of_all() -> None:
    with pytest.raises(ValueError, match=r"math domain error|nonnegative"):
        parallel_map(math.sqrt, [1.0, -1.0], "roots")


def mark(folder: Path, item: int) -> int:
    with (folder / f"{item}").open("a") as file:
        file.write(f"{os.getpid()}\n")
    return item**2


def test_every_piece_is_done_once_whoever_takes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    assert parallel_map(partial(mark, tmp_path), range(20), "squares") == [i**2 for i in range(20)]
    taken = [(tmp_path / f"{i}").read_text().split() for i in range(20)]
    assert all(len(pids) == 1 for pids in taken)
    assert [str(os.getpid())] in taken  # this process works too


def meet(folder: Path, item: int) -> int:
    """Wait, at most a minute, until another process has begun the other item."""
    (folder / f"{item}").write_text(str(os.getpid()))
    other = folder / f"{1 - item}"
    for _ in range(6_000):
        if other.exists() and other.read_text():
            return int(other.read_text())
        Event().wait(0.01)
    raise TimeoutError("no other process came")


def test_pieces_run_side_by_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    one, other = parallel_map(partial(meet, tmp_path), [0, 1], "meetings")
    assert one != other
    assert os.getpid() in (one, other)


def give_up(here: int, item: int) -> int:
    if os.getpid() != here:
        os._exit(3)
    Event().wait(0.05)
    return item


def test_a_helper_that_dies_is_an_error_and_no_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    with pytest.raises(PipelineError, match=r"exits: a helper process died \(exit code 3"):
        parallel_map(partial(give_up, os.getpid()), range(2_000), "exits")
    assert multiprocessing.active_children() == []


class TwoPartError(Exception):
    """An error that pickle cannot make again."""

    def __init__(self, one: str, other: str) -> None:
        super().__init__(f"{one} {other}")


def fail_elsewhere(here: int, kind: str, item: int) -> object:
    Event().wait(0.05)
    if os.getpid() == here:
        return item
    if kind == "result":
        return lambda: item
    raise TwoPartError("two", "parts") if kind == "two parts" else ValueError("of its own")


@pytest.mark.parametrize(
    ("kind", "error", "text"),
    [
        ("plain", ValueError, "of its own"),
        ("two parts", PipelineError, "TwoPartError: two parts"),
        ("result", Exception, "pickle"),
    ],
)
def test_what_a_helper_raises_arrives(
    monkeypatch: pytest.MonkeyPatch, kind: str, error: type[Exception], text: str
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    with pytest.raises(error, match=text):
        parallel_map(partial(fail_elsewhere, os.getpid(), kind), range(100), "failures")
    assert multiprocessing.active_children() == []


def test_where_a_fork_is_not_safe_helpers_start_afresh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "CONTEXT", multiprocessing.get_context("spawn"))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert parallel_map(math.sqrt, [4.0, 1.0, 9.0], "roots") == [2.0, 1.0, 3.0]
    assert multiprocessing.active_children() == []


def test_a_cluster_without_its_package_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "tcp://127.0.0.1:1")
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(PipelineError, match="needs the package distributed"):
        parallel_map(math.sqrt, [1.0], "roots")
