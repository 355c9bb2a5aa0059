"""The benchmark scripts: their imports exist, and their commands have valid arguments."""

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
def _importable_scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    previous_modules = set(sys.modules)
    yield
    for name in set(sys.modules).difference(previous_modules).intersection(SCRIPTS):
        del sys.modules[name]


def parse_script(script):
    """Yield the syntax trees of a script and of the programs in its strings."""
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
        for tree in parse_script(script)
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    for node in imports:
        if isinstance(node, ast.Import):
            for name in node.names:
                assert own_module(name.name) is None or importlib.import_module(name.name)
        elif (module := own_module(node.module)) is not None:
            for name in node.names:
                assert hasattr(importlib.import_module(module), name.name), name.name


def own_module(module):
    """Return the name of a module of the package or a script, or None for other modules."""
    return module if module.partition(".")[0] in ("counterspin", *SCRIPTS) else None


def run_command(command, *, run=True):
    """Run a benchmark command in this process; without `run`, only parse its arguments.

    Returns its standard output.
    """
    process = importlib.import_module("process")
    [program], arguments = command[:1], command[1:]
    output = io.StringIO()
    if [program] == process.COUNTERSPIN:
        counterspin.cli.app.parse_args(arguments, exit_on_error=False, print_error=False)
        if run:
            with contextlib.redirect_stdout(output):
                assert counterspin.cli.main(arguments) == 0
        return output.getvalue()
    assert [program] == process.PYTHON
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(output):
        if arguments[0] == "-c":
            program = compile(arguments[1], "-c", "exec")
            patch.setattr(sys, "argv", arguments[1:])
            if run:
                exec(program, {})
        else:
            assert Path(arguments[0]).parent == FOLDER
            patch.setattr(sys, "argv", arguments)
            if run:
                runpy.run_path(arguments[0], run_name="__main__")
    return output.getvalue()


def replace_processes(monkeypatch, module, fixed_output=None):
    """Run the commands of a benchmark in this process; with `fixed_output`, only parse them."""
    process = importlib.import_module("process")

    def get_output(command):
        output = run_command(command, run=fixed_output is None or "--init" in command)
        return output if fixed_output is None else fixed_output

    def run(command, **_):
        return subprocess.CompletedProcess(command, 0, get_output(command))

    def measure_interleaved(commands, n_repeats):
        assert n_repeats >= 1
        return {
            name: process.Measurement((1.0,), (2.0,), 3.0, get_output(command))
            for name, command in commands.items()
        }

    fake_subprocess = SimpleNamespace(run=run, PIPE=subprocess.PIPE, DEVNULL=subprocess.DEVNULL)
    monkeypatch.setattr(module, "subprocess", fake_subprocess, raising=False)
    monkeypatch.setattr(module, "measure_interleaved", measure_interleaved)
    monkeypatch.setattr(
        module, "measure", lambda command, n: measure_interleaved({0: command}, n)[0], raising=False
    )


def test_long_record_benchmark_runs_with_small_campaign(monkeypatch):
    pytest.importorskip("pandas")
    calibrate = importlib.import_module("calibrate")
    replace_processes(monkeypatch, calibrate)
    monkeypatch.setattr(calibrate, "_compile_parser", lambda _: None)
    column = calibrate._measure_format(".csv", 6000, 1)
    assert column["calibrate / polars"] == 1.0
    for program in ("calibrate", "peer"):
        assert abs(column[f"{program}: error of K_II / u"]) < 5.0
    assert column["peer: u of K_II (g/g²)"] == pytest.approx(
        column["calibrate: u of K_II (g/g²)"], rel=0.2
    )


@pytest.mark.parametrize("name", ["commands", "costs", "workers", "plan", "machine"])
def test_benchmark_commands_have_valid_arguments(name, monkeypatch):
    module = importlib.import_module(name)
    if name == "plan":
        monkeypatch.setattr(module, "_time_predictions", lambda *_: (1.0, 1.0))
    replace_processes(monkeypatch, module, fixed_output="1.0")
    tables = module.tables(False, 1)
    assert all(len(row) == len(table.columns) for table in tables for row in table.rows)
    json.dumps([table.rows for table in tables])


def test_campaign_of_page_is_valid(tmp_path):
    page = importlib.import_module("page")
    page.write_campaign(tmp_path / "100", 100)
    campaign = counterspin.read_campaign(tmp_path / "100")
    assert list(campaign.accelerometers) == ["Qx", "Qy"]
    assert (tmp_path / "100" / campaign.runs[0].record).exists()


@pytest.fixture
def benchmark_repository(tmp_path, monkeypatch):
    """Return the main function of the benchmarks in a temporary repository with one result."""
    spec = importlib.util.spec_from_file_location("all_benchmarks", FOLDER / "__main__.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    table = importlib.import_module("table")
    results = [table.Table("Study", "", ["", "time"], [["one", 4.0]])]
    monkeypatch.setattr(module, "BENCHMARKS", {"study": SimpleNamespace(tables=lambda *_: results)})
    monkeypatch.setattr(module, "ROOT", tmp_path)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "benchmarks.md").write_text(f"{table.BEGIN_MARKER}\n{table.END_MARKER}\n")
    return module.main


def test_local_measurements_do_not_change_documentation(benchmark_repository, tmp_path):
    load = importlib.import_module("table").load
    page = tmp_path / "docs" / "benchmarks.md"
    original_text = page.read_text()
    benchmark_repository(["--full"])
    assert not (tmp_path / "benchmarks").exists()
    assert page.read_text() == original_text
    assert load(tmp_path / "build" / "benchmarks")[0].rows == [["one", 4.0]]
    benchmark_repository(["--full", "--keep"])
    assert load(tmp_path / "benchmarks")[0].rows == [["one", 4.0]]
    assert "| one | 4 |" in page.read_text()
    with pytest.raises(SystemExit):
        benchmark_repository(["--keep"])
