"""Render formulas as MathML, which current browsers display without scripts or web fonts."""

from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx


def to_mathml(latex: str, display: str) -> str:
    """Return a formula as a ``<math>`` element with its LaTeX source as alternative text.

    Parameters
    ----------
    latex
        The formula, without dollar signs.
    display
        "inline" or "block".
    """
    from html import escape

    element: str = convert(latex.strip(), display=display)
    return element.replace("<math ", f'<math alttext="{escape(latex.strip())}" ', 1)


def write_inline_formula(translator: Any, node: nodes.math) -> None:
    """Write an inline formula."""
    translator.body.append(to_mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def write_block_formula(translator: Any, node: nodes.math_block) -> None:
    """Write a display formula; wide formulas scroll on narrow screens."""
    translator.body.append(f'<div class="formula">{to_mathml(node.astext(), "block")}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer with Sphinx."""
    app.add_html_math_renderer("mathml", (write_inline_formula, None), (write_block_formula, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
