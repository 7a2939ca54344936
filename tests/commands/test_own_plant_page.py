"""docs/own_plant.md tells what the commands print, and every page of the manual is linked and links to what exists."""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest

from loopwright.pipeline.__main__ import main

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "own_plant.md").read_text(encoding="utf-8")
MANUAL = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def anchors(text: str) -> set[str]:
    """Of the headings of a page, as GitHub makes them."""
    heads = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", MANUAL, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if link.startswith("http"):
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text(encoding="utf-8")), link


def test_the_readme_links_every_page_of_the_manual() -> None:
    readme = MANUAL[0].read_text(encoding="utf-8")
    assert [page.name for page in MANUAL[1:] if f"(docs/{page.name})" not in readme] == []


def test_the_commands_print_what_the_page_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    commands, printed = re.findall(r"```(?:sh)?\n(.*?)```", PAGE, re.DOTALL)[:2]
    made, new = (shlex.split(line) for line in commands.splitlines())
    assert (made[0], new[0]) == ("python", "loopwright")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [Path(made[1]).name, *made[2:]])
    runpy.run_path(str(ROOT / made[1]), run_name="__main__")
    Path("params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n")
    assert main(new[1:]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [line for line in printed.splitlines() if line not in said] == []


def test_each_doubt_that_the_page_explains_is_one_that_new_can_print() -> None:
    files = ("historian/excitation.py", "historian/notices.py", "historian/cleaning/tag_checks.py", "records/record.py")
    source = "".join((ROOT / "pipeline" / file).read_text(encoding="utf-8") for file in files)
    table = PAGE[PAGE.index("| it says |") : PAGE.index("`--replace` puts")]
    rows = [row.split("|")[1] for row in table.splitlines()[2:] if row.startswith("|")]
    parts = [part.strip(" ,)") for row in rows for part in re.split(r"\.\.\.|;", row)]
    assert len(rows) == 13
    assert [part for part in parts if part and part not in source] == []


def test_each_gain_that_is_told_of_a_pair_has_the_name_that_the_glossary_explains() -> None:
    (row,) = re.findall(r"^\| gain \|(.*)\|$", PAGE, re.MULTILINE)
    names = [name.lower() for name in re.findall(r"\*([^*]+)\*", row)]
    assert names == ["by one linear model", "at the middle", "on the way"]
    files = ("report/screening.py", "report/identified_model.py", "evaluation/proof.py")
    source = [(ROOT / "pipeline" / file).read_text(encoding="utf-8").lower() for file in files]
    assert [name in text for name, text in zip(names, source, strict=True)] == [True] * 3
