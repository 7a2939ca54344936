"""The manual's pages as text, their code blocks and headings. Not a test: what the tests of the manual share."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(
    [
        *(p for p in DOCS.rglob("*.md") if not any(part.startswith("_") for part in p.relative_to(DOCS).parts)),
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *(p for p in (ROOT / "examples").rglob("README.md") if "node_modules" not in p.parts),
        *(ROOT / "pipeline" / "cases").glob("*/README.md"),
    ]
)
FENCE = re.compile(r"^(```+)(\S*)[^\n]*\n(.*?)^\1[ ]*$", re.MULTILINE | re.DOTALL)
REASON = re.compile(r"<!-- (not run|run by|run in part): (.+?) -->\s*$")


@dataclass(frozen=True)
class Block:
    """A fenced block: its page, line, language, text, and what a comment right above it says of running it."""

    page: Path
    line: int
    language: str
    text: str
    mark: tuple[str, str] | None

    @property
    def where(self) -> str:
        """Page and line, for a message."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page; those within a list are not set in."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(text):
        mark = REASON.search(text[: match.start()])
        line = text.count("\n", 0, match.start()) + 1
        found.append(Block(page, line, match[2], match[3], (mark[1], mark[2]) if mark else None))
    return found


def without_code(text: str) -> str:
    """The page's prose: no fenced blocks, no formulas."""
    return re.sub(r"\$\$.*?\$\$", "", FENCE.sub("", text), flags=re.DOTALL)


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as forges and MyST make them."""
    heads = re.findall(r"^#+ (.+)$", FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.strip().lower().replace("`", "")).replace(" ", "-") for head in heads}
