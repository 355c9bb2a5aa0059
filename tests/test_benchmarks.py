"""The benchmarks' scripts: what they import is there, and their commands are understood."""

import ast
import contextlib
import importlib
import importlib.util
import io
import json
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import counterspin.cli

FOLDER = Path(__file__).parent.parent / "benchmarks"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py"))


@pytest.fixture(autouse=True)
def _among_the_scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    before = set(sys.modules)
    yield
    for name in set(sys.modules).difference(before).intersection(SCRIPTS):
        del sys.modules[name]


def code_of(script):
    """Return the syntax trees of a script and of the programs that it contains as text."""
    tree = ast.parse((FOLDER / f"{script}.py").read_text("utf-8"))
    yield tree
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and "import " in str(node.value):
            with contextlib.suppress(SyntaxError):  # prose
                yield ast.parse(node.value)


@pytest.mark.parametrize("script", SCRIPTS)
def test_imports_of_scripts_exist(script):
    imports = [
        node
        for tree in code_of(script)
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    for node in imports:
        if isinstance(node, ast.Import):
            for name in node.names:
                assert own(name.name) is None or importlib.import_module(name.name)
        elif (module := own(node.module)) is not None:
            for name in node.names:
                assert hasattr(importlib.import_module(module), name.name), name.name


def own(module):
    """Return the name of a module of the package or a script; others may be missing."""
    return module if module.partition(".")[0] in ("counterspin", *SCRIPTS) else None


def in_this_process(command, *, run=True):
    """Return the output of a benchmark command; without `run`, only parse its arguments."""
    process = importlib.import_module("process")
    [program], words = command[:1], command[1:]
    printed = io.StringIO()
    if [program] == process.COUNTERSPIN:
        counterspin.cli.app.parse_args(words, exit_on_error=False, print_error=False)
        if run:
            with contextlib.redirect_stdout(printed):
                assert counterspin.cli.main(words) == 0
        return printed.getvalue()
    assert [program] == process.PYTHON
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        if words[0] == "-c":
            program = compile(words[1], "-c", "exec")
            patch.setattr(sys, "argv", words[1:])
            if run:
                exec(program, {})
        else:
            assert Path(words[0]).parent == FOLDER
            patch.setattr(sys, "argv", words)
            if run:
                runpy.run_path(words[0], run_name="__main__")
    return printed.getvalue()


def without_processes(monkeypatch, module, printed=None):
    """Run the commands of a benchmark in this process, or only parse them."""
    process = importlib.import_module("process")

    def output(command):
        found = in_this_process(command, run=printed is None or "--init" in command)
        return found if printed is None else printed

    def done(command, **_):
        return subprocess.CompletedProcess(command, 0, output(command))

    def measured(commands, repeats):
        assert repeats >= 1
        return {
            name: process.Measured((1.0,), (2.0,), 3.0, output(command))
            for name, command in commands.items()
        }

    stand_in = SimpleNamespace(run=done, PIPE=subprocess.PIPE, DEVNULL=subprocess.DEVNULL)
    monkeypatch.setattr(module, "subprocess", stand_in, raising=False)
    monkeypatch.setattr(module, "interleaved", measured)
    monkeypatch.setattr(
        module, "measure", lambda command, n: measured({0: command}, n)[0], raising=False
    )


def test_long_record_benchmark_runs_with_small_campaign(monkeypatch):
    pytest.importorskip("pandas")
    calibrate = importlib.import_module("calibrate")
    without_processes(monkeypatch, calibrate)
    monkeypatch.setattr(calibrate, "_compiled", lambda _: None)
    column = calibrate._column(".csv", 6000, 1)
    assert column["calibrate / polars"] == 1.0
    for who in ("calibrate", "peer"):
        assert abs(column[f"{who}: error of K_II / u"]) < 5.0
    assert column["peer: u of K_II (g/g²)"] == pytest.approx(
        column["calibrate: u of K_II (g/g²)"], rel=0.2
    )


@pytest.mark.parametrize("name", ["commands", "costs", "workers", "plan", "machine"])
def test_benchmark_commands_have_valid_arguments(name, monkeypatch):
    module = importlib.import_module(name)
    if name == "plan":
        monkeypatch.setattr(module, "_predictions", lambda *_: (1.0, 1.0))
    without_processes(monkeypatch, module, printed="1.0")
    tables = module.tables(False, 1)
    assert all(len(row) == len(table.columns) for table in tables for row in table.rows)
    json.dumps([table.rows for table in tables])


def test_campaign_of_page_is_valid(tmp_path):
    page = importlib.import_module("page")
    page.make(tmp_path / "100", 100)
    campaign = counterspin.read_campaign(tmp_path / "100")
    assert list(campaign.accelerometers) == ["Qx", "Qy"]
    assert (tmp_path / "100" / campaign.runs[0].record).exists()


@pytest.fixture
def benchmark_repository(tmp_path, monkeypatch):
    """Return `python benchmarks` in a repository of its own, where a study took four seconds."""
    spec = importlib.util.spec_from_file_location("all_benchmarks", FOLDER / "__main__.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    table = importlib.import_module("table")
    Tables = [table.Table("Study", "", ["", "time"], [["one", 4.0]])]
    monkeypatch.setattr(module, "BENCHMARKS", {"study": SimpleNamespace(tables=lambda *_: Tables)})
    monkeypatch.setattr(module, "ROOT", tmp_path)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "benchmarks.md").write_text(f"{table.BEGIN}\n{table.END}\n")
    return module.main


def test_local_measurements_do_not_change_documentation(benchmark_repository, tmp_path):
    load = importlib.import_module("table").load
    page = tmp_path / "docs" / "benchmarks.md"
    before = page.read_text()
    benchmark_repository(["--full"])
    assert not (tmp_path / "benchmarks").exists()
    assert page.read_text() == before
    assert load(tmp_path / "build" / "benchmarks")[0].rows == [["one", 4.0]]
    benchmark_repository(["--full", "--keep"])
    assert load(tmp_path / "benchmarks")[0].rows == [["one", 4.0]]
    assert "| one | 4 |" in page.read_text()
    with pytest.raises(SystemExit):
        benchmark_repository(["--keep"])
