"""A real scheduler with two real workers, which were started in empty folders and see nothing of the client's."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import platform
import resource
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.request import urlopen

import distributed.client
import pytest
from dask_cluster import ROOT, Cluster, joined, two_workers  # noqa: F401
from engine_pieces import fatal, pages_of, process_of, refuse, squares, sums_of_squares, waking_ms, watched
from processes import within

from loopwright.pipeline.engine.cluster import (
    ADDRESS,
    MEMORY,
    OF_THE_PAGE,
    WORKERS,
    connected,
    disconnect,
    local_cluster,
    usual_workers,
)
from loopwright.pipeline.engine.fingerprint import fingerprint
from loopwright.pipeline.engine.parallel import _answers, parallel_map
from loopwright.pipeline.engine.pieces import WorkerTask
from loopwright.pipeline.errors import PipelineError

# Dask closes some of its sockets only as it is collected.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


def test_pieces_on_the_cluster_are_those_made_here(address: str) -> None:
    assert parallel_map(squares, range(20), "squares") == [i**2 for i in range(20)]


def test_work_that_is_done_cancels_nothing(address: str) -> None:
    """A scheduler tells all clients of a cancellation, and one that connects at that moment would fail."""
    parallel_map(squares, range(20), "squares")
    client = connected(address)
    assert not [event for _, event in client.get_events(client.id) if event["action"] == "cancel"]


def test_a_first_word_that_comes_with_another_is_no_error(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """Dask asserts that the first message to a client is alone."""
    connect, talkative = distributed.client.connect, [True]

    async def connected_once(*arguments: Any, **options: Any) -> Any:
        comm = await connect(*arguments, **options)
        read = comm.read

        async def with_news() -> Any:
            return [*await read(), {"op": "cancelled-keys", "keys": []}]

        if talkative:
            talkative.pop()
            comm.read = with_news
        return comm

    monkeypatch.setattr(distributed.client, "connect", connected_once)
    disconnect()
    try:
        client = connected(str(json.loads(cluster.file.read_text())["address"]))
        assert not talkative
        assert client.id.endswith("-again")
        assert client.submit(pow, 2, 3, pure=False).result() == 8
    finally:
        disconnect()


def test_no_profiler_watches_a_task_however_its_worker_was_started(address: str) -> None:
    assert not any(parallel_map(watched, range(8), "watched"))


def test_a_piece_shares_its_work_in_turn_and_stays_in_its_folder(address: str) -> None:
    """More pieces at a time than there are workers: each waits for its own."""
    given = WorkerTask({"given.txt": b"7"}, lambda: True)
    items = range(12)
    alone = [sum(k**2 for k in range(i)) + 7 for i in items]
    client = connected(address)
    found = dict(_answers(client, sums_of_squares, list(items), given.files, given))
    assert [found[i] for i in items] == [(result, {}) for result in alone]


def test_a_piece_that_kills_its_workers_is_given_up_in_one_line(address: str) -> None:
    with pytest.raises(PipelineError, match=r"^workers died one after the other \(often the memory was not enough\)"):
        parallel_map(fatal, range(3), "fatal")
    connected(address).wait_for_workers(2, timeout=60)


def test_the_error_of_a_piece_is_raised_here(address: str) -> None:
    with pytest.raises(PipelineError) as error:
        parallel_map(refuse, range(4), "refusals")
    assert str(error.value) == "the valve is stuck"


def test_a_result_counts_whose_worker_was_lost_a_moment_later(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    completed = distributed.as_completed

    def late(futures: Any, **how: Any) -> Iterator[tuple[Any, Any]]:
        for future, ended in completed(futures, **how):
            yield SimpleNamespace(key=future.key, status="pending"), ended

    monkeypatch.setattr(distributed, "as_completed", late)
    assert parallel_map(process_of, range(3), "processes")


def test_a_worker_that_is_killed_costs_its_piece_alone(address: str, tmp_path: Path) -> None:
    asked = f"""
import sys
sys.path[:0] = [{str(ROOT / "tools/roots")!r}, {str(ROOT / "tests")!r}]
from functools import partial
from pathlib import Path
from engine_pieces import pid_of
from loopwright.pipeline.engine.parallel import _answers, parallel_map
print(parallel_map(partial(pid_of, Path({str(tmp_path)!r})), range(6), "squares"))
"""
    process = subprocess.Popen([sys.executable, "-c", asked], stdout=subprocess.PIPE, text=True)
    assert within(60, lambda: bool(list(tmp_path.glob("3-*"))))
    killed = int(next(tmp_path.glob("3-*")).name.partition("-")[2])
    os.kill(killed, signal.SIGKILL)
    out, _ = process.communicate(timeout=90)
    assert out == f"{[i**2 for i in range(6)]}\n"
    assert len(list(tmp_path.glob("3-*"))) == 2
    connected(address).wait_for_workers(2, timeout=60)


@pytest.mark.parametrize("other", ["code", "numpy"])
def test_a_worker_of_other_sources_or_libraries_refuses_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: str
) -> None:
    """Its sources differ by a comment, or it finds another version of a library."""
    sources = tmp_path / "sources"
    for room in ("pipeline", "serving"):
        shutil.copytree(ROOT / room, sources / "loopwright" / room, ignore=shutil.ignore_patterns("__pycache__"))
    if other == "code":
        with (sources / "loopwright" / "pipeline" / "errors.py").open("a") as file:
            file.write("# another day's\n")
    else:
        (sources / "numpy-0.9.0.dist-info").mkdir()
        (sources / "numpy-0.9.0.dist-info" / "METADATA").write_text(
            "Metadata-Version: 2.1\nName: numpy\nVersion: 0.9.0\n"
        )
    made = Cluster(tmp_path, sources)
    try:
        made.worker()
        monkeypatch.setenv(ADDRESS, str(json.loads(made.file.read_text())["address"]))
        with pytest.raises(PipelineError) as error:
            parallel_map(squares, range(3), "squares")
        said, own = str(error.value), fingerprint()
        assert "\n" not in said
        assert f"{other} {own[other][:12]} here and " in said
        assert said.count(" here and ") == 1
    finally:
        disconnect()
        made.end()


def test_a_scheduler_without_workers_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loopwright.pipeline.engine.cluster.WORKERS_S", 1.0)
    made = Cluster(tmp_path)
    try:
        at = str(json.loads(made.file.read_text())["address"])
        with pytest.raises(PipelineError, match=f"^the scheduler at {at} has had no worker for 1 s; start some "):
            connected(at)
    finally:
        made.end()


def test_a_cluster_of_this_machine_has_the_workers_asked_for_and_ends_with_its_block(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(ADDRESS, raising=False)
    monkeypatch.setenv(WORKERS, "2")
    monkeypatch.setattr("loopwright.pipeline.engine.cluster.PRELOAD", [])  # which takes seconds
    said = list[str]()
    with local_cluster(say=said.append) as at:
        assert os.environ[ADDRESS] == at
        (line,) = said
        with urlopen(line.split()[-1], timeout=20) as page:
            assert b"Dask" in page.read()
        # A browser that goes away early makes bokeh's handlers fail in a callback, whose traceback is logged here.
        assert not any(logging.getLogger(name).isEnabledFor(logging.ERROR) for name in OF_THE_PAGE)
        connected(at).wait_for_workers(2, timeout=60)
        assert len(connected(at).scheduler_info(n_workers=-1)["workers"]) == 2
        pids = set(parallel_map(process_of, range(8), "processes"))
        assert os.getpid() not in pids
    assert ADDRESS not in os.environ
    assert within(20, lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))


def test_workers_of_this_machine_keep_memory_that_is_freed_and_seldom_look_at_themselves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(ADDRESS, raising=False)
    monkeypatch.setattr("loopwright.pipeline.engine.cluster.PRELOAD", [])
    for name in MEMORY:
        monkeypatch.delenv(name, raising=False)
    once = 16 * 1024**2 // resource.getpagesize()
    with local_cluster(1):
        for pages in parallel_map(pages_of, range(2), "pages"):
            if platform.libc_ver()[0] == "glibc":  # another library of C keeps memory in its own way
                assert pages < 3 * once  # a hundred times as many where each array is given back
        for tick, monitor in parallel_map(waking_ms, range(2), "waking"):
            assert min(tick, monitor) >= 2000  # 20 and 500 by default


def test_another_program_has_the_port_that_dask_would_take(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(ADDRESS, raising=False)
    monkeypatch.setattr("loopwright.pipeline.engine.cluster.PRELOAD", [])
    with socket.socket() as taken:
        with contextlib.suppress(OSError):  # somebody has it already
            taken.bind(("127.0.0.1", 8787))
            taken.listen()
        with local_cluster(1):  # Dask would warn, and a warning fails a test
            assert os.getpid() not in parallel_map(process_of, range(4), "processes")


def test_a_number_of_workers_that_is_none_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(WORKERS, raising=False)
    assert usual_workers() == os.cpu_count()
    for wrong in ("0", "-1", "two", "1.5"):
        monkeypatch.setenv(WORKERS, wrong)
        with pytest.raises(PipelineError, match=f"^LOOPWRIGHT_WORKERS is '{wrong}'; it takes how many workers"):
            usual_workers()
