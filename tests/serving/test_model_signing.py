"""OpenSSF's own tool verifies our signatures, and we verify its: the format is the published one."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest
from signing_parts import NOW

from loopwright.serving import Controller, SignatureError
from loopwright.serving.signing.keys import PrivateKey, PublicKey
from loopwright.serving.signing.sign import sign
from loopwright.serving.signing.verify import signature_of, verified

pytest_plugins = ["small_laws", "signed_files"]
pytestmark = pytest.mark.skipif(find_spec("model_signing") is None, reason="model-signing is not installed: make setup")


def model_signing(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """The command of the package model-signing, in a process of its own."""
    command = [sys.executable, "-m", "model_signing", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def verify_there(model: Path, signature: Path, key: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return model_signing("verify", "key", model, "--signature", signature, "--public_key", key, *more)


def sign_there(model: Path, signature: Path, key: Path) -> None:
    done = model_signing("sign", "key", model, "--signature", signature, "--private_key", key)
    assert done.returncode == 0, done.stderr


def test_model_signing_verifies_our_signature(signed: Path, keys: Path) -> None:
    done = verify_there(signed.parent, signature_of(signed), keys / "anna.pub")
    assert done.returncode == 0, done.stderr
    assert "Verification succeeded" in done.stdout


def test_model_signing_verifies_one_of_many_controllers_in_a_folder(signed: Path, keys: Path) -> None:
    shutil.copy(signed, signed.with_name("other.onnx"))
    done = verify_there(signed.parent, signature_of(signed), keys / "anna.pub", "--ignore_unsigned_files")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("wrong", ["controller", "manifest", "key"])
def test_model_signing_refuses_what_we_refuse(
    signed: Path, keys: Path, public: Callable[[str], PublicKey], wrong: str
) -> None:
    if wrong == "controller":
        signed.write_bytes(signed.read_bytes() + b"\0")
    elif wrong == "manifest":
        signed.with_suffix(".json").write_text("{}")
    name = "bob" if wrong == "key" else "anna"
    with pytest.raises(SignatureError):
        verified(signed, [public(name)])
    assert verify_there(signed.parent, signature_of(signed), keys / f"{name}.pub").returncode != 0


def test_model_signing_ignores_our_expiry(
    unsigned: Path, keys: Path, private: Callable[[str], PrivateKey], public: Callable[[str], PublicKey]
) -> None:
    """docs/trust.md says so: the format has none, so only Loopwright refuses an expired file."""
    sign(unsigned, private("anna"), now=NOW.replace(year=2020), expires=NOW.replace(year=2021))
    with pytest.raises(SignatureError, match="expired on 2021"):
        verified(unsigned, [public("anna")])
    assert verify_there(unsigned.parent, signature_of(unsigned), keys / "anna.pub").returncode == 0


def test_we_verify_a_folder_that_model_signing_signed(unsigned: Path, keys: Path) -> None:
    sign_there(unsigned.parent, signature_of(unsigned), keys / "anna.key")
    controller = Controller(unsigned, trusted=[keys / "anna.pub"])
    assert controller.signed is not None
    assert controller.signed.files == ("pi.json", "pi.onnx")
    unsigned.with_suffix(".json").write_text("{}")
    with pytest.raises(SignatureError, match=r"pi\.json was changed"):
        Controller(unsigned, trusted=[keys / "anna.pub"])


def test_we_verify_a_file_that_model_signing_signed_alone(unsigned: Path, keys: Path) -> None:
    unsigned.with_suffix(".json").unlink()
    sign_there(unsigned, signature_of(unsigned), keys / "anna.key")
    assert verified(unsigned, [keys / "anna.pub"]).files == ("pi.onnx",)
    renamed = unsigned.rename(unsigned.with_name("other.onnx"))
    with pytest.raises(SignatureError, match=r"that of another file \(pi\.onnx\)"):
        verified(renamed, [keys / "anna.pub"], signature=signature_of(unsigned))
