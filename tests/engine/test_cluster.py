"""A real scheduler with two real workers, which were started in empty folders and see nothing of the client's."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.request import urlopen

import pytest
from engine_pieces import fatal, process_of, refuse, squares, sums_of_squares, watched
from own_cases import controllers_of_a_lag
from processes import within

from pipeline.engine import parallel
from pipeline.engine.cluster import ADDRESS, connected, disconnect, local_cluster
from pipeline.engine.folder import read_files
from pipeline.engine.parallel import _answers, parallel_map
from pipeline.engine.pieces import Task
from pipeline.engine.stage_files import DATA
from pipeline.errors import PipelineError
from pipeline.files import write_json
from pipeline.stages.design import design
from pipeline.stages.validate import validate

ROOT = Path(__file__).parents[2]
# Dask closes some of its sockets only as it is collected.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
GIVEN = {"law": "pid", "tuning": "manual", "kc": 0.2, "ti_s": 3.0}
QUIET = {"DASK_DISTRIBUTED__WORKER__DAEMON": "True", "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"}


class Cluster:
    """Processes of `dask`, each in an empty folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.processes = folder, list[subprocess.Popen[bytes]]()
        self.file = folder / "scheduler.json"
        self.start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", self.file)
        assert within(60, self.file.exists)

    def start(self, *arguments: object) -> None:
        empty = self.folder / f"empty{len(self.processes)}"
        empty.mkdir()
        command = [sys.executable, "-m", "dask", *map(str, arguments)]
        environment = {**os.environ, **QUIET, "OMP_NUM_THREADS": "1"}
        with (self.folder / f"{empty.name}.log").open("wb") as out:
            self.processes.append(
                subprocess.Popen(command, cwd=empty, env=environment, stdout=out, stderr=out, start_new_session=True)
            )

    def worker(self, *further: str) -> None:
        options = ("--nthreads", "1", "--no-dashboard", "--memory-limit", "0", *further)
        self.start("worker", "--scheduler-file", self.file, *options)

    def end(self) -> None:
        for process in reversed(self.processes):
            os.killpg(process.pid, signal.SIGTERM)
        for process in self.processes:
            process.wait(20)


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


def test_pieces_on_the_cluster_are_those_made_here(address: str) -> None:
    assert parallel_map(squares, range(20), "squares") == [i**2 for i in range(20)]


def test_no_profiler_watches_a_task_however_its_worker_was_started(address: str) -> None:
    assert not any(parallel_map(watched, range(8), "watched"))


def test_a_piece_shares_its_work_in_turn_and_stays_in_its_folder(address: str) -> None:
    """More pieces at a time than there are workers: each waits for its own."""
    given = Task({"given.txt": b"7"}, lambda: True)
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


def test_a_worker_that_is_killed_costs_its_piece_alone(address: str, tmp_path: Path) -> None:
    asked = f"""
import sys
sys.path[:0] = [{str(ROOT)!r}, {str(ROOT / "tests")!r}]
from functools import partial
from pathlib import Path
from engine_pieces import pid_of
from pipeline.engine.parallel import _answers, parallel_map
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


def test_a_worker_with_other_code_is_refused_in_one_line(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    own = parallel.fingerprint()
    monkeypatch.setattr(parallel, "fingerprint", lambda: {**own, "code": "f" * 64})
    with pytest.raises(PipelineError) as error:
        parallel_map(squares, range(3), "squares")
    assert "\n" not in str(error.value)
    assert f"code ffffffffffff here and {own['code'][:12]} there" in str(error.value)


# ---------------------------------------------------------------------- stages
@pytest.fixture
def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dvc.yaml").write_text((ROOT / "dvc.yaml").read_text())
    controllers_of_a_lag({"pid": GIVEN})
    write_json(DATA, {"it": ["data/it/record.parquet"]})  # as the stage `code` leaves it
    return tmp_path


def begin(stage: str, name: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command, pipe = [sys.executable, "-m", "pipeline.engine.start", stage, name], subprocess.PIPE
    return subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True)


def run(stage: str, name: str) -> tuple[int, str]:
    """The stage's exit status, and what it said on standard error."""
    process = begin(stage, name)
    _, said = process.communicate(timeout=120)
    return process.returncode, said


def made() -> dict[str, bytes]:
    # The step's time is measured, and stands in no other file.
    return read_files([Path("work/it/controllers"), Path("work/it/validation"), Path("artifacts")])


def test_stages_on_the_cluster_write_the_same_bytes_as_here(address: str, plant: Path) -> None:
    (plant / "artifacts/it").mkdir(parents=True)
    for stage, words in (("design", ""), ("validate", "validate it-pid: one step takes")):
        status, said = run(stage, "it-pid")
        assert status == 0, said
        assert words in said
    there = made()
    assert "artifacts/it/pid.onnx" in there
    os.environ.pop(ADDRESS)
    design("it-pid")
    validate("it-pid")
    assert made() == there


def test_a_mistake_is_one_line_and_leaves_what_was_there(address: str, plant: Path) -> None:
    design("it-pid")
    before = made()
    params = plant / "params.yaml"
    params.write_text(params.read_text().replace("kc: 0.2", "kcc: 0.2"))
    status, said = run("design", "it-pid")
    assert status == 2
    assert said.count("\n") == 1
    assert "controllers.it-pid: unknown key 'kcc'" in said
    assert made() == before


def test_a_client_that_is_killed_leaves_nothing_half_written_and_idle_workers(address: str, plant: Path) -> None:
    client = connected(address)
    process = begin("design", "it-pid")
    assert within(60, lambda: any(client.processing().values()))
    process.kill()
    process.communicate(timeout=20)
    assert within(60, lambda: not any(client.processing().values()))
    assert made() == {}


def test_a_cluster_of_this_machine_ends_with_its_block(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(ADDRESS, raising=False)
    monkeypatch.setattr("pipeline.engine.cluster.PRELOAD", [])  # which takes seconds
    said = list[str]()
    with local_cluster(2, said.append) as at:
        assert os.environ[ADDRESS] == at
        (line,) = said
        with urlopen(line.split()[-1], timeout=20) as page:
            assert b"Dask" in page.read()
        pids = set(parallel_map(process_of, range(8), "processes"))
        assert os.getpid() not in pids
    assert ADDRESS not in os.environ
    assert within(20, lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))
