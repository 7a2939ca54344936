"""Conformance kits of shipped controllers, whole and damaged, and the verdict on a host's answers."""

from __future__ import annotations

import atexit
import json
import re
import shutil
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import mkdtemp
from typing import Any

from random_scans import random_rows
from shipped_files import SHIPPED

from loopwright.serving import Controller
from loopwright.serving.conformance.kit import VECTORS, KitVerdict, check, write_kit

ROOT = Path(__file__).resolve().parents[1]
EMBED = ROOT / "examples" / "embed"
CASES = sorted({file.parent for file in SHIPPED})
# Of each case its first and its last file: different laws.
SOME = [file for case in CASES for file in sorted({min(case.glob("*.onnx")), max(case.glob("*.onnx"))})]
# Laws whose cold start differs from a warm one: a PID, an observer of disturbances, a law of a batch.
KEEP_STATE = [
    file
    for file in SHIPPED
    if (file.parent.name, file.stem)
    in {
        ("thiosulfate_cstr", "pid"),
        ("thiosulfate_cstr", "forward_dob"),
        ("jacketed_batch_reactor", "fuzzy_feedforward_observer"),
    }
]


def name(file: Path) -> str:
    """CASE-NAME, for a test's id."""
    return f"{file.parent.name}-{file.stem}"


@cache
def kit_of(file: Path) -> Path:
    """The folder of the kit of one controller file, written once a process and removed at its end."""
    folder = Path(mkdtemp(prefix="kit-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    write_kit(Controller(file), folder)
    return folder


def verdict_on(file: Path, answers: Path) -> KitVerdict:
    """What a host's answers are worth."""
    return check(kit_of(file), answers, Controller(file).sha256)


def spoilt(file: Path, folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A copy of a kit in ``folder`` with its vectors changed."""
    shutil.copytree(kit_of(file), folder, dirs_exist_ok=True)
    vectors = json.loads((folder / VECTORS).read_text())
    change(vectors)
    (folder / VECTORS).write_text(json.dumps(vectors))
    return folder


def goes_through_random_scans(run: Run, file: Path, folder: Path, seeds: int = 4, scans: int = 400) -> None:
    """A host's loop does what ours does, whatever operators, others and the connection do."""
    for seed in range(seeds):
        rows = {"scans": random_rows(Controller(file), seed, scans)}
        done = run("--conformance", spoilt(file, folder / str(seed), lambda vectors, new=rows: vectors.update(new)))
        assert done.returncode == 0, f"history {seed}: {done.stdout}{done.stderr}"
        assert re.search(r", 0 wrong", done.stdout), done.stdout


def another_mv(vectors: dict[str, Any]) -> None:
    """One MV differs by a thousandth of its range."""
    row = vectors["steps"][150]["gives"]
    shifted = float.fromhex(row["mv"][0]) + 1e-3 * float.fromhex(vectors["scale"]["mv"][0])
    row["mv"][0] = shifted.hex()


def another_state(vectors: dict[str, Any]) -> None:
    """The last entry of a state differs by a thousandth of its scale."""
    row = vectors["steps"][-1]["gives"]
    shifted = float.fromhex(row["state_next"][-1]) + 1e-3 * float.fromhex(vectors["scale"]["state_next"][-1])
    row["state_next"][-1] = shifted.hex()


def no_refusal(vectors: dict[str, Any]) -> None:
    """A step that must be refused seems to be a good one."""
    row = next(row for row in vectors["steps"] if "refused" in row)
    del row["refused"]


def another_mode(vectors: dict[str, Any]) -> None:
    """The loop seems to go on in AUTO with a sample that must be refused."""
    row = next(row for row in vectors["scans"] if row["mode"] == "HOLD")
    row["mode"] = "AUTO"


def a_start_without_information(vectors: dict[str, Any]) -> None:
    """The loop seems to write an MV before it knows where it stands."""
    row = vectors["scans"][0]
    assert row["mv"] is None
    row["mv"] = vectors["scans"][4]["mv"]


def an_old_mv_written_over_a_new_one(vectors: dict[str, Any]) -> None:
    """The loop seems to hold its old MV after a command that did not arrive, though somebody has moved it."""
    k, row = next((k, row) for k, row in enumerate(vectors["scans"]) if row["what"].endswith("and the MV was moved"))
    assert row["mv"] == row["sample"]["mv_applied"] != vectors["scans"][k - 1]["mv"]
    row["mv"] = vectors["scans"][k - 1]["mv"]


def another_given_state(vectors: dict[str, Any]) -> None:
    """One step seems to begin from another state: a host that takes the given one computes something else."""
    row = next(row for row in vectors["steps"] if row["part"] == "course")
    given = row["given"]
    given["state"] = [(2.0 * float.fromhex(value) + 1.0).hex() for value in given["state"]]


def an_old_version(vectors: dict[str, Any]) -> None:
    """The kit as it was before: no step says from which state it begins."""
    vectors["kit"] = 3
    del vectors["chained_tolerance"]
    for row in vectors["steps"]:
        del row["given"]["state"]


DAMAGES = {
    "mv": another_mv,
    "state": another_state,
    "given": another_given_state,
    "refusal": no_refusal,
    "mode": another_mode,
    "start": a_start_without_information,
    "moved": an_old_mv_written_over_a_new_one,
}


# ------------------------------------------------------------------------- what every host's program must do, whichever
PID = next(file for file in SHIPPED if name(file) == "thiosulfate_cstr-pid")
Run = Callable[..., CompletedProcess[str]]
"""A host's program with these words as its arguments."""


def answers_refusals_and_disturbances(run: Run, file: Path, answers: Path) -> None:
    """No shipped controller has measured disturbances or leaves its range; the one in ``file`` does both."""
    vectors = json.loads((kit_of(file) / VECTORS).read_text())
    refused = Counter(row.get("refused", "") for row in vectors["steps"])
    assert min(refused["output"], refused["input"], refused[""]) >= 15
    done = run("--conformance", kit_of(file), answers)
    assert done.returncode == 0, done.stdout + done.stderr
    verdict = verdict_on(file, answers)
    assert verdict.identical, verdict.text()


def takes_what_is_to_come(run: Run, file: Path, answers: Path) -> None:
    """No shipped law reads ``ahead``; the one in ``file`` does (tests/course_files.py)."""
    vectors = json.loads((kit_of(file) / VECTORS).read_text())
    given = [tuple(row["given"]["ahead"]) for row in vectors["steps"]]
    assert len(set(given)) > 100
    assert (0.0).hex() in {value for row in given for value in row if len(set(row)) == 1}  # nothing to come
    done = run("--conformance", kit_of(file), answers)
    assert done.returncode == 0, done.stdout + done.stderr
    verdict = verdict_on(file, answers)
    assert verdict.identical, verdict.text()
    assert run(kit_of(file) / file.name, "3", "0.02").returncode == 0  # and without any


def takes_what_operators_change(run: Run, file: Path, answers: Path) -> None:
    """No shipped law reads ``operate`` and ``fresh``; the one in ``file`` does (tests/operated_laws.py)."""
    vectors = json.loads((kit_of(file) / VECTORS).read_text())
    given = [row["given"] for row in vectors["steps"]]
    assert len({tuple(row["operate"]) for row in given}) > 100
    assert len({tuple(row["fresh"]) for row in given}) == 4
    done = run("--conformance", kit_of(file), answers)
    assert done.returncode == 0, done.stdout + done.stderr
    verdict = verdict_on(file, answers)
    assert verdict.identical, verdict.text()
    copy = kit_of(file) / file.name
    for u0, u1 in map(mvs_of, run(copy, "20", "0.02", "u0.high=0.2", "u0.low=-0.1", "u1.use=0").stdout.splitlines()):
        assert -0.1 <= u0 <= 0.2
        assert u1 == 0  # where it stands
    for words in NOT_ALLOWED:
        done = run(copy, "1", "0.02", *words.split())
        assert (done.returncode, done.stdout) == (2, ""), words
        assert done.stderr.startswith("error: ")
        assert done.stderr.count("\n") == 1


NOT_ALLOWED = (
    "u0.high=2", "u0.use=0.5", "u0.low=0.5 u0.high=0.2", "y0.rank=9", "y0.rank=nan", "speed=0", "u9.use=0", "u0.low",
)  # fmt: skip


def mvs_of(line: str) -> tuple[float, float]:
    """The two MVs of a line of a host's loop: scan, lateness, ms late, mode, MVs."""
    words = line.replace(",", " ").split()
    assert words[4] == "AUTO", line
    return float(words[5]), float(words[6])


def fails_on_a_damaged_kit(run: Run, damage: str, differences: str, folder: Path) -> None:
    """``differences``: the largest difference in one step and chained, and how many answers are wrong."""
    done = run("--conformance", spoilt(PID, folder, DAMAGES[damage]))
    assert done.returncode == 1, done.stdout + done.stderr
    assert re.search(f"largest difference {differences} wrong", done.stdout), done.stdout


def refuses_an_old_kit(run: Run, folder: Path) -> None:
    """One line says what to do."""
    done = run("--conformance", spoilt(PID, folder, an_old_version))
    assert (done.returncode, done.stdout) == (2, ""), done.stdout + done.stderr
    wanted = "the kit has the version 3, not 6: write it again with loopwright conformance FILE.onnx KIT"
    assert done.stderr == f"error: {wanted}\n"


def scans_of_a_loop(run: Run) -> list[list[str]]:
    """Words of each scan of a loop of 40 scans at most, 20 ms apart: scan, lateness [ms], ..., mode, MV."""
    done = run(kit_of(PID) / "pid.onnx", "40", "0.02")
    assert done.returncode == 0, done.stderr
    rows = [line.split() for line in done.stdout.splitlines()]
    places = [int(row[0]) for row in rows]
    assert places == sorted(set(places))  # a busy machine leaves some out, also at the start
    assert places[0] >= 0
    assert len(places) > 1
    assert all(0 <= float(row[1]) < 20 for row in rows)  # a later scan is one of the next period
    assert {row[4] for row in rows} == {"AUTO"}
    return rows


def wrong_file(what: str, folder: Path) -> Path:
    """A controller file in ``folder`` that a host must refuse, by itself or by the manifest beside it."""
    for suffix in (".onnx", ".json"):
        shutil.copy(kit_of(PID) / f"pid{suffix}", folder)
    file, manifest = folder / "pid.onnx", folder / "pid.json"
    text = manifest.read_text()
    {
        "cut": lambda: manifest.write_text(text[:700]),
        "foreign": lambda: shutil.copy(next(f for f in SHIPPED if f.stem == "inc").with_suffix(".json"), manifest),
        "changed": lambda: file.write_bytes(file.read_bytes() + b"x"),
        "schema": lambda: manifest.write_text(text.replace('"schema": 1', '"schema": 2')),
        "sizes": lambda: manifest.write_text(text.replace('"n_state": 7', '"n_state": 8')),
        "range": lambda: manifest.write_text(text.replace('"high": 500.0', '"high": 5000.0')),
        "unlimited": lambda: manifest.write_text(text.replace('"high": 500.0', '"high": 500.0, "max_move": 1')),
        "without": lambda: manifest.write_text(text.replace('"pv": [', '"PV": [')),
        "missing": manifest.unlink,
    }[what]()
    return file


def refuses_in_one_line(run: Run, file: Path, words: str) -> None:
    """A file that is not right."""
    done = run(file, "1", "0.01")
    assert (done.returncode, done.stdout) == (2, ""), done.stdout + done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
