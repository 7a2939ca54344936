"""A real store: publish signs with the configured key, fetch verifies, and the registry shows who signed."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from urllib.parse import urlsplit

import made_up_case as made_up
import pytest
from made_up_case import CASE
from mlflow.entities.model_registry import ModelVersion

from loopwright.pipeline.__main__ import main as loopwright
from loopwright.pipeline.errors import TrackingError
from loopwright.pipeline.tracking import signing
from loopwright.pipeline.tracking.registry import versions
from loopwright.pipeline.tracking.runs import publish
from loopwright.pipeline.tracking.store import store
from loopwright.serving import Controller, SignatureError
from loopwright.serving.signing.keys import PublicKey, make_pair

pytest_plugins = ["signed_files"]
pytestmark = [
    # SQLAlchemy's complaint about a loader that mlflow's own tables use
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:sqlalchemy.exc.SADeprecationWarning"),
    # mlflow's complaint, at import, about its own type hints
    pytest.mark.filterwarnings("ignore:.*Any type hint is inferred as AnyType:UserWarning"),
]

SHIPPED = Path(__file__).parents[2] / "artifacts" / CASE
NAME = f"{CASE}-pid"
LAWS = {"pid": {"kind": "pid"}}
Fetched = tuple[int, str, str]


@pytest.fixture(scope="module")
def laid_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store made from nothing, once: mlflow takes seconds to lay its tables."""
    folder = tmp_path_factory.mktemp("store")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        with store() as client:
            assert not client.search_registered_models()
    return folder / "mlflow.db"


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, laid_store: Path) -> Path:
    """A folder with results of the shipped PID, and a store of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    for name in (signing.KEY, signing.PASSWORD, signing.PASSWORD_FILE, signing.DAYS, signing.TRUSTED):
        monkeypatch.delenv(name, raising=False)
    shutil.copy(laid_store, tmp_path)
    made_up.write_case(tmp_path, {"pid": made_up.QUALITY["pid"]})
    for suffix in (".onnx", ".json"):
        shutil.copy(SHIPPED / f"pid{suffix}", tmp_path / "artifacts" / CASE)
    made_up.write_lock(tmp_path, LAWS)
    made_up.write_json(tmp_path / "artifacts" / CASE / "validation.json", made_up.evidence({"pid": 1.4}))
    return tmp_path


def newest() -> ModelVersion:
    with store() as client:
        return versions(client, NAME)[0]


@pytest.fixture
def fetched(work: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Fetched]:
    """``fetched(*words)``: status, standard output and standard error of `registry fetch`."""

    def run(*words: str) -> Fetched:
        capsys.readouterr()
        status = loopwright(["registry", "fetch", f"{NAME}/1", "deploy", *words])
        said = capsys.readouterr()
        return status, said.out, said.err

    return run


def artifact(name: str) -> Path:
    """Where the store keeps a file of the version's run."""
    with store() as client:
        return Path(urlsplit(str(client.get_run(newest().run_id).info.artifact_uri)).path) / name


def test_publish_signs_and_fetch_verifies(
    work: Path, keys: Path, monkeypatch: pytest.MonkeyPatch, fetched: Callable[..., Fetched],
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setenv(signing.KEY, str(keys / "anna.key"))
    receipt = publish(work)
    fingerprint = PublicKey.read(keys / "anna.pub").fingerprint
    version = newest()
    assert (version.tags["signed_by"], version.tags["signed_key"]) == ("anna", fingerprint)
    assert f"<p>Signed by anna (key {fingerprint[:16]}).</p>" in version.description
    assert loopwright(["registry", "list"]) == 0
    assert f"signed by anna (key {fingerprint[:16]})" in capsys.readouterr().out

    status, out, err = fetched("--key", str(keys / "bob.pub"), str(keys / "anna.pub"))
    assert status == 0
    assert out.split() == ["deploy/pid.onnx", "deploy/pid.json", "deploy/pid.onnx.sig"]
    assert err.startswith("signed by anna (key ")
    assert err.endswith(": verified\n")
    assert Controller(work / "deploy" / "pid.onnx", trusted=[keys / "anna.pub"]).manifest.law == "pid"

    assert publish(work) == receipt  # the receipt of a stage holds no signature
    assert newest().last_updated_timestamp == version.last_updated_timestamp


def test_a_foreign_key_s_controller_is_not_fetched(
    work: Path, keys: Path, monkeypatch: pytest.MonkeyPatch, fetched: Callable[..., Fetched]
) -> None:
    monkeypatch.setenv(signing.KEY, str(keys / "bob.key"))
    publish(work)
    monkeypatch.setenv(signing.TRUSTED, str(keys / "anna.pub"))
    status, out, err = fetched()
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert f"{NAME} version 1: it is signed by the key" in err
    assert "which is not trusted; trusted: anna" in err
    assert not (work / "deploy").exists()


def test_an_unsigned_controller_is_fetched_only_if_nobody_asks(
    work: Path, keys: Path, fetched: Callable[..., Fetched]
) -> None:
    publish(work)
    assert not signing.words(newest().tags)
    (work / "deploy").mkdir()
    (work / "deploy" / "pid.onnx.sig").write_text("of another version")
    assert fetched() == (0, "deploy/pid.onnx\ndeploy/pid.json\n", "not signed\n")
    assert sorted(p.name for p in (work / "deploy").iterdir()) == ["pid.json", "pid.onnx"]
    status, _, err = fetched("--key", str(keys / "anna.pub"))
    assert status == 2
    assert f"{NAME} version 1: it is not signed" in err


def test_a_forged_file_in_the_store_is_refused_though_its_digest_was_forged_too(
    work: Path, keys: Path, monkeypatch: pytest.MonkeyPatch, fetched: Callable[..., Fetched]
) -> None:
    """Whoever can write the store can write its digests; the signature is what he cannot."""
    monkeypatch.setenv(signing.KEY, str(keys / "anna.key"))
    publish(work)
    forged = SHIPPED / "inverse_dob.onnx"
    shutil.copy(forged, artifact("pid.onnx"))
    shutil.copy(forged.with_suffix(".json"), artifact("pid.json"))
    with store() as client:
        client.set_model_version_tag(NAME, "1", "sha256", made_up.hashlib.sha256(forged.read_bytes()).hexdigest())
    status, _, err = fetched("--key", str(keys / "anna.pub"))
    assert status == 2
    assert "pid.onnx was changed since it was signed" in err
    assert fetched()[0] == 0  # so the store alone is no proof


def test_a_signature_that_is_gone_from_the_store_is_missed(
    work: Path, keys: Path, monkeypatch: pytest.MonkeyPatch, fetched: Callable[..., Fetched]
) -> None:
    monkeypatch.setenv(signing.KEY, str(keys / "anna.key"))
    publish(work)
    artifact("pid.onnx.sig").unlink()
    status, _, err = fetched()
    assert status == 2
    assert "pid.onnx.sig did not come from" in err


def test_a_key_that_is_configured_later_signs_what_stands_there_already(
    work: Path, keys: Path, monkeypatch: pytest.MonkeyPatch, fetched: Callable[..., Fetched]
) -> None:
    publish(work)
    monkeypatch.setenv(signing.KEY, str(keys / "anna.key"))
    publish(work)
    assert fetched("--key", str(keys / "anna.pub"))[0] == 0
    monkeypatch.setenv(signing.KEY, str(keys / "eve.key"))  # another maker: the signature is replaced
    publish(work)
    assert fetched("--key", str(keys / "eve.pub"))[0] == 0
    assert fetched("--key", str(keys / "anna.pub"))[0] == 2
    monkeypatch.delenv(signing.KEY)  # nobody: it stays
    publish(work)
    assert newest().tags["signed_by"] == "eve"
    assert "Signed by eve" in newest().description


def test_a_signature_is_made_anew_once_half_of_its_time_is_over(
    work: Path, keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(signing.KEY, str(keys / "anna.key"))
    monkeypatch.setenv(signing.DAYS, "100")
    publish(work)
    until = newest().tags["signed_until"]
    assert timedelta(days=99) < datetime.fromisoformat(until) - datetime.now(UTC) < timedelta(days=100)
    was = artifact("pid.onnx.sig").read_bytes()
    publish(work)
    assert artifact("pid.onnx.sig").read_bytes() == was
    late = (datetime.now(UTC) + timedelta(days=49)).isoformat()
    with store() as client:
        client.set_model_version_tag(NAME, "1", "signed_until", late)
    publish(work)
    assert artifact("pid.onnx.sig").read_bytes() != was
    assert newest().tags["signed_until"] >= until
    monkeypatch.delenv(signing.DAYS)
    publish(work)
    assert newest().tags["signed_until"] == signing.FOR_EVER


def test_a_key_with_a_password_signs_and_its_mistakes_are_one_line(
    work: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make_pair(tmp_path / "carl.key", "p256", b"open sesame")
    monkeypatch.setenv(signing.KEY, str(tmp_path / "carl.key"))
    with pytest.raises(SignatureError, match="has a password"):
        publish(work)
    monkeypatch.setenv(signing.PASSWORD, "wrong")
    capsys.readouterr()
    assert loopwright(["registry", "publish"]) == 2
    said = capsys.readouterr().err
    assert "its password is wrong" in said
    assert said.count("\n") == 1
    monkeypatch.setenv(signing.PASSWORD, "open sesame")
    monkeypatch.setenv(signing.DAYS, "soon")
    with pytest.raises(TrackingError, match="LOOPWRIGHT_SIGNING_DAYS is 'soon'"):
        publish(work)
    monkeypatch.delenv(signing.DAYS)
    publish(work)
    assert newest().tags["signed_by"] == "carl"
    said = capsys.readouterr().err
    assert "open sesame" not in said
    assert not [line for line in (tmp_path / "carl.key").read_text().splitlines()[1:-1] if line in said]
