"""Every citation in the sources has its entry in the bibliography, and no source names a file of the papers."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
KEYS = re.findall(
    r"^\| `(\w+)` \|", (ROOT / "pipeline" / "cases" / "bibliography.md").read_text(encoding="utf-8"), re.M
)
TEXTS = {
    path: path.read_text(encoding="utf-8")
    for folder in ("pipeline", "serving", "benchmarks", "examples")
    for path in sorted((ROOT / folder).rglob("*.py"))
}
PLACE = re.compile(r"\[(\w+)(?:, (?:eqs?\b|sections?\b|Table\b|figures?\b)[^]]*)?\]")
"""A key in brackets after the word Source, or with the place in the paper."""


def test_every_citation_has_an_entry_and_every_entry_is_cited() -> None:
    assert len(set(KEYS)) == len(KEYS) >= 5
    cited = {
        m[1]
        for text in TEXTS.values()
        for m in PLACE.finditer(text)
        if "," in m[0] or re.search(r"(?<![:>] )Source(?!\()[^.]*$", text[: m.start()])
    }
    assert cited == set(KEYS)


def test_no_source_cites_a_file() -> None:
    assert not [
        str(path.relative_to(ROOT))
        for path, text in TEXTS.items()
        if re.search(r"\bseed \d{3}_|\b(\d{3}_)?[0-9a-f]{16}\.txt", text)
    ]
