"""A scheduler with two workers, which were started in empty folders."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from dask_cluster import Cluster

from pipeline.engine.cluster import ADDRESS, connected, disconnect


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        made.worker("--preload", "pipeline.engine.preload")
        made.worker()
        yield made
    finally:
        made.end()


@pytest.fixture
def address(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    found = str(json.loads(cluster.file.read_text())["address"])
    monkeypatch.setenv(ADDRESS, found)
    connected(found).wait_for_workers(2, timeout=60)
    yield found
    disconnect()
