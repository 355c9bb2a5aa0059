"""Adapt docstrings, signatures and references for Sphinx; fill in the text of `from_code`."""

import inspect
import re
from functools import cache
from typing import Any

from docutils import nodes
from from_code import filled, type_names
from pygments.lexers.special import TextLexer
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.ext.intersphinx import resolve_reference_any_inventory
from sphinx.util.inspect import TypeAliasForwardRef

from counterspin.campaign.field_types import SettingsSection
from counterspin.schemas import strip_links

#: Expansion of NumPy's ArrayLike, which appears in annotations that also allow None.
_ARRAY_LIKE = re.compile(
    r"~?numpy\._typing\._array_like\._Buffer .*?_NestedSequence\[complex \| bytes \| str\]"
)


def _simplify_signature(*arguments: Any) -> tuple[str | None, str | None]:
    """Return a readable signature: ArrayLike by name, default factories as dots."""
    *_, documented, _, signature, returns = arguments
    if inspect.isclass(documented) and issubclass(documented, SettingsSection):
        return "", returns  # created from files only

    def simplify(text: str | None) -> str | None:
        if text is None:
            return None
        text = _ARRAY_LIKE.sub("~numpy.typing.ArrayLike", text)
        return text.replace("<factory>", "...").replace("PydanticUndefined", "...")

    return simplify(signature), simplify(returns)


def _add_field_descriptions(*arguments: Any) -> None:
    """Add the field descriptions of a document section to its docstring."""
    *_, documented, _, lines = arguments
    if inspect.isclass(documented) and issubclass(documented, SettingsSection):
        lines += ["", "Attributes", "----------"]
        for key, field in documented.model_fields.items():
            description = strip_links(field.description or "").replace("`", "``")
            lines += [key, f"    {description[:1].upper()}{description[1:]}."]


def _fill_page(app: Sphinx, name: str, content: list[str]) -> None:  # noqa: ARG001 -- Sphinx's
    content[0] = filled(content[0])


@cache
def _qualified_names(env: BuildEnvironment) -> dict[str, str]:
    """Return last name component -> shortest qualified name that ends in it.

    Cached: Sphinx resolves thousands of references after reading all pages.
    """
    qualified_names = set(env.get_domain("py").objects)  # type: ignore[attr-defined]
    inventory = getattr(env, "intersphinx_inventory", {})
    for object_type, entries in inventory.items():
        if object_type.startswith("py:"):
            qualified_names |= set(entries)
    longest_first = sorted(qualified_names, key=lambda whole: (-len(whole), whole))
    return {whole.split(".")[-1]: whole for whole in longest_first}


def _resolve_short_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, link_content: nodes.Element
) -> nodes.Element | None:
    """Resolve an unqualified name in an annotation, as imported under TYPE_CHECKING."""
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"]
    short_name = target.split(".")[-1]
    qualified_name = _qualified_names(env).get(short_name)
    if qualified_name is None and short_name in type_names():
        return link_content
    if qualified_name is None or qualified_name == target:
        return None
    domain = env.get_domain("py")
    matches = domain.resolve_any_xref(
        env, node["refdoc"], app.builder, qualified_name, node, link_content
    )
    if matches:
        return matches[0][1]
    node["reftarget"] = qualified_name
    return resolve_reference_any_inventory(env, False, node, link_content)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the extension to Sphinx."""
    # Sphinx shows the repr of a type alias in a union.
    TypeAliasForwardRef.__repr__ = lambda self: self.name  # type: ignore[method-assign]
    app.connect("source-read", _fill_page)
    app.connect("autodoc-process-signature", _simplify_signature)
    app.connect(
        "autodoc-process-docstring", _add_field_descriptions, priority=400
    )  # before numpydoc
    app.add_lexer("csv", TextLexer)
    app.connect("missing-reference", _resolve_short_name, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
