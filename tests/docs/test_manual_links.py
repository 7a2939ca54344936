"""Links of the manual: files are there, anchors are headings, pages elsewhere are named by https."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from manual.contents import GENERATED
from pages import PAGES, ROOT, anchors, without_code

LINK = re.compile(r"!?\[(?:[^\]\[]|\[[^\]]*\])*\]\(([^)\s]+)\)")
GENERATED_ANCHORS = re.compile(r"^```\{generated\} (.+)$", re.MULTILINE)


def anchors_of(page: Path) -> set[str]:
    """Anchors of what the page says and of what is generated on it."""
    text = page.read_text(encoding="utf-8")
    made = (GENERATED[name](*rest) for name, *rest in map(str.split, GENERATED_ANCHORS.findall(text)))
    return anchors(text).union(*map(anchors, made))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    wrong = []
    for target in LINK.findall(without_code(page.read_text(encoding="utf-8"))):
        if target.startswith(("https://", "mailto:")):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        if not there.exists() or ROOT not in (there, *there.parents):
            wrong.append(f"{target}: no such file")
        elif anchor and (there.suffix != ".md" or anchor not in anchors_of(there)):
            wrong.append(f"{target}: no such heading")
    assert not wrong


def test_links_of_generated_texts_lead_somewhere() -> None:
    """They stand on pages one folder below docs."""
    texts = [GENERATED[name]() for name in GENERATED if name not in {"law", "results"}]
    texts += [GENERATED[name]("pid") for name in ("law", "results")]
    targets = {target for text in texts for target in LINK.findall(text) if not target.startswith("https://")}
    assert len(targets) > 20
    assert [t for t in targets if not any((ROOT / "docs" / f / t).exists() for f in ("theory", "reference"))] == []
