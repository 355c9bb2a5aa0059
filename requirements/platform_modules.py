"""Print the modules of counterspin whose types can differ between platforms.

These are the modules that use a name of the standard library whose declaration, as mypy has it,
depends on `sys.platform`, and those that ask for the platform. `make lint` checks all modules for
Linux, and only these for macOS and Windows.
"""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import mypy

PACKAGE = Path(__file__).parents[1] / "src" / "counterspin"
STUBS = Path(mypy.__file__).parent / "typeshed" / "stdlib"

#: Built-in names that depend on the platform, which nothing imports; and the platform itself.
BUILT_IN = re.compile(rb"\b(winerror|WindowsError|sys\.platform)\b")


def platform_names() -> dict[str, set[str]]:
    """Return the names that depend on the platform, by top-level module of the standard library."""
    names = defaultdict(set)
    for stub in sorted(STUBS.rglob("*.pyi")):
        text = stub.read_text("utf-8")
        if "sys.platform" in text:
            library = stub.relative_to(STUBS).parts[0].removesuffix(".pyi")
            names[library] |= dependent_names(ast.parse(text))
    return names


def dependent_names(stub: ast.Module) -> set[str]:
    """Return the names that a stub declares in a branch by platform, or by means of such a name."""
    names = set()
    for node in ast.walk(stub):
        if isinstance(node, ast.If) and "platform" in used_names(node.test):
            names.update(declared_names(node))
    declarations = [(set(declared_names(node)), used_names(node)) for node in stub.body]
    size = -1
    while size != len(names):
        size = len(names)
        names.update(*(declared for declared, used in declarations if used & names))
    return names


def declared_names(node: ast.stmt) -> Iterator[str]:
    """Yield the names that a statement declares, in all its branches."""
    match node:
        case ast.If():
            for branch in (*node.body, *node.orelse):
                yield from declared_names(branch)
        case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
            yield node.name
        case ast.Import() | ast.ImportFrom():
            yield from (alias.asname or alias.name for alias in node.names)
        case ast.Assign() | ast.AnnAssign():
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in targets:
                yield from used_names(target)


def used_names(tree: ast.AST) -> set[str]:
    """Return the names, attributes and imported names of a syntax tree."""
    names = set()
    for node in ast.walk(tree):
        match node:
            case ast.Name(name) | ast.Attribute(_, name) | ast.alias(name):
                names.add(name)
    return names


def imported_libraries(tree: ast.Module) -> Iterator[str]:
    """Yield the top-level modules that a module imports, also within functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.partition(".")[0]


def platform_modules() -> Iterator[Path]:
    """Yield the modules of counterspin that use such a name, in order of their paths."""
    names = platform_names()
    for module in sorted(PACKAGE.rglob("*.py")):
        text = module.read_bytes()
        tree = ast.parse(text)
        dependent = set().union(*(names.get(name, ()) for name in imported_libraries(tree)))
        if BUILT_IN.search(text) or used_names(tree) & dependent:
            yield module


if __name__ == "__main__":
    print(*platform_modules(), sep="\n")
