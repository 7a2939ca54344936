"""Conformance kits of shipped controllers, whole and damaged, and the verdict on a host's answers."""

from __future__ import annotations

import atexit
import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from shipped_files import SHIPPED

from loopwright.serving import Controller
from loopwright.serving.conformance.kit import VECTORS, KitVerdict, check, write_kit

ROOT = Path(__file__).resolve().parents[1]
EMBED = ROOT / "examples" / "embed"
CASES = sorted({file.parent for file in SHIPPED})
# Of each case its first and its last file: different laws.
SOME = [file for case in CASES for file in sorted({min(case.glob("*.onnx")), max(case.glob("*.onnx"))})]


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
    k, row = next((k, row) for k, row in enumerate(vectors["scans"]) if row["unwritten"])
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
