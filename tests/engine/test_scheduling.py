"""Of the workers that run these tests, those that compute get no file that keeps time."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from scheduling import KEEP_TIME, RANK, TwoKinds, computes


class Node:
    """What a scheduler sees of a worker."""

    def __init__(self, place: int, workers: int) -> None:
        self.gateway, self.workerinput = SimpleNamespace(id=f"gw{place}"), {"workercount": workers}
        self.given: list[int] = []
        self.shutting_down = False

    def send_runtest_some(self, indices: list[int]) -> None:
        self.given += indices

    def shutdown(self) -> None:
        self.shutting_down = True


def node(place: int, workers: int) -> Any:
    return Node(place, workers)


def scheduler(files: list[str], nodes: list[Any]) -> TwoKinds:
    """Before it hands out the files, of one test each."""
    made = TwoKinds.__new__(TwoKinds)
    ids = [f"tests/{name}::test_one" for name in files]
    made.workqueue = OrderedDict((f"tests/{name}", {id_: False}) for name, id_ in zip(files, ids, strict=True))
    made.assigned_work = {n: {} for n in nodes}
    made.registered_collections = dict.fromkeys(nodes, ids)
    made.log = lambda *_: None  # type: ignore[assignment]
    return made


@pytest.mark.parametrize(("workers", "computing"), [(1, 0), (2, 1), (3, 1), (4, 2), (5, 3), (10, 8)])
def test_two_keep_time_where_there_are_enough(workers: int, computing: int) -> None:
    assert [computes(node(i, workers)) for i in range(workers)] == [i < computing for i in range(workers)]
    assert computes(node(workers, workers)) == (computing > 0)  # which takes the place of the first, after a crash


def test_files_that_keep_time_go_to_the_workers_for_them() -> None:
    timed = sorted(KEEP_TIME)[:5]
    files = [*timed, "test_a.py", "test_b.py", "test_c.py"]
    nodes = [node(i, 4) for i in range(4)]
    made = scheduler(files, nodes)
    for _ in range(6):
        for each in nodes:
            if made.workqueue and not each.shutting_down:
                made._assign_work_unit(each)
    given = [[files[i] for i in each.given] for each in nodes]
    assert given == [["test_a.py", "test_c.py"], ["test_b.py"], timed[::2], timed[1::2]]
    assert [each.shutting_down for each in nodes] == [True, True, False, False]


def test_every_file_that_is_named_is_there() -> None:
    tests = Path(__file__).parents[1]
    found = {path.name for path in tests.rglob("test_*.py") if "node_modules" not in path.parts}
    assert set(RANK) <= found
