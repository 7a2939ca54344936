"""Random operators and faults on laws with ``operate``: a few histories, and whether the counts would see a fault."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmark_modules import benchmark_modules

from loopwright.serving import ControlLoop

KINDS = (1, 6)  # a network with a rate, and more MVs than set points
HISTORIES = 8


@pytest.fixture(scope="module")
def fuzz() -> SimpleNamespace:
    return benchmark_modules(("_fuzzed_plants", "operate_fuzz"))


@pytest.fixture(scope="module")
def laws(fuzz: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[int], Sequence[Any]]]:
    log = logging.getLogger("loopwright.serving.loop")
    before = log.level
    log.setLevel(logging.CRITICAL)
    yield fuzz.operate_fuzz.opened(tmp_path_factory.mktemp("laws"))
    log.setLevel(before)


def histories(fuzz: SimpleNamespace, laws: Callable[[int], Sequence[Any]]) -> list[Any]:
    """The first histories of the kinds that are cheap enough for a test."""
    n = len(fuzz._fuzzed_plants.KINDS)
    return [fuzz.operate_fuzz.History(n * k + kind, laws) for k in range(HISTORIES) for kind in KINDS]


def test_nothing_is_wrong_in_a_few_histories_and_all_of_it_happens_there(
    fuzz: SimpleNamespace, laws: Callable[[int], Sequence[Any]]
) -> None:
    found = [history.run() for history in histories(fuzz, laws)]
    assert [words for one in found for words in one.first.values()] == []
    seen = {name for one in found for name in one.seen}
    assert {"operate", "mode", "swap", "local", "hand", "scans bridged", "scans shed", "scans in AUTO"} <= seen


def test_a_history_is_the_same_again(fuzz: SimpleNamespace, laws: Callable[[int], Sequence[Any]]) -> None:
    first, again = (fuzz.operate_fuzz.History(KINDS[0], laws).run() for _ in range(2))
    assert (first.seen, first.faults) == (again.seen, again.faults)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (Debian: apt install gcc)")
def test_compiled_laws_make_the_same_history(
    fuzz: SimpleNamespace, laws: Callable[[int], Sequence[Any]], tmp_path: Path
) -> None:
    for file in laws(KINDS[0]):
        shutil.copy(file.path, tmp_path)
        shutil.copy(file.path.with_suffix(".json"), tmp_path)
    compiled = fuzz.operate_fuzz.opened(tmp_path, "c")
    assert all(isinstance(law._session, fuzz._fuzzed_plants.RowSession) for law in compiled(KINDS[0]))
    one, other = (fuzz.operate_fuzz.History(KINDS[0], by).run() for by in (laws, compiled))
    assert (one.seen, one.faults, one.wrong) == (other.seen, other.faults, other.wrong)


def test_an_mv_that_leaves_its_range_or_its_rate_is_counted(
    fuzz: SimpleNamespace, laws: Callable[[int], Sequence[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = ControlLoop.scan

    def bent(loop: ControlLoop, sample: Any) -> Any:
        command = scan(loop, sample)
        command.mv[:] += 60.0
        return command

    monkeypatch.setattr(ControlLoop, "scan", bent)
    wrong = {name for history in histories(fuzz, laws)[:2] for name in history.run().wrong}
    assert {"wrote out of range", "wrote faster than its rate"} <= wrong


def test_an_mv_out_of_use_that_is_moved_is_counted(fuzz: SimpleNamespace, laws: Callable[[int], Sequence[Any]]) -> None:
    law = laws(KINDS[1])[0]
    law.findings = fuzz._fuzzed_plants.Findings()
    m = law.manifest
    operate = np.array(m.usual("operate"))
    operate[law.of["use"][0]] = 0.0
    mv = np.array([s.middle for s in m.mv])
    law._judged(operate, mv + 0.1 * law.span, mv, warm=False)
    assert list(law.findings.wrong) == ["out of use moves"]
