"""Controller(path, trusted=...): the bytes that run are those that a trusted key signed."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from signing_parts import NOW, payload_of, sign_payload

import loopwright.serving.controller
from loopwright.pipeline.export.controller_file import with_evidence
from loopwright.serving import ArtifactError, Controller, LoopwrightError, SignatureError
from loopwright.serving.__main__ import main
from loopwright.serving.controller_file import file_digest
from loopwright.serving.signing import verify
from loopwright.serving.signing.keys import PrivateKey
from loopwright.serving.signing.sign import sign
from loopwright.serving.signing.verify import Signed, signature_of

pytest_plugins = ["small_laws", "signed_files"]


def test_a_trusted_file_is_loaded_and_says_who_signed_it(signed: Path, keys: Path) -> None:
    controller = Controller(signed, trusted=[keys / "bob.pub", str(keys / "anna.pub")])
    assert controller.signed is not None
    assert controller.signed.name == "anna"
    step = controller.step(sp=1.0, pv=[0.8, 300.0], mv_applied=40.0, state=controller.cold_state())
    assert np.array_equal(step.mv, Controller(signed).step(
        sp=1.0, pv=[0.8, 300.0], mv_applied=40.0, state=controller.cold_state()).mv)  # fmt: skip


def test_nobody_is_asked_unless_it_is_wanted(unsigned: Path) -> None:
    assert Controller(unsigned).signed is None


@pytest.mark.parametrize("attack", ["unsigned", "foreign", "changed", "expired", "truncated", "another's"])
def test_a_file_that_is_not_trusted_is_never_parsed(
    attack: str, signed: Path, keys: Path, private: Callable[[str], PrivateKey], monkeypatch: pytest.MonkeyPatch
) -> None:
    place = signature_of(signed)
    if attack == "unsigned":
        place.unlink()
    elif attack == "foreign":
        sign(signed, private("bob"))
    elif attack == "changed":
        signed.write_bytes(signed.read_bytes()[:-1] + b"0")
    elif attack == "expired":
        sign(signed, private("anna"), now=NOW.replace(year=2020), expires=NOW.replace(year=2021))
    elif attack == "truncated":
        place.write_bytes(place.read_bytes()[:200])
    else:
        other = signed.with_name("other.onnx")
        with_evidence(signed, other, {})
        os.replace(sign(other, private("anna")), place)
    parsed: list[str] = []
    for name in ("read_controller", "audit", "_manifest", "session_of"):
        monkeypatch.setattr(loopwright.serving.controller, name, lambda *_, name=name: parsed.append(name))
    with pytest.raises(SignatureError) as error:
        Controller(signed, trusted=[keys / "anna.pub"])
    assert "\n" not in str(error.value)
    assert parsed == []


def test_garbage_with_a_name_that_was_signed_is_refused_by_its_signature(signed: Path, keys: Path) -> None:
    signed.write_bytes(b"\0" * 100)
    with pytest.raises(SignatureError, match="changed since it was signed"):
        Controller(signed, trusted=[keys / "anna.pub"])


def test_a_file_put_there_after_the_signature_was_verified_is_refused(
    signed: Path, keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The race between verifying and loading, at its worst moment."""
    forged = signed.with_name("forged.onnx")
    with_evidence(signed, forged, {"step": {"mae": 0.0}})

    def swapped_after(path: Path, trusted: verify.Trusted) -> Signed:
        found = real(path, trusted)
        os.replace(forged, signed)
        return found

    real = verify.verified
    monkeypatch.setattr(verify, "verified", swapped_after)
    with pytest.raises(ArtifactError, match="not the pinned"):
        Controller(signed, trusted=[keys / "anna.pub"])


def test_whoever_keeps_exchanging_the_file_never_gets_a_forged_one_loaded(signed: Path, keys: Path) -> None:
    forged, kept = signed.with_name("forged"), signed.with_name("kept")
    with_evidence(signed, signed.with_name("forged.onnx"), {"step": {"mae": 0.0}})
    signed.with_name("forged.onnx").rename(forged)
    shutil.copy(signed, kept)
    truth, over = file_digest(kept.read_bytes()), threading.Event()

    def exchange() -> None:
        turn = 0
        while not over.is_set():
            link = signed.with_name(f"next{turn % 2}")
            os.link((forged, kept)[turn % 2], link)
            os.replace(link, signed)
            link.unlink(missing_ok=True)
            turn += 1

    attacker = threading.Thread(target=exchange)
    attacker.start()
    loaded, refusals = [], 0
    try:
        for _ in range(60):
            try:
                loaded.append(Controller(signed, trusted=[keys / "anna.pub"]).sha256)
            except ArtifactError:
                refusals += 1
    finally:
        over.set()
        attacker.join()
    assert set(loaded) <= {truth}
    assert refusals


def test_a_pin_and_a_signature_must_both_hold(signed: Path, keys: Path) -> None:
    digest, trusted = file_digest(signed.read_bytes()), [keys / "anna.pub"]
    assert Controller(signed, digest.upper(), trusted).sha256 == digest
    with pytest.raises(ArtifactError, match=f"is {digest}, not the pinned {'0' * 64}"):
        Controller(signed, "0" * 64, trusted)


def test_trust_in_nobody_loads_nothing(signed: Path) -> None:
    with pytest.raises(SignatureError, match="trusted names no public key"):
        Controller(signed, trusted=[])


def test_a_signed_file_that_no_controller_may_be_is_still_refused(
    signed: Path, keys: Path, private: Callable[[str], PrivateKey]
) -> None:
    """A signature says who made a file, not that it is good: the audit stands behind it."""
    whole = signed.read_bytes()
    signed.with_suffix(".json").unlink()
    sign(signed, private("anna"))
    text = signature_of(signed).read_text()
    signed.write_bytes(whole[:-1] + b"g")
    tree = payload_of(signed)
    digest = file_digest(signed.read_bytes())
    tree["predicate"]["resources"][0]["digest"] = digest
    tree["subject"][0]["digest"]["sha256"] = file_digest(bytes.fromhex(digest))
    sign_payload(signed, private("anna"), tree)
    assert signature_of(signed).read_text() != text
    with pytest.raises(LoopwrightError, match="was changed after export"):
        Controller(signed, trusted=[keys / "anna.pub"])


def test_the_card_says_who_signed(signed: Path, keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(signed), "--key", str(keys / "anna.pub")]) == 0
    assert "  signed    by anna (key " in capsys.readouterr().out
    assert main(["inspect", str(signed)]) == 0
    assert "  signed  " not in capsys.readouterr().out
    assert main(["inspect", str(signed), "--key", str(keys / "bob.pub")]) == 2
    assert "which is not trusted" in capsys.readouterr().err
