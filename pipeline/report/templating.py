"""The templates of the reports: where they lie, and the filters that they use."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from loopwright.pipeline.files import write_text
from loopwright.pipeline.pictures.numbers import figure, kilobytes, ratio, times
from loopwright.serving.words import harmless

REGISTRY_URL = "http://127.0.0.1:5000/#/models"
"""Where `make registry` serves the registry, unless another port was asked for."""


def render(name: str, content: Mapping[str, Any]) -> str:
    """A template filled in; text is escaped where it is HTML."""
    return _environment(".html" in name).get_template(name).render(content)


@cache
def _environment(escapes: bool) -> Environment:
    """The templates, each compiled once a process."""
    environment = Environment(
        loader=PackageLoader("loopwright.pipeline.report"),
        autoescape=escapes,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=_shown,
    )
    environment.filters |= {f.__name__: f for f in (figure, times, ratio, kilobytes, cell, sentence)}
    return environment


def _shown(value: Any) -> Any:
    """A value of a template: what would act on a reader is spelt out, whoever let it come so far. Markup stays."""
    return harmless(value) if type(value) is str else value


def write_pages(out: Path, files: Mapping[str, str]) -> list[Path]:
    """Write files, each whole or not at all; returns their paths."""
    for name, body in files.items():
        write_text(out / name, body)
    return [out / name for name in files]


def sentence(text: str) -> str:
    """Text at the start of a sentence; abbreviations inside it stay as they are."""
    return text[:1].upper() + text[1:]


def cell(text: str) -> str:
    """Text that a cell of a Markdown table can hold."""
    return text.replace("|", "\\|").replace("\n", " ")
