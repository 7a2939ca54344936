"""The commands and the Python of docs/trust.md do what the page says."""

from __future__ import annotations

import re
import shlex
import shutil
import tomllib
from pathlib import Path

import pytest

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.tracking import signing
from loopwright.serving.station.settings import Settings

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = (DOCS / "trust.md").read_text(encoding="utf-8")
ARTIFACTS = DOCS.parent / "artifacts" / "thiosulfate_cstr"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def test_the_commands_and_the_python_of_the_page_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for suffix in (".onnx", ".json"):
        shutil.copy(ARTIFACTS / f"pid{suffix}", tmp_path)
    commands = [shlex.split(line, comments=True) for block in blocks("sh") for line in block.splitlines()]
    assert [words[1] for words in commands] == ["keygen", "sign", "verify", "inspect"]
    for words in commands:
        assert words[0] == "loopwright"
        assert main(words[1:]) == 0, words
    (code,) = blocks("python")
    capsys.readouterr()
    exec(compile(code, "trust.md", "exec"), {})
    assert re.fullmatch(
        r"anna \(key [0-9a-f]{16}\) on \d{4}-\d\d-\d\d, until \d{4}-\d\d-\d\d\n", capsys.readouterr().out
    )


def test_the_settings_of_the_page_are_settings() -> None:
    (text,) = blocks("toml")
    assert set(tomllib.loads(text)) <= set(Settings.__dataclass_fields__)


def test_every_variable_of_signing_is_on_the_page() -> None:
    names = {value for value in vars(signing).values() if isinstance(value, str) and value.startswith("LOOPWRIGHT_")}
    assert names
    assert names == set(re.findall(r"LOOPWRIGHT_[A-Z_]+", PAGE))
