"""The Python interface: light to import, complete, and every name where it says it is."""

import ast
import doctest
import inspect
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
    """Return name -> (module, its name there) under TYPE_CHECKING."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.asname: (statement.module, alias.name)
        for statement in block.body
        for alias in statement.names
    }


def test_what_is_loaded_is_what_type_checkers_see():
    seen = names_imported_for_type_checkers()
    assert sorted(seen) == cs.__all__
    for name, (module, attribute) in seen.items():
        assert getattr(cs, name) is getattr(import_module(module), attribute), name


def test_every_name_is_told_in_the_docstring():
    told = set(re.findall(r"`(\w+)`", cs.__doc__))
    assert told == set(cs.__all__) - {"__version__"}


def test_names_are_listed_before_they_are_loaded():
    code = "import counterspin as cs; assert 'calibrate' in {*cs.__all__} <= {*dir(cs)}"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_dir_shows_what_is_offered_and_no_helpers():
    code = (
        "import counterspin as cs; cs.TERMS; "
        "print(*(name for name in dir(cs) if not name.startswith('__')))"
    )
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert set(ran.stdout.split()) == set(cs.__all__) - {"__version__"}


@pytest.mark.parametrize("name", sorted(cs.__all__))
def test_no_name_is_that_of_a_module(name):
    # Importing such a module would put it in the place of the name.
    assert not (PACKAGE / name).is_dir()
    assert not (PACKAGE / f"{name}.py").exists()


def test_import_loads_nothing_but_itself():
    code = (
        "import sys, counterspin; print(*(m for m in sys.modules if m.startswith('counterspin')))"
    )
    code += "; assert not {'numpy', 'pydantic', 'rich'} & {*sys.modules}"
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert run.stdout.split() == ["counterspin"]


def test_unknown_names_are_refused_as_usual():
    with pytest.raises(AttributeError, match="module 'counterspin' has no attribute 'kalibrate'"):
        cs.kalibrate  # noqa: B018


@pytest.mark.parametrize(
    "name",
    [n for n in cs.__all__ if inspect.isroutine(getattr(cs, n)) or inspect.isclass(getattr(cs, n))],
)
def test_everything_offered_has_a_docstring_of_its_own(name):
    assert inspect.getdoc(getattr(cs, name))


def examples():
    """Return the examples of all docstrings, one for each docstring."""
    found = {}
    for file in PACKAGE.rglob("*.py"):
        if "\n    >>> " in file.read_text(encoding="utf-8"):
            name = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts)
            for example in doctest.DocTestFinder().find(import_module(name), globs={}):
                found |= {example.name: example} if example.examples else {}
    return found


@pytest.mark.parametrize("example", examples().values(), ids=examples())
def test_an_example_of_a_docstring_prints_what_it_shows(example):
    printed = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    runner.run(example, out=printed.append)
    assert runner.tries > 0
    assert printed == []


def test_an_example_that_prints_something_else_would_be_found():
    wrong = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, 0)
    assert doctest.DocTestRunner(verbose=False).run(wrong, out=lambda _: None).failed == 1


def test_commands_are_a_few_lines_and_files_may_be_named_by_text(tmp_path, capsys):
    written = cs.init(str(tmp_path / "mine"))
    assert len(cs.simulate(str(written), str(tmp_path / "records"))) == 3
    result = cs.calibrate(str(tmp_path / "records"))
    cs.write_result(result, str(tmp_path / "result.json"))
    assert cs.read_result(str(tmp_path / "result.json")) == result
    cs.print_result(result)
    assert "K_II of Qx = 20.0" in capsys.readouterr().out


def test_every_command_is_a_function_but_those_that_the_page_names():
    page = (Path(__file__).parents[1] / "docs" / "python.md").read_text("utf-8")
    without = re.search(r"Every command except (.*?) is also a Python function\.", page, re.DOTALL)[
        1
    ]
    commands = {name for name in cli.app if not name.startswith("-")}
    assert commands - set(cs.__all__) == set(re.findall(r"`(\w+)`", without))


def test_functions_refuse_a_number_of_threads_that_polars_cannot_use(monkeypatch):
    monkeypatch.delitem(vars(cs), "simulate", raising=False)
    monkeypatch.setenv("POLARS_MAX_THREADS", "0")
    with pytest.raises(cs.CounterspinError, match="POLARS_MAX_THREADS: '0' is not a whole number"):
        cs.simulate(".")
    monkeypatch.setenv("POLARS_MAX_THREADS", "2")
    assert callable(cs.simulate)
