"""New entries for params.yaml, written into its text: comments and all other lines stay as they are."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from loopwright.pipeline.config.params import PARAMS_FILE
from loopwright.pipeline.config.reading import tree_of
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.files import write_bytes

Entries = Mapping[str, Mapping[str, Any]]
"""Section -> name of the entry -> its values."""


def add_entries(
    entries: Entries, path: Path = PARAMS_FILE, *, replace: bool = False, remove: Iterable[tuple[str, str]] = ()
) -> None:
    """Add entries to the ends of their sections, a section that is missing at the end of the file; all or nothing.

    ``replace`` takes entries of the same names out first, ``remove`` further ones: (section, name), if they are there.
    Raises ParamsError where an entry of that name exists without it, or where a section is not written as a block.
    """
    try:
        text = path.read_bytes().decode("utf-8")
        before = tree_of(text, path)
    except FileNotFoundError:
        raise ParamsError(f"{path} is not here; run from the repository's root") from None
    except UnicodeDecodeError as error:
        raise ParamsError(f"{path} is not YAML in UTF-8: {error}") from None
    wanted, end = dict(before), "\r\n" if "\r\n" in text else "\n"
    taken = [
        (section, name) for section, added in entries.items() for name in added if name in (before.get(section) or ())
    ]
    if taken and not replace:
        section, name = min(taken)
        raise ParamsError(f"{path}: {section} has {name!r} already; remove it, or choose another name")
    further = [(section, name) for section, name in remove if name in (before.get(section) or ())]
    for section, name in dict.fromkeys([*taken, *further]):
        left = _without(text, section, name)
        if left == text:
            raise ParamsError(f"{path}: {section}.{name} is not written as a block; remove it by hand")
        text = left
        wanted[section] = {key: value for key, value in wanted[section].items() if key != name}
        if not wanted[section] and section not in entries:
            text = re.sub(rf"^{re.escape(section)}:", f"{section}: {{}}", text, flags=re.MULTILINE)
    for section, added in entries.items():
        wanted[section] = {**(wanted.get(section) or {}), **added}
        text = _with_lines(text, section, _lines(added), end)
    try:
        after = yaml.safe_load(text)
    except yaml.YAMLError:
        after = None
    if after != wanted:
        raise ParamsError(
            f"{path}: {', '.join(entries)} cannot be extended: write each of these sections as a block, a line for "
            "each entry, without braces"
        )
    mode = path.stat().st_mode & 0o777
    write_bytes(path.resolve(), text.encode("utf-8"))
    os.chmod(path, mode)


def _lines(added: Mapping[str, Any]) -> list[str]:
    text: str = yaml.safe_dump(dict(added), sort_keys=False, allow_unicode=True, default_flow_style=None, width=10_000)
    return [f"  {line}" for line in text.splitlines()]


def _without(text: str, section: str, name: str) -> str:
    """The text without an entry: its line and the deeper lines below it; comments above it and behind it stay."""
    lines = text.splitlines(keepends=True)
    heads = [i for i, line in enumerate(lines) if line[:1].isalpha()]
    at = next((i for i in heads if lines[i].split(":")[0].strip() == section), len(lines))
    end = next((i for i in heads if i > at), len(lines))
    key = re.compile(rf"( +)(['\"]?){re.escape(name)}\2\s*:")
    first = next((i for i in range(at + 1, end) if key.match(lines[i])), None)
    if first is None:
        return text
    depth, last = len(lines[first]) - len(lines[first].lstrip()), first
    for i in range(first + 1, end):
        if lines[i].strip():
            if len(lines[i]) - len(lines[i].lstrip()) <= depth:
                break
            last = i
    return "".join([*lines[:first], *lines[last + 1 :]])


def _with_lines(text: str, section: str, added: list[str], end: str) -> str:
    """The text with lines behind the last one of a section; with a new section where there is none."""
    lines = text.splitlines(keepends=True)
    heads = [i for i, line in enumerate(lines) if line[:1].isalpha()]
    at = next((i for i in heads if lines[i].split(":")[0].strip() == section), None)
    if at is None:
        return text + ("" if not text or text.endswith("\n") else end) + end.join(["", f"{section}:", *added, ""])
    stop = next((i for i in heads if i > at), len(lines))
    # Blank lines and comments at the margin belong to the next section.
    while stop > at + 1 and (not lines[stop - 1].strip() or lines[stop - 1].startswith("#")):
        stop -= 1
    if not lines[stop - 1].endswith("\n"):
        lines[stop - 1] += end
    if stop == at + 1 and lines[at].rstrip().endswith("{}"):
        lines[at] = lines[at].rstrip()[:-2].rstrip() + end
    return "".join([*lines[:stop], end.join([*added, ""]), *lines[stop:]])
