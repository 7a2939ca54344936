"""A signature is of one key, of one file and its manifest, and of its time; everything else is refused in one line."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import re
import shutil
import stat
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from signing_parts import DAY_AFTER, NOW, edit_bundle, payload_of, sign_payload

from loopwright.pipeline.__main__ import main as loopwright
from loopwright.pipeline.export.controller_file import with_evidence
from loopwright.serving import ArtifactError, SignatureError
from loopwright.serving.controller_file import file_digest
from loopwright.serving.signing import bundle
from loopwright.serving.signing.keys import PrivateKey, PublicKey, make_pair
from loopwright.serving.signing.sign import sign
from loopwright.serving.signing.verify import Signed, signature_of, verified

pytest_plugins = ["small_laws", "signed_files"]
many = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
Private = Callable[[str], PrivateKey]
Public = Callable[[str], PublicKey]


def refused(path: Path, *keys: PublicKey, now: datetime = NOW, words: str) -> str:
    """The refusal, which is one line and names the file."""
    with pytest.raises(SignatureError, match=words) as error:
        verified(path, list(keys), now=now)
    text = str(error.value)
    assert "\n" not in text
    assert text.startswith(f"{path}: ")
    return text


# ---------------------------------------------------------------------- what holds
@pytest.mark.parametrize("name", ["anna", "eve"])
def test_what_one_key_signed_that_key_verifies(unsigned: Path, name: str, private: Private, public: Public) -> None:
    sign(unsigned, private(name), now=NOW, expires=DAY_AFTER)
    found = verified(unsigned, [public("bob"), public(name)], now=NOW)
    assert (found.name, found.fingerprint) == (name, public(name).fingerprint)
    assert found.sha256 == file_digest(unsigned.read_bytes())
    assert (found.signed, found.expires, found.files) == (NOW, DAY_AFTER, ("pi.json", "pi.onnx"))


def test_a_controller_without_its_json_file_is_signed_alone(unsigned: Path, private: Private, public: Public) -> None:
    unsigned.with_suffix(".json").unlink()
    sign(unsigned, private("anna"), now=NOW)
    assert verified(unsigned, [public("anna")], now=NOW).files == ("pi.onnx",)


def test_a_fingerprint_is_what_sha256sum_says_of_the_public_key_s_file(keys: Path, public: Public) -> None:
    assert public("anna").fingerprint == file_digest((keys / "anna.pub").read_bytes())


def test_a_signature_moves_with_its_files(signed: Path, tmp_path: Path, public: Public) -> None:
    moved = tmp_path / "elsewhere"
    shutil.copytree(signed.parent, moved)
    assert verified(moved / signed.name, [public("anna")], now=NOW).name == "anna"


# ---------------------------------------------------------------------- who
def test_an_unsigned_file_is_refused(unsigned: Path, public: Public) -> None:
    refused(unsigned, public("anna"), words=r"it is not signed: there is no pi\.onnx\.sig beside it")


def test_a_foreign_key_s_signature_is_refused_by_its_name(unsigned: Path, private: Private, public: Public) -> None:
    sign(unsigned, private("bob"), now=NOW)
    text = refused(unsigned, public("anna"), words="which is not trusted")
    assert public("bob").fingerprint[:16] in text
    assert public("anna").words in text


@pytest.mark.parametrize("hint", ["", "anna"])
def test_a_foreign_key_that_claims_to_be_a_trusted_one_is_refused(
    hint: str, unsigned: Path, private: Private, public: Public
) -> None:
    sign(unsigned, private("bob"), now=NOW)
    claimed = hint and public(hint).fingerprint
    edit_bundle(unsigned, lambda tree: tree["verificationMaterial"]["publicKey"].update(hint=claimed))
    refused(unsigned, public("anna"), words="forged or changed")


def test_a_signature_without_a_hint_is_tried_with_every_key(signed: Path, public: Public) -> None:
    edit_bundle(signed, lambda tree: tree["verificationMaterial"]["publicKey"].pop("hint"))
    assert verified(signed, [public("eve"), public("bob"), public("anna")], now=NOW).name == "anna"


def test_no_key_at_all_is_a_mistake(signed: Path) -> None:
    with pytest.raises(SignatureError, match="trusted names no public key"):
        verified(signed, [])
    with pytest.raises(SignatureError, match="must be a list"):
        verified(signed, "anna.pub")


# ---------------------------------------------------------------------- which file
def test_another_file_s_signature_is_refused(signed: Path, private: Private, public: Public) -> None:
    other = signed.with_name("other.onnx")
    with_evidence(signed, other, {"step": {"mae": 9.0}})
    sign(other, private("anna"), now=NOW)
    shutil.copy(signature_of(other), signature_of(signed))
    refused(signed, public("anna"), words=r"that of another file \(other.json, other.onnx\)")


def test_two_signed_files_cannot_change_places(signed: Path, private: Private, public: Public) -> None:
    other = signed.with_name("other.onnx")
    with_evidence(signed, other, {"step": {"mae": 9.0}})
    sign(other, private("anna"), now=NOW)
    for suffix in (".onnx", ".onnx.sig", ".json"):
        os.replace(signed.parent / f"other{suffix}", signed.parent / f"pi{suffix}")
    refused(signed, public("anna"), words="that of another file")


def test_a_link_to_another_controller_is_refused(signed: Path, public: Public) -> None:
    other = signed.with_name("other.onnx")
    with_evidence(signed, other, {"step": {"mae": 9.0}})
    signed.unlink()
    signed.symlink_to(other)
    refused(signed, public("anna"), words=r"pi\.onnx was changed since it was signed")


def test_a_link_to_the_signed_file_is_the_signed_file(signed: Path, public: Public) -> None:
    signed.rename(signed.with_name("stored"))
    signed.symlink_to("stored")
    assert verified(signed, [public("anna")], now=NOW).name == "anna"


@many
@given(data=st.data())
def test_any_changed_byte_of_the_controller_is_noticed(signed: Path, public: Public, data: st.DataObject) -> None:
    whole = signed.read_bytes()
    at, bits = data.draw(st.integers(0, len(whole) - 1)), data.draw(st.integers(1, 255))
    signed.write_bytes(whole[:at] + bytes([whole[at] ^ bits]) + whole[at + 1 :])
    try:
        refused(signed, public("anna"), words=r"pi\.onnx was changed since it was signed")
    finally:
        signed.write_bytes(whole)


def test_the_manifest_s_json_file_must_be_the_signed_one(signed: Path, public: Public) -> None:
    sidecar = signed.with_suffix(".json")
    text = sidecar.read_text()
    sidecar.write_text(text.replace("valve", "velve"))
    refused(signed, public("anna"), words=r"pi\.json was changed since it was signed")
    sidecar.unlink()
    refused(signed, public("anna"), words=r"pi\.json was signed but is not there")


def test_a_json_file_that_nobody_signed_is_refused(unsigned: Path, private: Private, public: Public) -> None:
    sidecar = unsigned.with_suffix(".json")
    text = sidecar.read_text()
    sidecar.unlink()
    sign(unsigned, private("anna"), now=NOW)
    sidecar.write_text(text)
    refused(unsigned, public("anna"), words=r"pi\.json lies beside it and is not signed")


# ---------------------------------------------------------------------- until when
def test_a_signature_ends_with_its_last_second(unsigned: Path, private: Private, public: Public) -> None:
    sign(unsigned, private("anna"), now=NOW, expires=DAY_AFTER)
    assert verified(unsigned, [public("anna")], now=DAY_AFTER).expires == DAY_AFTER
    late = DAY_AFTER + timedelta(seconds=1)
    refused(
        unsigned, public("anna"), now=late, words=r"expired on 2026-05-02 12:00 UTC .*ask its maker to sign it anew"
    )


@pytest.mark.parametrize(
    ("left", "words"),
    [
        (timedelta(days=31), ""),
        (timedelta(days=29), "ends on 2027-01-31; after that a loop runs on, but none starts"),
        (timedelta(days=-2), "ended on 2027-01-31; after that a loop runs on, but none starts"),
    ],
)
def test_a_signature_that_ends_soon_says_so(
    unsigned: Path, private: Private, public: Public, left: timedelta, words: str
) -> None:
    expires = datetime(2027, 1, 31, 23, 59, 59, tzinfo=UTC)
    sign(unsigned, private("anna"), now=NOW, expires=expires)
    found = verified(unsigned, [public("anna")], now=NOW)
    said = found.ending(expires - left)
    assert words in said
    assert bool(said) == bool(words)
    sign(unsigned, private("anna"), now=NOW)
    assert verified(unsigned, [public("anna")], now=NOW).ending(expires) == ""  # for ever


def test_a_time_of_another_zone_is_written_as_the_same_instant_in_utc(
    unsigned: Path, private: Private, public: Public
) -> None:
    """And a time without a zone, which could be any instant of a day, is refused."""
    lima = timezone(timedelta(hours=-5))
    sign(unsigned, private("anna"), now=NOW.astimezone(lima), expires=datetime(2027, 1, 31, 12, 0, tzinfo=lima))
    found = verified(unsigned, [public("anna")], now=NOW)
    assert (found.signed, found.expires) == (NOW, datetime(2027, 1, 31, 17, 0, tzinfo=UTC))
    with pytest.raises(SignatureError, match=r"expires is 2027-01-31 00:00:00, without a time zone; give one"):
        sign(unsigned, private("anna"), now=NOW, expires=datetime(2027, 1, 31))
    with pytest.raises(SignatureError, match=r"now is 2026-01-31 00:00:00, without a time zone"):
        sign(unsigned, private("anna"), now=datetime(2026, 1, 31))
    past = datetime(2020, 1, 31, 12, 0, tzinfo=lima)
    with pytest.raises(SignatureError, match="would have expired on 2020-01-31 17:00 UTC"):
        sign(unsigned, private("anna"), now=NOW, expires=past)


def test_a_clock_before_the_signature_cannot_tell_whether_it_expired(
    unsigned: Path, private: Private, public: Public
) -> None:
    sign(unsigned, private("anna"), now=NOW, expires=DAY_AFTER)
    refused(unsigned, public("anna"), now=NOW - timedelta(days=300), words="set the clock")


def test_an_expiry_that_was_taken_off_is_a_forgery(unsigned: Path, private: Private, public: Public) -> None:
    sign(unsigned, private("anna"), now=NOW, expires=DAY_AFTER)
    tree = payload_of(unsigned)
    del tree["predicate"]["loopwright"]["expires"]
    longer = base64.b64encode(json.dumps(tree).encode()).decode()
    edit_bundle(unsigned, lambda whole: whole["dsseEnvelope"].update(payload=longer))
    refused(unsigned, public("anna"), now=DAY_AFTER + timedelta(days=1), words="forged or changed")


# ---------------------------------------------------------------------- which format
@many
@given(data=st.data())
def test_a_changed_byte_of_the_signature_never_makes_another_truth(
    signed: Path, public: Public, data: st.DataObject
) -> None:
    truth = verified(signed, [public("anna")], now=NOW)
    whole = signature_of(signed).read_bytes()
    at, byte = data.draw(st.integers(0, len(whole) - 1)), data.draw(st.binary(min_size=0, max_size=3))
    signature_of(signed).write_bytes(whole[:at] + byte + whole[at + 1 :])
    found: Signed | None = None
    with contextlib.suppress(SignatureError):
        found = verified(signed, [public("anna")], now=NOW)
    signature_of(signed).write_bytes(whole)
    assert found in (None, truth)


@many
@given(share=st.floats(0, 0.99))
def test_a_truncated_signature_is_refused(signed: Path, public: Public, share: float) -> None:
    whole = signature_of(signed).read_bytes()
    signature_of(signed).write_bytes(whole[: int(share * len(whole))])
    try:
        refused(signed, public("anna"), words="truncated, or another format")
    finally:
        signature_of(signed).write_bytes(whole)


@many
@given(
    tree=st.recursive(
        st.none() | st.booleans() | st.integers() | st.text(max_size=5),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(
                    ["mediaType", "verificationMaterial", "publicKey", "dsseEnvelope", "signatures", "sig"]
                ),
                inner,
                max_size=4,
            )
        ),
        max_leaves=12,
    ),
    typed=st.booleans(),
)
def test_any_other_json_is_refused_in_one_line(signed: Path, public: Public, tree: Any, typed: bool) -> None:
    if typed and isinstance(tree, dict):
        tree["mediaType"] = bundle.MEDIA_TYPE
    signature_of(signed).write_text(json.dumps(tree))
    refused(signed, public("anna"), words="signature")


@many
@given(
    tree=st.recursive(
        st.none() | st.integers() | st.sampled_from(["files", "sha256", "pi.onnx", "ab" * 32]),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["name", "digest"]), inner),
        max_leaves=6,
    ),
    name=st.sampled_from(
        ["_type", "subject", "predicateType", "predicate", "resources", "serialization", "loopwright"]
    ),
)
def test_any_other_statement_is_refused_even_if_a_trusted_key_signed_it(
    signed: Path, private: Private, public: Public, tree: Any, name: str
) -> None:
    sign(signed, private("anna"), now=NOW)
    statement = payload_of(signed)
    part = statement if name in statement else statement["predicate"]
    part[name] = tree
    sign_payload(signed, private("anna"), statement)
    if name == "loopwright" and tree == {}:
        assert verified(signed, [public("anna")], now=NOW).signed is None
    else:
        refused(signed, public("anna"), words="sign")


BUNDLES: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "v0.1": (lambda t: t.update(mediaType="application/vnd.dev.sigstore.bundle+json;version=0.1"), "mediaType"),
    "two lines": (
        lambda t: t.update(verificationMaterial={"a\nb": 1}),
        "made with ['a\\nb']; only signatures of keys",
    ),
    "hint of two lines": (lambda t: t["verificationMaterial"]["publicKey"].update(hint="a\nb"), "key hint"),
    "certificate": (
        lambda t: t.update(verificationMaterial={"certificate": {"rawBytes": "QQ=="}, "tlogEntries": []}),
        "made with ['certificate']; only signatures of keys",
    ),
    "message": (
        lambda t: t.update(messageSignature={"signature": t.pop("dsseEnvelope")["signatures"][0]["sig"]}),
        "no DSSE envelope",
    ),
    "payload": (lambda t: t["dsseEnvelope"].update(payloadType="text/plain"), "payloadType is 'text/plain'"),
    "two": (lambda t: t["dsseEnvelope"].update(signatures=2 * t["dsseEnvelope"]["signatures"]), "2 signatures"),
    "none": (lambda t: t["dsseEnvelope"].update(signatures=[]), "0 signatures"),
    "base64": (lambda t: t["dsseEnvelope"].update(payload="*"), "payload is no base64"),
    "long hint": (lambda t: t["verificationMaterial"]["publicKey"].update(hint="a" * 300), "key hint"),
}


@pytest.mark.parametrize("kind", BUNDLES)
def test_a_bundle_of_another_format_is_refused(signed: Path, public: Public, kind: str) -> None:
    change, words = BUNDLES[kind]
    edit_bundle(signed, change)
    refused(signed, public("anna"), words=re.escape(words))


STATEMENTS: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "older": (lambda t: t.update(predicateType="https://model_signing/Digests/v0.1"), "predicateType"),
    "slsa": (lambda t: t.update(predicateType="https://slsa.dev/provenance/v1"), "predicateType"),
    "shards": (lambda t: t["predicate"]["serialization"].update(method="shards"), "signed by 'shards'"),
    "blake3": (lambda t: t["predicate"]["resources"][0].update(algorithm="blake3"), "another algorithm"),
    "root": (lambda t: t["subject"][0]["digest"].update(sha256="0" * 64), "subject's digest"),
    "twice": (lambda t: t["predicate"].update(resources=2 * t["predicate"]["resources"]), "twice"),
    "strange": (lambda t: t["predicate"]["resources"][0].update(name="pi\nonnx"), "under a strange name"),
    "short": (lambda t: t["predicate"]["resources"][0].update(digest="ab"), "without a SHA-256"),
    "later": (lambda t: t["predicate"]["loopwright"].update(until="2030"), "entries of loopwright"),
    "no time": (lambda t: t["predicate"]["loopwright"].update(expires="tomorrow"), "the time 'tomorrow'"),
}


@pytest.mark.parametrize("kind", STATEMENTS)
def test_a_statement_of_another_kind_is_refused(signed: Path, private: Private, public: Public, kind: str) -> None:
    change, words = STATEMENTS[kind]
    tree = payload_of(signed)
    change(tree)
    sign_payload(signed, private("anna"), tree)
    refused(signed, public("anna"), words=re.escape(words))


@pytest.mark.parametrize("data", [b"[" * 200_000, b'{"mediaType": "a", "mediaType": "b"}', b"\xff", b"", b"1", b"NaN"])
def test_a_bundle_that_is_no_plain_json_is_refused(signed: Path, public: Public, data: bytes) -> None:
    signature_of(signed).write_bytes(data)
    refused(signed, public("anna"), words="JSON")


def test_a_huge_bundle_is_not_read(signed: Path, public: Public) -> None:
    with signature_of(signed).open("r+b") as file:
        file.truncate(50 * 2**30)  # a hole: it takes no disk, and would take all memory
    refused(signed, public("anna"), words="has more than the 1048576 bytes")


@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_what_is_no_regular_file_is_no_signature(signed: Path, public: Public, kind: str) -> None:
    place = signature_of(signed)
    place.unlink()
    {"pipe": os.mkfifo, "folder": os.mkdir, "device": lambda p: os.symlink("/dev/zero", p)}[kind](place)
    refused(signed, public("anna"), words="is no regular file|cannot be read")


@pytest.mark.parametrize("name", ["anna", "eve"])
@pytest.mark.parametrize("length", [0, 1, 63, 64, 65, 10_000])
def test_a_signature_of_any_other_length_is_refused(
    unsigned: Path, private: Private, public: Public, name: str, length: int
) -> None:
    sign(unsigned, private(name), now=NOW)
    zeros = base64.b64encode(bytes(length)).decode()
    edit_bundle(unsigned, lambda tree: tree["dsseEnvelope"]["signatures"][0].update(sig=zeros))
    refused(unsigned, public(name), words="forged or changed")


@pytest.mark.parametrize("place", [".", "/", "", "no\0file"])
def test_what_names_no_file_is_refused(place: str, public: Public, private: Private) -> None:
    with pytest.raises(SignatureError):
        verified(place, [public("anna")])
    with pytest.raises(SignatureError):
        sign(place, private("anna"))
    with pytest.raises(SignatureError):
        make_pair(Path(place), "p256", None)


# ---------------------------------------------------------------------- signing
def test_only_a_controller_is_signed(unsigned: Path, private: Private) -> None:
    unsigned.write_bytes(b"anything" * 100)
    with pytest.raises(ArtifactError, match="does not end with a Loopwright digest"):
        sign(unsigned, private("anna"))
    assert not signature_of(unsigned).exists()
    with pytest.raises(SignatureError, match="does not exist"):
        sign(unsigned.with_name("none.onnx"), private("anna"))


@pytest.mark.parametrize("text", ["", "{}", "[" * 100_000, '{"withheld": "it locks up"}'])
def test_a_json_file_that_is_not_the_manifest_is_not_signed(unsigned: Path, private: Private, text: str) -> None:
    unsigned.with_suffix(".json").write_text(text)
    with pytest.raises(SignatureError, match=r"pi\.json is not the manifest of pi\.onnx"):
        sign(unsigned, private("anna"))


def test_a_signature_cannot_begin_expired(unsigned: Path, private: Private) -> None:
    with pytest.raises(SignatureError, match="give a day to come"):
        sign(unsigned, private("anna"), now=DAY_AFTER, expires=NOW)


def test_signing_again_replaces_the_signature_as_a_whole(signed: Path, private: Private, public: Public) -> None:
    sign(signed, private("eve"), now=NOW)
    assert verified(signed, [public("eve")], now=NOW).kind == "ed25519"
    assert sorted(p.name for p in signed.parent.iterdir()) == ["pi.json", "pi.onnx", "pi.onnx.sig"]


# ---------------------------------------------------------------------- keys
def pem(key: Any) -> bytes:
    form = serialization.PublicFormat.SubjectPublicKeyInfo
    return bytes(key.public_key().public_bytes(serialization.Encoding.PEM, form))


def test_a_private_key_is_its_owner_s_alone_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        make_pair(tmp_path / "a.key", "p256", None)
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.key").stat().st_mode) == 0o600


def test_no_key_is_overwritten(tmp_path: Path) -> None:
    make_pair(tmp_path / "a.key", "p256", None)
    was = (tmp_path / "a.key").read_bytes()
    for name in ("a.key", "a.pem"):  # the second one's public key is a.pub too
        with pytest.raises(SignatureError, match="is there already"):
            make_pair(tmp_path / name, "p256", None)
    (tmp_path / "a.pub").unlink()
    with pytest.raises(SignatureError, match="is there already"):
        make_pair(tmp_path / "a.key", "p256", None)
    assert (tmp_path / "a.key").read_bytes() == was
    assert not (tmp_path / "a.pem").exists()


def test_a_key_that_others_may_read_is_not_used(tmp_path: Path) -> None:
    make_pair(tmp_path / "a.key", "p256", None)
    (tmp_path / "a.key").chmod(0o640)
    with pytest.raises(SignatureError, match="others may read it: chmod 600"):
        PrivateKey.read(tmp_path / "a.key", None)


@pytest.mark.parametrize("kind", ["p256", "ed25519"])
def test_a_password_is_needed_again(tmp_path: Path, kind: Any) -> None:
    make_pair(tmp_path / "a.key", kind, b"open sesame")
    assert b"ENCRYPTED" in (tmp_path / "a.key").read_bytes()
    for password, words in ((None, "has a password"), (b"sesame", "its password is wrong")):
        with pytest.raises(SignatureError, match=words):
            PrivateKey.read(tmp_path / "a.key", password)
    key = PrivateKey.read(tmp_path / "a.key", b"open sesame")
    assert PublicKey.read(tmp_path / "a.pub").fingerprint == key.public.fingerprint


def test_other_kinds_of_key_are_refused(tmp_path: Path, keys: Path) -> None:
    found = {"p384": ec.generate_private_key(ec.SECP384R1()), "rsa": rsa.generate_private_key(65537, 2048)}
    for name, key in found.items():
        (tmp_path / name).write_bytes(pem(key))
        with pytest.raises(SignatureError, match="allowed are P-256 and Ed25519"):
            PublicKey.read(tmp_path / name)
    with pytest.raises(SignatureError, match=r"is a private key; .*give the public one \(.*anna\.pub\)"):
        PublicKey.read(keys / "anna.key")
    with pytest.raises(SignatureError, match="is no private key"):
        PrivateKey.read(keys / "anna.pub", None)
    (tmp_path / "none").write_text("-----BEGIN PUBLIC KEY-----\nAAAA\n-----END PUBLIC KEY-----\n")
    with pytest.raises(SignatureError, match="is no public key in PEM form"):
        PublicKey.read(tmp_path / "none")
    with pytest.raises(SignatureError, match="does not exist"):
        PublicKey.read(tmp_path / "nobody.pub")


def test_a_key_s_secret_is_in_no_text_of_it(keys: Path, private: Private) -> None:
    inside = (keys / "anna.key").read_text().splitlines()[1]
    assert inside not in repr(private("anna")) + str(private("anna")) + repr(private("anna").public)


# ---------------------------------------------------------------------- the commands
def test_keygen_sign_and_verify_by_hand(
    unsigned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SIGN_WITH", "open sesame")
    (tmp_path / "word").write_text("open sesame\n")
    key, pub = str(tmp_path / "carl.key"), str(tmp_path / "carl.pub")
    assert loopwright(["keygen", key, "--password-env", "SIGN_WITH"]) == 0
    assert (
        loopwright(["sign", str(unsigned), "--key", key, "--days", "30", "--password-file", str(tmp_path / "word")])
        == 0
    )
    assert loopwright(["verify", str(unsigned), "--key", pub]) == 0
    said = capfd.readouterr()
    assert said.err == ""
    assert re.search(r"pi\.json and pi\.onnx: signed by carl \(key [0-9a-f]{16}\) on \d.*, until \d", said.out)
    secrets = [*Path(key).read_text().splitlines()[1:-1], "open sesame"]
    assert not [secret for secret in secrets if secret in said.out + said.err]


def test_what_goes_wrong_is_one_line_and_status_2(
    signed: Path, keys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("NO_SUCH_PASSWORD", raising=False)
    (tmp_path / "empty").write_text("\n")
    key = str(keys / "anna.key")
    for words, said in {
        ("verify", str(signed), "--key", str(keys / "bob.pub")): "which is not trusted",
        ("verify", str(signed), "--key", key): "is a private key",
        ("verify", str(signed), "--key", str(keys / "anna.pub"), "--signature", str(tmp_path / "x")): "is not signed",
        ("sign", str(signed), "--key", key, "--expires", "2001-01-01"): "would have expired",
        (
            "sign",
            str(signed),
            "--key",
            key,
            "--password-env",
            "NO_SUCH_PASSWORD",
        ): "NO_SUCH_PASSWORD must hold",
        (
            "sign",
            str(signed),
            "--key",
            key,
            "--password-file",
            str(tmp_path / "empty"),
        ): "empty must hold the key's password",
        ("keygen", key): "is there already",
        ("keygen", str(tmp_path / "none" / "a.key")): "cannot be written: No such file or directory",
        ("keygen", str(tmp_path / "a.pub")): "name the private key's",
    }.items():
        assert loopwright(list(words)) == 2, words
        line = capfd.readouterr().err
        assert line.count("\n") == 1, line
        assert said in line, line


def test_a_day_and_a_number_of_days_are_read_or_refused(signed: Path, keys: Path, public: Public) -> None:
    arguments = ["sign", str(signed), "--key", str(keys / "anna.key")]
    assert loopwright([*arguments, "--expires", "2099-12-31"]) == 0
    found: Signed = verified(signed, [public("anna")])
    assert found.expires is not None
    assert found.expires.isoformat() == "2099-12-31T23:59:59+00:00"
    for wrong in (["--expires", "31.12.2099"], ["--days", "0"], ["--days", "3", "--expires", "2099-01-01"]):
        with pytest.raises(SystemExit) as left:
            loopwright([*arguments, *wrong])
        assert left.value.code == 2
