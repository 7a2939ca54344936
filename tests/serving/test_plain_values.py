"""Values that somebody wrote: integers that Python itself cannot print, lists that nobody can walk."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from shipped_files import SHIPPED

from loopwright.serving import ArtifactError, Controller, LoopError
from loopwright.serving.controller_file import difference, file_digest, sidecar
from loopwright.serving.fields import LONGEST_SHOWN, MAX_DIGITS, parse, refused, shown
from loopwright.serving.manifest import MAX_CHARACTERS, Manifest, strictly
from loopwright.serving.station.settings import Settings

LONG = 16**5001
DEEP: list[Any] = []
for _ in range(100_000):
    DEEP = [DEEP]


@pytest.mark.parametrize(
    "value", [LONG, -LONG, [LONG], {"a": {"b": LONG}}, DEEP, "x" * 10_000, "\n\u202e\x1b"], ids=type
)
def test_any_value_can_be_shown_in_one_short_line(value: Any) -> None:
    text = shown(value)
    assert text.isprintable()
    assert len(text) <= LONGEST_SHOWN + 3


def test_too_deep_and_too_long_are_refused_at_any_place() -> None:
    assert refused({"a": [{"b": 10**MAX_DIGITS}]}, 3) == ""
    assert "digits" in refused({"a": [{"b": 10 ** (MAX_DIGITS + 1)}]}, 3)
    assert "digits" in refused([-(10 ** (MAX_DIGITS + 1))], 3)
    assert refused([[[0]]], 3) == ""
    assert "3 deep" in refused([[[[0]]]], 3)
    assert "3 deep" in refused(DEEP, 3)


@dataclass(frozen=True)
class Wanted:
    number: float = 1.0
    text: str = ""
    word: Literal["a", "b"] = "a"
    numbers: tuple[float, ...] = ()


@pytest.mark.parametrize("key", ["number", "text", "word", "numbers", LONG], ids=type)
def test_a_setting_of_thousands_of_digits_is_one_error(key: Any) -> None:
    with pytest.raises(LoopError) as caught:
        parse(Wanted, {key: LONG}, "loop.toml", LoopError)
    assert len(str(caught.value)) < 250


@pytest.mark.parametrize("line", ["speed = 0x", "hold = { recover_after = 0x", "unknown = [0b1", "start = 0x"])
def test_a_loop_toml_with_such_an_integer_is_one_error(line: str, tmp_path: Path) -> None:
    ends = {"hold": " }", "unknown": "]"}
    text = f'controller = "a.onnx"\n{line}{"1" * 5001}{ends.get(line.partition(" ")[0], "")}\n'
    (tmp_path / "loop.toml").write_text(text)
    with pytest.raises(LoopError, match="an integer of more than 300 digits"):
        Settings.read(tmp_path / "loop.toml")


def test_the_own_sidecar_of_a_long_manifest_is_its_manifest() -> None:
    """Indented it is longer than a manifest may be."""
    given = json.loads(Controller(SHIPPED[0]).manifest.to_json())
    deep: Any = [1] * 30_000
    for _ in range(17):
        deep = [deep]
    given["evidence"] = {"a": deep}
    manifest = Manifest.from_json(json.dumps(given))
    text = sidecar(manifest, file_digest(b""))
    assert len(text) > MAX_CHARACTERS
    assert difference(text.encode(), manifest, file_digest(b"")) == ""
    assert difference(text.replace("1", "2", 1).encode(), manifest, file_digest(b"")) != ""
    with pytest.raises(ArtifactError, match="characters"):
        strictly(text)
