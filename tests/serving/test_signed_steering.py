"""A loop with trusted keys: at its start, by a swap and on its page only signed controllers are loaded."""

from __future__ import annotations

import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from fake_loop import Browser
from plant_servers import RunningLoop
from processes import within

from loopwright.pipeline.__main__ import main
from loopwright.serving import LoopError
from loopwright.serving.page.app import candidates
from loopwright.serving.station.control import ask
from loopwright.serving.station.settings import Settings
from loopwright.serving.trust import signer

pytest_plugins = ["signed_files", "signed_loop"]


def said(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    capsys.readouterr()
    status = main(["loop", *words])
    both = capsys.readouterr()
    return status, both.out + both.err


def test_a_loop_says_by_whom_its_controller_is_signed(trusting: Path, trusting_loop: RunningLoop) -> None:
    start = "started in SHADOW; pid.onnx is signed by anna (key "
    assert within(20, lambda: any(start in event for event in trusting_loop.events()))


def test_the_check_of_a_loop_says_it_too(trusting: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, text = said(capsys, "check", str(trusting))
    assert "pid.onnx: signed by anna (key " in text
    assert "neither sha256 nor trusted" not in text
    assert status == 0


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("incad.onnx", "which is not trusted; trusted: anna"),
        ("incadec.onnx", "it is not signed: there is no incadec.onnx.sig"),
    ],
)
def test_a_swap_to_a_file_that_is_not_trusted_is_refused(
    trusting: Path, trusting_loop: RunningLoop, capsys: pytest.CaptureFixture[str], file: str, words: str
) -> None:
    status, text = said(capsys, "swap", str(trusting.parent / file), "--loop", str(trusting))
    assert status == 2
    assert words in text
    assert text.count("\n") == 1
    state = ask(trusting_loop.settings.journal.file, {"do": "state"})
    assert state["successor"] is None


def test_the_page_offers_and_takes_trusted_controllers_only(trusting_loop: RunningLoop) -> None:
    page = trusting_loop.station.page
    assert page is not None
    browser = Browser(urlsplit(page.url).port or 0, page.token)
    about = browser.json("/api/about")
    assert "trusted" not in about  # where the keys lie is nobody's business there
    assert about["card"]["signed"]["name"] == "anna"
    assert len(about["card"]["signed"]["fingerprint"]) == 64
    (other,) = about["candidates"]
    assert other["file"] == "inverse_dob.onnx"
    assert other["signed"].startswith("anna (key ")
    request = {"do": "swap", "who": "carl", "value": {"file": "incad.onnx", "trial": 3}}
    status, answer = browser.change(request)
    assert status == 409
    assert "which is not trusted" in answer["error"]


def test_a_key_that_is_exchanged_while_the_loop_runs_lets_nobody_in(
    trusting: Path, trusting_loop: RunningLoop, keys: Path
) -> None:
    """The keys are read at the start, so who can write their files must also restart the loop."""
    shutil.copy(keys / "bob.pub", trusting.parent / "anna.pub")
    try:
        with pytest.raises(LoopError, match="which is not trusted; trusted: anna"):
            ask(trusting_loop.settings.journal.file, {"do": "swap", "who": "eve", "value": {"file": "incad.onnx"}})
    finally:
        shutil.copy(keys / "anna.pub", trusting.parent / "anna.pub")


def test_a_swap_to_a_trusted_file_is_written_down_with_its_signer(trusting: Path, trusting_loop: RunningLoop) -> None:
    journal = trusting_loop.settings.journal.file
    done = ask(journal, {"do": "swap", "who": "carl", "value": {"file": "inverse_dob.onnx", "trial": 3}})
    assert "signed by anna (key " in done["done"]
    assert within(20, lambda: ask(journal, {"do": "about"})["card"]["law"] == "inverse_dob")
    assert ask(journal, {"do": "about"})["card"]["signed"]["name"] == "anna"


@pytest.mark.parametrize(("days", "told"), [(40, 0), (20, 1), (-1, 1)])
def test_the_operator_sees_before_it_that_a_signature_ends(
    trusting_loop: RunningLoop, monkeypatch: pytest.MonkeyPatch, days: int, told: int
) -> None:
    assert within(20, lambda: trusting_loop.station.snapshot is not None)
    loop, journal = trusting_loop.station.loop, trusting_loop.settings.journal.file
    assert loop is not None
    signed = signer(loop.controller)
    assert signed is not None
    end = datetime.now(UTC) + timedelta(days=days)
    monkeypatch.setattr(loop.controller, "signed", replace(signed, expires=end))
    for view in ("about", "state"):
        lines = [line for line in ask(journal, {"do": view})["warnings"] if "signature" in line]
        assert len(lines) == told
        assert all(f"{end:%Y-%m-%d}" in line and "have the file signed again" in line for line in lines)


@pytest.mark.parametrize("action", ["check", "run"])
@pytest.mark.parametrize("law", ["incad", "incadec"])
def test_a_loop_does_not_start_with_a_file_that_is_not_trusted(
    trusting: Path, capsys: pytest.CaptureFixture[str], action: str, law: str
) -> None:
    path = trusting.with_name(f"{law}-{action}.toml")
    text = trusting.read_text().replace('"pid.onnx"', f'"{law}.onnx"')
    path.write_text(text.replace('page = "127.0.0.1:0"', "").replace("loop.journal", f"{law}.journal"))
    status, line = said(capsys, action, str(path))
    assert status == 2
    assert line.count("\n") == 1
    assert "not trusted" in line or "not signed" in line


@pytest.mark.parametrize(
    ("trusted", "words"),
    [("[]", "trusted names no public key"), ('"anna.pub"', "it must be a list"), ("[1]", "must be of type Path")],
)
def test_a_mistake_in_trusted_is_one_clear_error(trusting: Path, trusted: str, words: str) -> None:
    path = trusting.with_name("mistake.toml")
    path.write_text(trusting.read_text().replace('trusted = ["anna.pub"]', f"trusted = {trusted}"))
    with pytest.raises(LoopError, match=words):
        Settings.read(path)


def test_without_trusted_keys_every_controller_is_offered(trusting: Path) -> None:
    rows = candidates(trusting.parent / "pid.onnx")
    assert [row["file"] for row in rows] == ["incad.onnx", "incadec.onnx", "inverse_dob.onnx"]
    assert [row["signed"] for row in rows] == [None] * 3
