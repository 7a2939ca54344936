"""Docstrings and tables as Markdown."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; a bar or a line's end within a cell does not end it."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|") or " "


def code(text: object) -> str:
    """``text`` in backticks, nothing where it is empty."""
    return f"`{text}`" if str(text) else ""


def prose(docstring: str | None) -> str:
    """A docstring as Markdown: double backticks become single ones, what is set in stands as it is."""
    text = inspect.cleandoc(docstring or "")
    done = []
    for block in re.split(r"\n\s*\n", text):
        if block.startswith("    "):
            done.append(f"```text\n{textwrap.dedent(block)}\n```")
        elif "\n---" in block:
            done.append(_entries(block))
        else:
            done.append(_plain(block))
    return "\n\n".join(done)


def _plain(block: str) -> str:
    """Text with what Markdown would take for markup made harmless, outside backticks."""
    parts = re.split(r"(``.+?``)", " ".join(block.split()))
    return "".join(f"`{p[2:-2]}`" if p.startswith("``") else re.sub(r"([*_<>\[\]$`])", r"\\\1", p) for p in parts)


def _entries(block: str) -> str:
    """A section of numpydoc: a head, its underline, entries whose words are set in."""
    head, _, *lines = block.splitlines()
    done: list[str] = []
    for line in lines:
        if line.startswith("    "):
            done[-1] += " " + _plain(line)
        else:
            names, _, unit = line.partition(" [")
            done.append(f"- {code(names)}{f' [{unit}' if unit else ''}:".replace("[", "\\["))
    return f"{head}:\n\n" + "\n".join(done)


def first_sentence(docstring: str | None) -> str:
    """The first paragraph, on one line."""
    return prose(docstring).split("\n\n")[0]
