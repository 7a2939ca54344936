"""Entries that are written into params.yaml: the rest of the text stays as it is."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from loopwright.pipeline.config.params import add_entries
from loopwright.pipeline.errors import ParamsError

TEXT = """# Settings.
cases:
  a: {seeds: [1, 2]} # of a

# The models.
models:
  # First.
  a-x:
    case: a
controllers: {}
"""
NEW = {
    "cases": {"b": {"seeds": [3]}},
    "models": {"b-x": {"case": "b", "parts": {"x": {"kind": "arx"}}}},
    "controllers": {"b-pid": {"law": "pid"}},
    "plants": {"b": {"title": "Kessel für Öl", "pv": [{"name": "TIC-101.PV", "unit": "degC"}]}},
}


def test_entries_stand_at_the_ends_of_their_sections_and_nothing_else_changes(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(TEXT, encoding="utf-8")
    add_entries(NEW, path)
    after = path.read_text(encoding="utf-8")
    assert yaml.safe_load(after) == {
        **{k: {**(yaml.safe_load(TEXT)[k] or {}), **NEW[k]} for k in list(NEW)[:3]},
        "plants": NEW["plants"],
    }
    left = iter(after.splitlines())
    assert all(line in left for line in TEXT.replace("controllers: {}", "controllers:").splitlines())
    assert after.index("  b:\n") < after.index("\n# The models.")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("tail", ["", "\n\n", "# the end"])
def test_every_byte_before_a_new_section_stays(end: str, tail: str, tmp_path: Path) -> None:
    before = (Path(__file__).parents[2] / "params.yaml").read_bytes() + tail.encode()
    before = before.replace(b"\n", end.encode())
    path = tmp_path / "params.yaml"
    path.write_bytes(before)
    add_entries({"plants": NEW["plants"]}, path)
    add_entries({"plants": {"second": {"period_s": 2}}}, path)
    after = path.read_bytes()
    assert after.startswith(before)
    assert after.replace(b"\r\n", b"").count(b"\n") == (0 if end == "\r\n" else after.count(b"\n"))
    assert list(yaml.safe_load(after)["plants"]) == ["b", "second"]


@pytest.mark.parametrize("end", ["", "\n", "\n\n# The end."])
def test_a_file_may_end_as_it_likes(tmp_path: Path, end: str) -> None:
    path = tmp_path / "params.yaml"
    path.write_text("cases:\n  a: 1" + end)
    add_entries({"cases": {"b": {"x": 1}}}, path)
    assert yaml.safe_load(path.read_text()) == {"cases": {"a": 1, "b": {"x": 1}}}


def test_the_project_s_own_file_takes_them(tmp_path: Path) -> None:
    source = Path(__file__).parents[2] / "params.yaml"
    path = tmp_path / "params.yaml"
    path.write_bytes(source.read_bytes())
    add_entries(NEW, path)
    left = iter(path.read_text(encoding="utf-8").splitlines())
    assert all(line in left for line in source.read_text(encoding="utf-8").splitlines())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("cases:\n  b: 1\n", "cases has 'b' already"),
        ("cases: [1\n", "is not YAML in UTF-8"),
        ("cases:\n  a: 1\n...\n", "cannot be extended"),
        ("cases: {a: 1}\n", "write each of these sections as a block"),
    ],
)
def test_nothing_is_written_where_an_entry_cannot_be_added(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(text)
    with pytest.raises(ParamsError, match=r"params\.yaml") as error:
        add_entries({"plants": {"b": {}}, "cases": {"b": {"x": 1}}}, path)
    assert said in str(error.value)
    assert path.read_text() == text


def test_entries_are_replaced_and_the_others_keep_every_byte(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    comments = TEXT.replace("  a: {seeds: [1, 2]} # of a\n", "  # Above b.\n  b-x: 1\n  a: {seeds: [1, 2]} # of a\n")
    path.write_text(comments, encoding="utf-8")
    add_entries(NEW, path)
    text = path.read_text(encoding="utf-8").replace("  b:\n    seeds: [3]\n", "  b: {seeds: [3]}\n")
    path.write_text(text + "  # Of the next.\n  later: {x: 1} # its own\n", encoding="utf-8")
    before = path.read_text(encoding="utf-8")
    with pytest.raises(ParamsError, match="'b' already"):
        add_entries(NEW, path)
    assert path.read_text(encoding="utf-8") == before
    newer = {**NEW, "cases": {"b": {"seeds": [4, 5]}}}
    add_entries(newer, path, replace=True)
    after = path.read_text(encoding="utf-8")
    loaded = yaml.safe_load(before)
    assert yaml.safe_load(after) == {**loaded, **{k: {**loaded[k], **newer[k]} for k in newer}}
    own = (
        "seeds: [3]",
        "seeds: [4, 5]",
        "title:",
        "b-x:",
        "b-pid:",
        "  b:",
        "law: pid",
        "case: b",
        "parts:",
        "pv:",
        "- {",
    )
    assert [line for line in after.splitlines() if not any(w in line for w in own)] == [
        line for line in before.splitlines() if not any(w in line for w in own)
    ]
    assert "  # Of the next.\n  later: {x: 1} # its own\n" in after
