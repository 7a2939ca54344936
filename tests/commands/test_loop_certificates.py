"""Who trusts whom: a server that does not know the loop, a loop that expects another server, and certificates' ends."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from plant_servers import Plant, RunningLoop
from processes import within

from loopwright.pipeline.__main__ import main
from loopwright.serving import LoopError
from loopwright.serving.opcua.certificates import Expiry, make, valid_until

PID = Path(__file__).parents[2] / "artifacts" / "thiosulfate_cstr" / "pid.onnx"


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    made = Plant(tmp_path_factory.mktemp("plant"), "thiosulfate_cstr", 5.0, "--only-trusted")
    made.start()
    yield made
    made.end()


@pytest.fixture
def settings(plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    assert main(["loop", "init", str(PID), "--endpoint", plant.endpoint]) == 0
    path = tmp_path / "loop.toml"
    path.write_text(path.read_text().replace('page = "127.0.0.1:8080"', "speed = 5.0"))
    return path


def said(capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    capsys.readouterr()
    status = main(["loop", "check"])
    found = capsys.readouterr()
    return status, found.err if status else found.out


def test_a_server_that_does_not_trust_the_loop_and_then_does(
    plant: Plant, settings: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, words = said(capsys)
    assert status == 2
    assert words.count("\n") == 1
    assert "let the server trust" in words
    assert "loop-certificate.der" in words
    # A loop that runs meanwhile goes on trying, and connects once it is trusted.
    text = settings.read_text()
    settings.write_text(text.replace("[server]", "[server]\nconnect_s = 2.0", 1))
    loop = RunningLoop(settings)
    try:
        assert within(20, lambda: any("let the server trust" in line for line in loop.told))
        plant.end()
        shutil.copy(settings.parent / "loop-certificate.der", plant.folder / "server" / "trusted")
        plant.start()
        assert within(30, lambda: loop.station.endpoint.connections > 0)
        status, words = said(capsys)
        assert status == 0
        assert (
            f"note: certificate of this loop: valid until {valid_until(settings.parent / 'loop-certificate.der')}"
            in words
        )
        assert "note: certificate of the server: valid until" in words
        # Another server than the pinned one.
        settings.write_text(
            text.replace('# server_certificate = "server.der"', 'server_certificate = "loop-certificate.der"')
        )
        status, words = said(capsys)
        assert status == 2
        assert words.count("\n") == 1
        assert "server_certificate" in words
        settings.write_text(
            text.replace(
                '# server_certificate = "server.der"',
                f'server_certificate = "{plant.folder / "server" / "certificate.der"}"',
            )
        )
        assert said(capsys)[0] == 0
    finally:
        loop.end()


def test_a_certificate_that_has_ended_is_named(settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    expired(settings.parent / "loop-certificate.der", settings.parent / "loop-key.pem")
    status, words = said(capsys)
    assert status == 2
    assert words.count("\n") == 1
    assert "loop-certificate.der was valid until 2021-01-02" in words
    assert "`loopwright loop init CONTROLLER --out spare.toml` makes new ones" in words


def test_a_certificate_that_ends_soon_is_told_while_the_loop_runs() -> None:
    end = datetime(2027, 3, 1, tzinfo=UTC)
    own = Expiry("loop", end)
    assert own.words(end - timedelta(days=31)) == ""
    assert own.words(end - timedelta(days=29)).startswith("the loop's certificate ends on 2027-03-01; ")
    assert own.words(end + timedelta(days=1)).startswith("the loop's certificate ended on 2027-03-01; ")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("", "give both user_certificate and user_key"),
        ('user_key = "loop-key.pem"\nuser = "anna"\npassword_env = "X"', "a session has one user"),
        ('user_key = "none.pem"', "none.pem cannot be read: No such file"),
        ('user_key = "loop-certificate.der"', "loop-certificate.der is no private key"),
        ('user_key = "another-key.pem"', "another-key.pem is not the key of"),
        ('user_key = "locked-key.pem"', "locked-key.pem is locked by a pass phrase"),
        ('user_key = "curve-key.pem"', "curve-key.pem is no RSA key"),
    ],
)
def test_a_user_whose_certificate_is_of_no_use_is_one_line(
    settings: Path, capsys: pytest.CaptureFixture[str], given: str, words: str
) -> None:
    folder = settings.parent
    make(folder / "another.der", folder / "another-key.pem")
    own = serialization.load_pem_private_key((folder / "loop-key.pem").read_bytes(), None)
    curve = ec.generate_private_key(ec.SECP256R1())
    locked = serialization.BestAvailableEncryption(b"a secret")
    for name, key, lock in (
        ("locked-key.pem", own, locked), ("curve-key.pem", curve, serialization.NoEncryption()),
    ):  # fmt: skip
        form = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8)
        (folder / name).write_bytes(key.private_bytes(*form, lock))
    text = settings.read_text().replace("[server]", f'[server]\nuser_certificate = "loop-certificate.der"\n{given}')
    settings.write_text(text)
    status, said_now = said(capsys)
    assert status == 2
    assert said_now.count("\n") == 1
    assert words in said_now


def expired(certificate: Path, key: Path) -> None:
    """The same certificate with an end long ago."""
    private = serialization.load_pem_private_key(key.read_bytes(), None)
    old = x509.load_der_x509_certificate(certificate.read_bytes())
    ended = datetime(2021, 1, 2, tzinfo=UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(old.subject)
        .issuer_name(old.issuer)
        .public_key(old.public_key())
        .serial_number(old.serial_number)
        .not_valid_before(ended - timedelta(days=365))
        .not_valid_after(ended)
    )
    for extension in old.extensions:
        builder = builder.add_extension(extension.value, extension.critical)
    made = builder.sign(private, hashes.SHA256())  # type: ignore[arg-type]
    certificate.write_bytes(made.public_bytes(serialization.Encoding.DER))


def test_what_is_no_certificate_is_named(tmp_path: Path) -> None:
    make(tmp_path / "a.der", tmp_path / "a.pem")
    assert valid_until(tmp_path / "a.der") > datetime.now(UTC).date().isoformat()
    (tmp_path / "b.der").write_bytes(b"no certificate")
    with pytest.raises(LoopError, match=r"b\.der is no certificate"):
        valid_until(tmp_path / "b.der")
    with pytest.raises(LoopError, match=r"c\.der cannot be read"):
        valid_until(tmp_path / "c.der")
