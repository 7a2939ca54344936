"""New entries for params.yaml, written into its text: comments and all other lines stay as they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from pipeline.config.params import PARAMS_FILE
from pipeline.errors import ParamsError
from pipeline.files import write_text

Entries = Mapping[str, Mapping[str, Any]]
"""Section -> name of the entry -> its values."""


def add_entries(entries: Entries, path: Path = PARAMS_FILE) -> None:
    """Add entries to the ends of their sections, a section that is missing at the end of the file; all or nothing.

    Raises ParamsError where an entry of that name exists, or where a section is not written as a block.
    """
    text = path.read_text(encoding="utf-8")
    before = yaml.safe_load(text) or {}
    wanted = dict(before)
    for section, added in entries.items():
        there = wanted.get(section) or {}
        taken = sorted(set(there) & set(added))
        if taken:
            raise ParamsError(f"{path}: {section}.{taken[0]} exists already; remove it, or choose another name")
        wanted[section] = {**there, **added}
        text = _with_block(text, section, _block(added))
    try:
        after = yaml.safe_load(text)
    except yaml.YAMLError:
        after = None
    if after != wanted:
        raise ParamsError(
            f"{path}: {', '.join(entries)} cannot be extended: write each of these sections as a block, a line for "
            "each entry, without braces"
        )
    write_text(path, text)


def _block(added: Mapping[str, Any]) -> str:
    text: str = yaml.safe_dump(dict(added), sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)
    return "".join(f"  {line}\n" for line in text.splitlines())


def _with_block(text: str, section: str, block: str) -> str:
    """The text with lines behind the last one of a section; a new section where there is none."""
    lines = text.splitlines(keepends=True)
    heads = [i for i, line in enumerate(lines) if line[:1].isalpha()]
    at = next((i for i in heads if lines[i].split(":")[0] == section), None)
    if at is None:
        end = "" if not text or text.endswith("\n") else "\n"
        return f"{text}{end}\n{section}:\n{block}"
    stop = next((i for i in heads if i > at), len(lines))
    # Blank lines and comments at the margin belong to the next section.
    while stop > at + 1 and (not lines[stop - 1].strip() or lines[stop - 1].startswith("#")):
        stop -= 1
    if not lines[stop - 1].endswith("\n"):
        lines[stop - 1] += "\n"
    if stop == at + 1 and lines[at].rstrip().endswith("{}"):
        lines[at] = lines[at].rstrip()[:-2].rstrip() + "\n"
    return "".join([*lines[:stop], block, *lines[stop:]])
