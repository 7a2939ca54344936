"""Work that parts share: done once by the stage, done on the spot where nobody did it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from loopwright.pipeline.models.part import Groundwork, Source, done, groundworks
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving.manifest import Signal

Y, U = Signal("y", "m", 0.0, 1.0), Signal("u", "V", 0.0, 1.0)
SOURCE = Source(None, Signals(1.0, (Y,), (Y,), (), (U,)))
DONE: list[int] = []


@dataclass(frozen=True)
class Count(Groundwork[int]):
    number: int
    kind: str = "count"

    def done(self, source: Source, label: str) -> int:
        DONE.append(self.number)
        return 10 * self.number


@dataclass(frozen=True)
class Needs:
    """Stands for a part: only what it shares is looked at."""

    work: Count | None
    rest: Mapping[str, Any] = field(default_factory=dict)

    def groundwork(self) -> Count | None:
        return self.work


def test_equal_work_is_done_once_and_a_part_alone_needs_none() -> None:
    DONE.clear()
    parts = [Needs(Count(1)), Needs(Count(2)), Needs(Count(1)), Needs(None)]
    results = done(groundworks(parts), SOURCE, "fit")  # type: ignore[arg-type]
    assert DONE == [1, 2]
    assert results == {Count(1): 10, Count(2): 20}


def test_a_source_gives_what_is_done_and_does_the_rest() -> None:
    DONE.clear()
    source = replace(SOURCE, groundwork={Count(3): 33})
    assert source.result(Count(3)) == 33
    assert source.result(Count(4)) == 40
    assert DONE == [4]
