"""Signed controller files of the tests' own. Loaded by ``pytest_plugins``, not imported."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from signing_parts import NOW

from loopwright.serving.signing.keys import PrivateKey, PublicKey, make_pair
from loopwright.serving.signing.sign import sign


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the pairs anna (P-256), bob (P-256) and eve (Ed25519)."""
    folder = tmp_path_factory.mktemp("keys")
    for name in ("anna", "bob"):
        make_pair(folder / f"{name}.key", "p256", None)
    make_pair(folder / "eve.key", "ed25519", None)
    return folder


@pytest.fixture
def private(keys: Path) -> Callable[[str], PrivateKey]:
    return lambda name: PrivateKey.read(keys / f"{name}.key", None)


@pytest.fixture
def public(keys: Path) -> Callable[[str], PublicKey]:
    return lambda name: PublicKey.read(keys / f"{name}.pub")


@pytest.fixture
def unsigned(pi_file: Path, tmp_path: Path) -> Path:
    """A controller and its manifest's JSON file in a folder of their own."""
    folder = tmp_path / "deployed"
    folder.mkdir()
    shutil.copy(pi_file.with_suffix(".json"), folder)
    return Path(shutil.copy(pi_file, folder))


@pytest.fixture
def signed(unsigned: Path, private: Callable[[str], PrivateKey]) -> Path:
    """Signed by anna, for ever."""
    sign(unsigned, private("anna"), now=NOW)
    return unsigned
