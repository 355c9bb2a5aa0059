"""How Sphinx reads our docstrings and signatures, and fills in what `from_code` says."""

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

#: What NumPy's ArrayLike is made of: it stands in its place where None is allowed too.
_ARRAY_LIKE = re.compile(
    r"~?numpy\._typing\._array_like\._Buffer .*?_NestedSequence\[complex \| bytes \| str\]"
)


def _on_signature(*given: Any) -> tuple[str | None, str | None]:
    """Return a signature that can be read: arrays by their name, made defaults as dots."""
    *_, value, _, signature, returns = given
    if inspect.isclass(value) and issubclass(value, SettingsSection):
        return "", returns  # it is read from files, with the checks that its types hold

    def plain(text: str | None) -> str | None:
        if text is None:
            return None
        text = _ARRAY_LIKE.sub("~numpy.typing.ArrayLike", text)
        return text.replace("<factory>", "...").replace("PydanticUndefined", "...")

    return plain(signature), plain(returns)


def _on_docstring(*given: Any) -> None:
    """Add what the fields of a table of a document say of themselves."""
    *_, value, _, lines = given
    if inspect.isclass(value) and issubclass(value, SettingsSection):
        lines += ["", "Attributes", "----------"]
        for key, field in value.model_fields.items():
            words = strip_links(field.description or "").replace("`", "``")
            lines += [key, f"    {words[:1].upper()}{words[1:]}."]


def _on_read(app: Sphinx, name: str, content: list[str]) -> None:  # noqa: ARG001 -- Sphinx's
    content[0] = filled(content[0])


@cache
def _whole_names(env: BuildEnvironment) -> dict[str, str]:
    """Return the last part of a name -> the shortest name that ends in it, of all that is known.

    It is asked when all pages are read, for each of thousands of references.
    """
    known = set(env.get_domain("py").objects)  # type: ignore[attr-defined]
    inventory = getattr(env, "intersphinx_inventory", {})
    for kind, entries in inventory.items():
        if kind.startswith("py:"):
            known |= set(entries)
    longest_first = sorted(known, key=lambda whole: (-len(whole), whole))
    return {whole.split(".")[-1]: whole for whole in longest_first}


def _on_missing(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, words: nodes.Element
) -> nodes.Element | None:
    """Find what an annotation calls by its last name, as imported for the type checker only."""
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"]
    last = target.split(".")[-1]
    whole = _whole_names(env).get(last)
    if whole is None and last in type_names():
        return words
    if whole is None or whole == target:
        return None
    domain = env.get_domain("py")
    found = domain.resolve_any_xref(env, node["refdoc"], app.builder, whole, node, words)
    if found:
        return found[0][1]
    node["reftarget"] = whole
    return resolve_reference_any_inventory(env, False, node, words)


def setup(app: Sphinx) -> dict[str, bool]:
    """Have pages filled as they are read."""
    # In a union, of properties too, Sphinx shows an alias by its repr.
    TypeAliasForwardRef.__repr__ = lambda self: self.name  # type: ignore[method-assign]
    app.connect("source-read", _on_read)
    app.connect("autodoc-process-signature", _on_signature)
    app.connect("autodoc-process-docstring", _on_docstring, priority=400)  # before numpydoc
    app.add_lexer("csv", TextLexer)
    app.connect("missing-reference", _on_missing, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
