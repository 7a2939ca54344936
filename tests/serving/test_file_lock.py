"""A lock that nobody else has, and what is said of one that cannot be had."""

from __future__ import annotations

import errno
import fcntl
import os
import sys
from pathlib import Path

import pytest

from loopwright.serving.errors import LoopError
from loopwright.serving.journal import Journal
from loopwright.serving.journal.file import LockTakenError, locked
from loopwright.serving.station.mv_lock import Lease

NODE, ENDPOINT = "ns=2;s=MV.u", "opc.tcp://127.0.0.1:4841"


def refuse(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)


def test_a_lock_names_who_has_it_and_is_free_once_it_is_closed(tmp_path: Path) -> None:
    handle = locked(tmp_path / "lock")
    with pytest.raises(LockTakenError, match=f"is locked by process {os.getpid()}") as taken:
        locked(tmp_path / "lock")
    assert taken.value.owner == str(os.getpid())
    os.close(handle)
    os.close(locked(tmp_path / "lock"))


def test_a_lock_that_cannot_be_had_is_no_lost_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full table of locks, or a file that cannot be opened: nobody else writes the plant for that."""
    lease = Lease(ENDPOINT, [NODE], tmp_path / "locks")
    lease._path(NODE).unlink()
    with monkeypatch.context() as patch:
        refuse(errno.ENOLCK, patch)
        with pytest.raises(OSError, match="No locks available"):
            lease.tend()
        assert lease.lost == ""
        with pytest.raises(LoopError, match=r"loop.journal.lock cannot be opened or locked: No locks available"):
            Journal(tmp_path / "loop.journal")
    lease.tend()
    lease.release()


def test_handles_do_not_stay_open_after_a_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = len(os.listdir("/dev/fd"))
    refuse(errno.ENOLCK, monkeypatch)
    with pytest.raises(OSError, match="No locks available"):
        locked(tmp_path / "lock")
    refuse(errno.EWOULDBLOCK, monkeypatch)
    with pytest.raises(LockTakenError):
        locked(tmp_path / "lock")
    assert len(os.listdir("/dev/fd")) == before


def test_a_system_without_such_locks_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fcntl", None)
    with pytest.raises(LoopError, match="files are locked on Linux and macOS; on Windows run the loop in WSL"):
        locked(tmp_path / "lock")
    assert not (tmp_path / "lock").exists()


def test_a_file_system_that_numbers_files_anew_still_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os.path, "samestat", lambda *_: False)
    handle = locked(tmp_path / "lock")
    with pytest.raises(LockTakenError):
        locked(tmp_path / "lock")
    os.close(handle)
