"""The Python interface: light to import, complete, and every name where it says it is."""

import ast
import doctest
import inspect
import json
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import counterspin as cs
from counterspin import cli

PACKAGE = Path(cs.__file__).parent


def names_imported_for_type_checkers():
    """Return the module and attribute of each name imported under TYPE_CHECKING."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.asname: (statement.module, alias.name)
        for statement in block.body
        for alias in statement.names
    }


def test_lazy_names_match_type_checking_imports():
    seen = names_imported_for_type_checkers()
    assert sorted(seen) == cs.__all__
    for name, (module, attribute) in seen.items():
        assert getattr(cs, name) is getattr(import_module(module), attribute), name


def test_docstring_lists_every_public_name():
    matches = set(re.findall(r"`(\w+)`", cs.__doc__))
    assert matches == set(cs.__all__) - {"__version__"}


def test_dir_lists_names_before_loading():
    code = "import counterspin as cs; assert 'calibrate' in {*cs.__all__} <= {*dir(cs)}"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_dir_lists_only_public_names():
    code = (
        "import counterspin as cs; cs.TERMS; "
        "print(*(name for name in dir(cs) if not name.startswith('__')))"
    )
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert set(ran.stdout.split()) == set(cs.__all__) - {"__version__"}


@pytest.mark.parametrize("name", sorted(cs.__all__))
def test_no_public_name_is_module_name(name):
    # Importing such a module would put it in the place of the name.
    assert not (PACKAGE / name).is_dir()
    assert not (PACKAGE / f"{name}.py").exists()


def test_import_loads_only_package():
    code = (
        "import sys, counterspin; print(*(m for m in sys.modules if m.startswith('counterspin')))"
    )
    code += "; assert not {'numpy', 'pydantic', 'rich'} & {*sys.modules}"
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert run.stdout.split() == ["counterspin"]


def test_unknown_name_raises_attribute_error():
    with pytest.raises(AttributeError, match="module 'counterspin' has no attribute 'kalibrate'"):
        cs.kalibrate  # noqa: B018


@pytest.mark.parametrize(
    "name",
    [n for n in cs.__all__ if inspect.isroutine(getattr(cs, n)) or inspect.isclass(getattr(cs, n))],
)
def test_public_objects_have_docstrings(name):
    assert inspect.getdoc(getattr(cs, name))


def names_in_section(docstring, title):
    """Return the names in a section of a docstring in NumPy form; None without the section."""
    section = re.search(rf"(?ms)^{title}\n-+\n(.*?)(?=^\w[^\n]*\n-+$|\Z)", docstring)
    lines = section[1].splitlines() if section else []
    names = [name for line in lines if line[:1].strip() for name in line.split(",")]
    return {name.strip().lstrip("*") for name in names} if section else None


def functions():
    """Return the public functions, and the public methods of public classes, by name."""
    named = {name: getattr(cs, name) for name in cs.__all__}
    return {name: value for name, value in named.items() if inspect.isroutine(value)}, {
        f"{name}.{key}": getattr(value, "__func__", value)
        for name, owner in named.items()
        if inspect.isclass(owner)
        for key, value in vars(owner).items()
        if key[0] != "_" and inspect.isfunction(getattr(value, "__func__", value))
    }


def test_public_functions_document_parameters_and_result():
    functions_by_name, methods_by_name = functions()
    assert len(functions_by_name) > 35 < len(methods_by_name)
    wrong, unknown, resultless = {}, {}, []
    for name, function in (functions_by_name | methods_by_name).items():
        signature, docstring = inspect.signature(function), inspect.getdoc(function)
        parameters = set(signature.parameters) - {"self", "cls"}
        listed = names_in_section(docstring, "Parameters")
        if name in functions_by_name:
            wrong |= {name: listed} if (listed or set()) != parameters else {}
            has_result = re.search(r"(?m)^(Returns|Yields)\n-", docstring)
            resultless += [] if has_result or signature.return_annotation == "None" else [name]
        unknown |= {name: listed - parameters} if listed and listed - parameters else {}
    assert (wrong, unknown, resultless) == ({}, {}, [])


def examples():
    """Return the examples of each docstring as a doctest."""
    examples_by_page = {}
    for file in PACKAGE.rglob("*.py"):
        if "\n    >>> " in file.read_text(encoding="utf-8"):
            name = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts)
            for example in doctest.DocTestFinder().find(import_module(name), globs={}):
                examples_by_page |= {example.name: example} if example.examples else {}
    return examples_by_page


@pytest.mark.parametrize("example", examples().values(), ids=examples())
def test_docstring_example_prints_shown_output(example):
    printed = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    runner.run(example, out=printed.append)
    assert runner.tries > 0
    assert printed == []


def test_wrong_docstring_example_is_detected():
    wrong = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, 0)
    assert doctest.DocTestRunner(verbose=False).run(wrong, out=lambda _: None).failed == 1


def test_commands_accept_paths_as_text(tmp_path, capsys):
    written = cs.init(str(tmp_path / "mine"))
    assert len(cs.simulate(str(written), str(tmp_path / "records"))) == 3
    result = cs.calibrate(str(tmp_path / "records"))
    cs.write_result(result, str(tmp_path / "result.json"))
    assert cs.read_result(str(tmp_path / "result.json")) == result
    cs.print_result(result)
    assert "K_II of Qx = 20.0" in capsys.readouterr().out


def test_commands_are_functions_except_named_ones():
    page = (Path(__file__).parents[1] / "docs" / "python.md").read_text("utf-8")
    without = re.search(r"Every command except (.*?) is also a Python function\.", page, re.DOTALL)[
        1
    ]
    commands = {name for name in cli.app if not name.startswith("-")}
    assert commands - set(cs.__all__) == set(re.findall(r"`(\w+)`", without))


def test_invalid_polars_thread_count_raises(monkeypatch):
    monkeypatch.delitem(vars(cs), "simulate", raising=False)
    monkeypatch.setenv("POLARS_MAX_THREADS", "0")
    with pytest.raises(cs.CounterspinError, match="POLARS_MAX_THREADS: '0' is not a whole number"):
        cs.simulate(".")
    monkeypatch.setenv("POLARS_MAX_THREADS", "2")
    assert callable(cs.simulate)


def public_names():
    """Return the public members of each exported class and the parameters of each function."""
    names = {}
    for name in cs.__all__:
        exported = getattr(cs, name)
        if not inspect.isclass(exported):
            is_function = inspect.isfunction(exported)
            names[name] = list(inspect.signature(exported).parameters) if is_function else []
            continue
        bases = [base for base in exported.__mro__ if base.__module__.startswith("counterspin")]
        members = {
            member
            for base in bases
            for member in {*vars(base), *vars(base).get("__annotations__", {})}
            if not member.startswith(("_", "model_"))
        }
        names[name] = sorted(members)
    return names


def test_public_names_are_kept():
    """Programs of users depend on them: a name may be added to the file, but not removed."""
    kept = json.loads((Path(__file__).parent / "public-names.json").read_text("utf-8"))
    current = public_names()
    missing = {
        name: sorted(set(members) - set(current.get(name, [])))
        for name, members in kept.items()
        if not set(members) <= set(current.get(name, []))
    }
    assert missing == {}
    assert current.keys() == kept.keys()
