"""Formulas as MathML, which browsers draw by themselves: no script, no fonts from elsewhere."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml


def mathml(text: str, *, block: bool) -> str:
    """LaTeX as MathML; ValueError names what cannot be read. Several lines are aligned at their ``&``."""
    if block and r"\\" in text and r"\begin{" not in text:
        text = rf"\begin{{aligned}}{text}\end{{aligned}}"
    try:
        # Fractions and sums of aligned lines are as large as those of a single line.
        return str(tex2mathml(text, as_block=block)).replace("<mtable", '<mtable displaystyle="true"')
    except MathError as wrong:
        raise ValueError(f"formula {text!r}: {wrong}") from None


def inline_math(translator: Any, node: nodes.math) -> None:
    """A formula within a line."""
    translator.body.append(mathml(node.astext(), block=False))
    raise nodes.SkipNode


def block_math(translator: Any, node: nodes.math_block) -> None:
    """A formula of its own."""
    translator.body.append(f'<div class="formula">{mathml(node.astext(), block=True)}</div>')
    raise nodes.SkipNode
