"""The preload of a worker in a test, which imports what its tasks need and nothing ahead. Not a test."""

from __future__ import annotations

from collections.abc import Iterator

from loopwright.pipeline.engine import preload
from loopwright.pipeline.engine.preload import dask_setup

__all__ = ["dask_setup"]


def nothing() -> Iterator[str]:
    """In place of all libraries, which take a worker 5 s each time that it starts."""
    return iter(())


preload.loading = nothing
