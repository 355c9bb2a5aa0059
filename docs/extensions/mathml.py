"""Formulas as MathML, which every current browser sets by itself: no script, no font to fetch."""

from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx


def mathml(latex: str, display: str) -> str:
    """Return a formula as a ``<math>`` element whose words for those who do not see it are LaTeX.

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


def visit_inline(translator: Any, node: nodes.math) -> None:
    """Write a formula within a line."""
    translator.body.append(mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def visit_block(translator: Any, node: nodes.math_block) -> None:
    """Write a formula on lines of its own; what is too wide for a phone can be moved."""
    translator.body.append(f'<div class="formula">{mathml(node.astext(), "block")}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Offer the renderer to Sphinx."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
