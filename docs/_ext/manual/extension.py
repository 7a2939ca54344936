"""Sphinx extension of the manual: text that is generated from the code, block diagrams, formulas as MathML."""

from __future__ import annotations

import re
from fnmatch import fnmatch
from pathlib import PurePosixPath
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from manual.contents import GENERATED
from manual.diagram import drawn
from manual.mathml import block_math, inline_math


class Generated(SphinxDirective):
    """``{generated} NAME [ARGUMENT]``: the Markdown that ``GENERATED[NAME]`` makes of the code."""

    required_arguments = 1
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The nodes of the generated text."""
        name, *rest = self.arguments
        if name not in GENERATED:
            raise self.error(f"nothing is generated under the name {name!r}; known: {', '.join(sorted(GENERATED))}")
        self.env.note_reread()  # the code may have changed where the page has not
        return self.parse_text_to_nodes(GENERATED[name](*rest), allow_section_headings=True)


class Diagram(SphinxDirective):
    """``{diagram} WORDS``: a block diagram, see ``manual.diagram``; the words are for who does not see it."""

    required_arguments = 1
    final_argument_whitespace = True
    has_content = True

    def run(self) -> list[nodes.Node]:
        """The picture as part of the page."""
        try:
            picture = drawn("\n".join(self.content), self.arguments[0])
        except ValueError as wrong:
            raise self.error(str(wrong)) from None
        return [nodes.raw("", f'<div class="diagram">{picture}</div>', format="html")]


def leave_out_empty_patterns(app: Sphinx, docname: str, source: list[str]) -> None:
    """Take a pattern that no page matches out of the list of pages: its pages come with a later part."""
    folder = PurePosixPath(docname).parent
    kept = [line for line in source[0].split("\n") if not _empty(line.strip(), folder, app.env.found_docs)]
    source[0] = "\n".join(kept)


def _empty(line: str, folder: PurePosixPath, pages: set[str]) -> bool:
    if "*" not in line or " " in line or line.startswith(("*", ":")):
        return False
    pattern = (folder.parent / line[3:] if line.startswith("../") else folder / line).as_posix()
    return not any(fnmatch(page, pattern) for page in pages)


def name_aliases(app: Sphinx, what: str, name: str, obj: object, options: object, *shown: str | None) -> Any:
    """Write an alias of a type by its name in a signature, also within a union."""
    return tuple(text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text) for text in shown)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives and the renderer of formulas."""
    app.add_directive("generated", Generated)
    app.add_directive("diagram", Diagram)
    app.connect("autodoc-process-signature", name_aliases)
    app.connect("source-read", leave_out_empty_patterns)
    app.add_html_math_renderer("mathml", inline_renderers=(inline_math, None), block_renderers=(block_math, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
