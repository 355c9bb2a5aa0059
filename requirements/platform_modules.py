"""Print the modules of counterspin whose types can differ between platforms.

These are the modules that import a module of the standard library whose types, as mypy has them,
depend on `sys.platform`. `make lint` checks all modules for Linux, and only these for macOS and
Windows.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import mypy

PACKAGE = Path(__file__).parents[1] / "src" / "counterspin"
STUBS = Path(mypy.__file__).parent / "typeshed" / "stdlib"

#: Built-in names that depend on the platform; nothing imports them.
BUILT_IN = re.compile(rb"\b(winerror|WindowsError)\b")


def platform_libraries() -> set[str]:
    """Return the top-level modules of the standard library whose types depend on the platform."""
    return {
        stub.relative_to(STUBS).parts[0].removesuffix(".pyi")
        for stub in STUBS.rglob("*.pyi")
        if "sys.platform" in stub.read_text("utf-8")
    }


def platform_modules() -> Iterator[Path]:
    """Yield the modules of counterspin that use such a library, in order of their paths."""
    libraries = platform_libraries()
    for module in sorted(PACKAGE.rglob("*.py")):
        text = module.read_bytes()
        if BUILT_IN.search(text) or not libraries.isdisjoint(imported_libraries(text)):
            yield module


def imported_libraries(text: bytes) -> Iterator[str]:
    """Yield the top-level modules that a module imports, also within functions."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.partition(".")[0]


if __name__ == "__main__":
    print(*platform_modules(), sep="\n")
