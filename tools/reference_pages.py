"""Writes into the pages of the manual what is taken from the code: python tools/reference_pages.py [--check].

The text stands in the pages, and not in the built manual alone, so that they can be read on a forge. What changes with
each run of the pipeline stays a directive of the manual.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tools/roots"), str(ROOT / "docs" / "_ext")]

from manual.contents import GENERATED  # noqa: E402

PART = re.compile(r"^<!-- generated: (?P<name>.+?) -->\n.*?^<!-- end of generated -->$", re.MULTILINE | re.DOTALL)


def current(text: str) -> str:
    """The page with each part as the code has it now."""

    def part(found: re.Match[str]) -> str:
        name, *rest = found["name"].split()
        return f"<!-- generated: {found['name']} -->\n\n{GENERATED[name](*rest)}\n\n<!-- end of generated -->"

    return PART.sub(part, text)


def pages() -> dict[Path, str]:
    """Pages that are not as the code has them, and what they should be."""
    texts = {page: page.read_text(encoding="utf-8") for page in sorted((ROOT / "docs").rglob("*.md"))}
    return {page: new for page, text in texts.items() if (new := current(text)) != text}


def main() -> int:
    """1 where --check finds a page that is not current."""
    stale = pages()
    for page, text in stale.items():
        print(page.relative_to(ROOT))
        if "--check" not in sys.argv:
            page.write_text(text, encoding="utf-8")
    return int(bool(stale) and "--check" in sys.argv)


if __name__ == "__main__":
    sys.exit(main())
