"""Independent pieces in order, with their errors; here without a cluster, see tests/release/test_cluster.py for one."""

from __future__ import annotations

import math
import os
import pickle
from functools import partial
from pathlib import Path

import pytest
from engine_pieces import folder_of

from loopwright.pipeline.engine import pieces, start
from loopwright.pipeline.engine.cluster import address, workers_here
from loopwright.pipeline.engine.fingerprint import difference, fingerprint
from loopwright.pipeline.engine.parallel import as_done, parallel_map
from loopwright.pipeline.engine.pieces import lost
from loopwright.pipeline.engine.stage_files import NewFolder, apply, read_files
from loopwright.pipeline.errors import PipelineError


def test_results_come_in_the_order_of_the_items() -> None:
    assert parallel_map(math.sqrt, [4.0, 1.0, 9.0], "roots") == [2.0, 1.0, 3.0]
    assert parallel_map(math.sqrt, [], "none") == []
    assert list(as_done(math.sqrt, [4.0, 1.0])) == [(0, 2.0), (1, 1.0)]


def test_an_error_of_one_piece_is_the_error_of_all() -> None:
    with pytest.raises(ValueError, match=r"math domain error|nonnegative"):
        parallel_map(math.sqrt, [1.0, -1.0], "roots")


def test_a_cluster_that_does_not_answer_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "tcp://127.0.0.1:1")
    monkeypatch.setattr("loopwright.pipeline.engine.cluster.CONNECT_S", 0.2)
    with pytest.raises(PipelineError, match=r"no scheduler answers at tcp://127.0.0.1:1 .*start it"):
        parallel_map(math.sqrt, [1.0, 4.0], "roots")


def test_a_stage_whose_cluster_does_not_answer_ends_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "tcp://127.0.0.1:1")
    monkeypatch.setattr("loopwright.pipeline.engine.cluster.CONNECT_S", 0.2)
    assert start.run(["excite", "thiosulfate_cstr-random_steps"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("excite thiosulfate_cstr-random_steps: no scheduler answers at tcp://127.0.0.1:1 ")
    assert said.count("\n") == 1


def test_workers_are_asked_for_here_or_on_the_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    with workers_here(1, "--workers"), workers_here(None, "--workers"):
        assert address() is None
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "tcp://host:1")
    with workers_here(None, "--workers"):
        assert address() == "tcp://host:1"
    with pytest.raises(PipelineError, match=r"--workers is for this machine, .* at tcp://host:1; leave --workers out"):
        workers_here(2, "--workers")


def here(_: int) -> str:
    return os.getcwd()


def test_a_piece_that_reads_files_stays_with_them_where_no_stage_says_which(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "tcp://127.0.0.1:1")  # nobody answers there, and nobody is asked
    assert parallel_map(here, range(2), "places", in_folder=True) == [str(tmp_path)] * 2


def test_a_scheduler_that_went_away_is_said_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "tcp://host:1")
    error = RuntimeError("piece-7 cancelled for reason: scheduler-connection-lost.\nClient lost the connection")
    words = "the connection to the scheduler at tcp://host:1 was lost; start it again, and run this again"
    assert str(lost(error, "piece 3 of 5")) == words
    assert str(lost(RuntimeError("no memory"), "piece 3 of 5")).startswith(
        "piece 3 of 5: the cluster gave it up (no memory)"
    )


# ---------------------------------------------------------------------- what a worker does, called here
class TwoPartError(Exception):
    """An error that pickle cannot make again."""

    def __init__(self, one: str, other: str) -> None:
        super().__init__(f"{one} {other}")


def fail(kind: str, item: int) -> object:
    if kind == "result":
        return lambda: item
    raise TwoPartError("two", "parts") if kind == "two parts" else ValueError("of its own")


def answer(function: object, item: object, files: dict[str, bytes] | None = None) -> tuple[Exception, object, dict]:
    shared = pickle.dumps((function, files))
    return pickle.loads(pieces.answer(shared, pickle.dumps(item), fingerprint()))


@pytest.mark.parametrize(
    ("kind", "error", "text"),
    [
        ("plain", ValueError, "of its own"),
        ("two parts", (TwoPartError, PipelineError), "two parts"),  # a PipelineError without the help of tblib
        ("result", Exception, "pickle"),
    ],
)
def test_what_a_worker_raises_arrives(
    kind: str, error: type[Exception] | tuple[type[Exception], ...], text: str
) -> None:
    failed, result, _ = answer(partial(fail, kind), 1)
    assert result is None
    with pytest.raises(error, match=text):
        raise failed


def test_a_worker_with_other_code_refuses_and_names_both() -> None:
    theirs = {**fingerprint(), "torch": "9.9", "code": "f" * 64}
    failed, _, _ = pickle.loads(pieces.answer(pickle.dumps((math.sqrt, None)), pickle.dumps(1.0), theirs))
    own = fingerprint()
    assert f"code ffffffffffff here and {own['code'][:12]} there, torch 9.9 here and {own['torch'][:12]}" in str(failed)
    assert isinstance(failed, PipelineError)
    assert difference(own, own) == ""


def writes(folder: Path, item: int) -> str:
    (folder / f"{item}.txt").write_text(str(item))
    (folder / "old.txt").unlink()
    return (folder / "read.txt").read_text()


def test_a_piece_has_its_files_around_it_and_gives_back_what_changed(tmp_path: Path) -> None:
    here = os.getcwd()
    files = {"a/read.txt": b"given", "a/old.txt": b"goes"}
    failed, result, changes = answer(partial(writes, Path("a")), 3, files)
    assert failed is None
    assert (result, changes) == ("given", {"a/old.txt": None, "a/3.txt": b"3"})
    assert os.getcwd() == here


def test_a_folder_serves_piece_after_piece_until_one_changes_it(tmp_path: Path) -> None:
    files = {"a/read.txt": b"given"}
    first, second, third, fourth = (answer(folder_of, i, files)[1:] for i in range(4))
    assert first == second == (first[0], {})
    assert third == (first[0], {"left.txt": b""})
    assert fourth[0] != first[0]
    assert not Path(str(first[0])).exists()


# ---------------------------------------------------------------------- files as values
def test_files_come_back_as_they_were_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    apply({"deep/in/a.txt": b"1", "b.txt": b"2"})
    files = read_files([Path("deep"), Path("b.txt"), Path("missing"), Path("/etc/hostname"), Path("../b.txt")])
    assert files == {"deep/in/a.txt": b"1", "b.txt": b"2"}
    with NewFolder(files) as folder:
        assert folder.changes() == {}
        Path("b.txt").write_bytes(b"3")  # as long as it was
        assert folder.changes() == {"b.txt": b"3"}
        Path("deep/in/a.txt").unlink()
        assert folder.changes() == {"b.txt": b"3", "deep/in/a.txt": None}
    folder.remove()
    assert not folder.path.exists()
    assert Path("b.txt").read_bytes() == b"2"


@pytest.mark.parametrize("name", ["../out.txt", "/out.txt", "a/../../out.txt"])
def test_no_file_is_written_out_of_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    apply({"out/kept.txt": b"1", "out/deep/other.txt": b"2"})
    with pytest.raises(ValueError, match="leads out of the folder"):
        apply({"out/kept.txt": b"3", name: b""}, anew=[Path("out")])
    assert read_files([Path("out")]) == {"out/kept.txt": b"1", "out/deep/other.txt": b"2"}
    apply({"out/new.txt": b"4"}, anew=[Path("out"), Path("missing")])
    assert read_files([Path("out")]) == {"out/new.txt": b"4"}
