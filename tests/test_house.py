"""The rules of the house that no linter knows."""

import ast
import json
import re
import shutil
import socket
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from campaigns import SMALL, write_description
from packaging.requirements import Requirement

from counterspin._version import __version__
from counterspin.error_codes import CODES
from counterspin.physics.terms import PLATFORM_TERMS, TERMS
from counterspin.simulation.simulate import simulate

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "counterspin"
MODULES = sorted(PACKAGE.rglob("*.py"))
PINS = sorted((ROOT / "requirements").glob("*.txt"))
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]

#: Name below the package -> text.
SOURCES = {path.relative_to(PACKAGE).as_posix(): path.read_text("utf-8") for path in MODULES}


@cache
def nodes_of(source):
    """Return all nodes of a module's tree, the module first."""
    return list(ast.walk(ast.parse(source)))


def offences(look, among=SOURCES):
    """Return the non-empty results of `look(name, source)` by name."""
    findings = {name: look(name, source) for name, source in among.items()}
    return {name: finding for name, finding in findings.items() if finding}


# Modules


@pytest.mark.slow
def test_every_module_has_docstring():
    def silent(_, source):
        docstring = ast.get_docstring(nodes_of(source)[0]) or ""
        return len(docstring.partition("\n")[0].split()) < 3

    assert offences(silent) == {}
    assert offences(silent, {"a": "x = 1", "b": '"""One word."""'}) == {"a": True, "b": True}


RELATIVE_OPENING = re.compile(r'"""(?:Return what|What |Return whether [^.]* is one)')
VAGUE_NAMES = {"one", "own", "each", "other", "every", "there", "here"}


def vague_names(source):
    """Return the names that a module binds and that say neither type nor role."""
    nodes = nodes_of(source)
    stored = [n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
    names = [*stored, *(n.arg for n in nodes if isinstance(n, ast.arg))]
    return [name for name in names if name in VAGUE_NAMES]


def test_relative_clauses_and_vague_names_are_bounded():
    """The bounds are the current counts and may only decrease."""
    assert not any(RELATIVE_OPENING.search(text) for text in SOURCES.values())
    assert sum(len(vague_names(text)) for text in SOURCES.values()) <= 39
    assert vague_names("for one in rows:\n    f = lambda own: own") == ["one", "own"]


PARAMETER_LIST = re.compile(r"\n\n(?=[a-z_]\w*(?:, \w+)*: )(?:.+\n?)+")


def unknown_parameters(_, source):
    """Return the names in the lists of parameters of docstrings that are not parameters."""
    unknown = []
    for node in nodes_of(source):
        if isinstance(node, ast.FunctionDef):
            given = node.args
            arguments = [
                *given.posonlyargs,
                *given.args,
                *given.kwonlyargs,
                given.vararg,
                given.kwarg,
            ]
            names = {argument.arg for argument in arguments if argument}
            for block in PARAMETER_LIST.findall(ast.get_docstring(node) or ""):
                listed = re.findall(r"(?m)^([a-z_]\w*(?:, \w+)*): ", block)
                unknown += [name for n in listed for name in n.split(", ") if name not in names]
    return unknown


def test_docstrings_list_existing_parameters():
    assert offences(unknown_parameters) == {}
    text = 'def f(a, b):\n    """Add numbers.\n\n    a: First.\n    c: Second.\n    """'
    assert offences(unknown_parameters, {"a": text}) == {"a": ["c"]}


def test_modules_have_at_most_600_lines():
    assert {name: n for name, text in SOURCES.items() if (n := text.count("\n")) > 600} == {}


def test_functions_have_at_most_seven_parameters():
    def long(name, source):
        return set(functions_with_many_parameters(source)) - set(MANY_PARAMETERS.get(name, ()))

    assert offences(long) == {}


#: The physics of a term has as many as the paper's equation has symbols, and what reads a file that
#: nothing describes has as many as the file may leave unsaid.
MANY_PARAMETERS = {
    "monitoring/noise.py": ["noise"],
    "physics/as_printed.py": ["strobe_error", "strobe_curvature"],
    "studies/study.py": ["study"],
}


def functions_with_many_parameters(source):
    functions = []
    for node in nodes_of(source):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            given = node.args
            named = [*given.posonlyargs, *given.args, *given.kwonlyargs]
            own = bool(named) and named[0].arg in ("self", "cls")
            if len(named) - own + (given.vararg is not None) > 7:
                functions.append(node.name)
    return functions


def test_many_parameters_are_detected():
    assert functions_with_many_parameters("def f(a, b, /, c, d, *e, f, g, h): ...") == ["f"]
    assert functions_with_many_parameters("def f(self, a, b, c, *, d, e, f, g, **h): ...") == []


def test_frozen_classes_use_frozen_decorator():
    """The dataclass of the standard library takes longer to load."""
    slow = re.compile(r"^@dataclass\(frozen=True(, eq=False)?\)", re.M)
    assert offences(lambda _, source: slow.findall(source)) == {}


def test_class_names_are_unique():
    places = {}
    for name, source in SOURCES.items():
        for node in nodes_of(source):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(name)
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


def test_package_docstrings_list_modules():
    named, there = {}, {}
    for path in MODULES:
        room = path.parent
        if path.name == "__init__.py" and room != PACKAGE:
            bullets = "".join(re.findall(r"^- (?:.+\n)(?:  .+\n)*", path.read_text("utf-8"), re.M))
            heads = "".join(re.findall(r"((?:`\w+`(?:,\s+)?)+):", bullets))
            named[room.name] = set(re.findall(r"`(\w+)`", heads))
            there[room.name] = {one.stem for one in room.glob("[a-z]*.py")}
            there[room.name] |= {one.parent.name for one in room.glob("*/__init__.py")}
    assert len(there) > 20
    assert named == there
    assert {room: len(modules) for room, modules in there.items() if len(modules) > 25} == {}


def imports_of(name, source, among):
    """Return the modules of `among` that a module imports, including deferred imports."""
    modules = set()
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            inside = {f"{node.module}.{alias.name}" for alias in node.names} & among
            modules |= inside or {node.module}
    return (modules & among) - {name}


def test_imports_have_no_cycle():
    """Indirect and deferred imports count; TopologicalSorter raises for a cycle."""
    texts = {
        ".".join(["counterspin", *Path(name).with_suffix("").parts]).removesuffix(
            ".__init__"
        ): source
        for name, source in SOURCES.items()
    }
    needs = {name: imports_of(name, source, set(texts)) for name, source in texts.items()}
    assert sum(map(len, needs.values())) > 1000
    assert set(TopologicalSorter(needs).static_order()) == set(texts)


def test_deferred_import_is_detected():
    source = "def f():\n    from a import b\n    import a.c\n"
    assert imports_of("d", source, {"a", "a.b", "a.c", "d"}) == {"a.b", "a.c"}


def terms_listed(literal):
    """Return the symbols that a literal lists, bare or at the head of its rows."""
    symbols = []
    for element in literal.elts:
        if isinstance(element, ast.Tuple | ast.List) and element.elts:
            head = element.elts[0]
        elif isinstance(element, ast.Call) and element.args:
            head = element.args[0]
        else:
            head = element
        if isinstance(head, ast.Constant) and (head.value in TERMS or head.value in PLATFORM_TERMS):
            symbols.append(head.value)
    return symbols


def lists_of_terms(source):
    """Return every literal of a module that lists three or more terms."""
    literals = (
        node for node in nodes_of(source) if isinstance(node, ast.Tuple | ast.List | ast.Set)
    )
    return [listed for literal in literals if len(listed := terms_listed(literal)) >= 3]


# A choice of terms is no list of terms; each is named here, so that a new one is thought about.
CHOICES = {
    "campaign/model.py": [["K_F", "K_I", "K_II", "K_III"]],  # estimated where none are named
    "reproduction/equations.py": [["K_II", "K_III", "K_IP"]],  # the integrals printed under Eq. 13
}
TABLE = "physics/terms.py"


def test_no_second_list_of_coefficients():
    listed = offences(lambda _, source: lists_of_terms(source))
    assert set(TERMS) in map(set, listed.pop(TABLE))
    assert listed == CHOICES


def test_second_list_of_coefficients_is_detected():
    assert lists_of_terms("x = ('K_F', 'K_I', 'K_II')")
    assert lists_of_terms("x = [('K_F', 'g'), ('K_I', 'g/g'), ('platform.drift.up', 'rad/s')]")
    assert lists_of_terms("x: Literal['K_F', 'K_I', 'K_II']")
    assert not lists_of_terms("x = ('K_F', 'K_II')")


# Tests


TESTS = [path.relative_to(ROOT / "tests") for path in sorted((ROOT / "tests").rglob("test_*.py"))]

#: Tests of what is no module: benchmarks, documentation, house, interface, published sources.
OF_NO_MODULE = re.compile(
    r"test_(benchmarks|docs\w*|fuzz|house|mutants|notebook_tasks|python|wheelhouse)\.py|published/test_\w+\.py"
)


def mirrors(test):
    """Return whether a test file is named after a module (and aspect) or package."""
    room = PACKAGE / test.parent
    subject = test.stem.removeprefix("test_")
    modules = {path.stem for path in room.glob("[a-z]*.py")} | {room.name}
    return any(subject == module or subject.startswith(f"{module}_") for module in modules)


def test_test_files_mirror_package():
    of_modules = [test for test in TESTS if not OF_NO_MODULE.fullmatch(test.as_posix())]
    assert len(of_modules) > 200
    assert [test.as_posix() for test in of_modules if not mirrors(test)] == []
    assert not mirrors(Path("physics/test_nothing.py"))


@pytest.fixture
def quick(tmp_path):
    """Run pytest, with these options, on tests that wait; what its last lines count.

    With the plugin `clock` no time passes but that in which they wait.
    """
    (tmp_path / "clock.py").write_text(
        "import time, _pytest.timing\n"
        "passed = [0.0]\n"
        "time.sleep = passed.append\n"
        "time.monotonic = _pytest.timing.perf_counter = lambda: sum(passed)\n"
    )
    (tmp_path / "conftest.py").write_text((ROOT / "tests" / "conftest.py").read_text("utf-8"))
    (tmp_path / "test_it.py").write_text(
        "import time, pytest\n"
        "@pytest.fixture(scope='module')\ndef waiting():\n    time.sleep(0.5)\n"
        "def test_first(waiting): pass\n"
        "def test_second(waiting): pass\n"
        "@pytest.mark.parametrize('s', [0.4, 0.0])\ndef test_long(s):\n    time.sleep(s)\n"
        "@pytest.mark.parametrize('s', [0, 1])\ndef test_short(s): pass\n"
    )

    def run(*options):
        words = [sys.executable, "-m", "pytest", "-q", f"--rootdir={tmp_path}", *options]
        ended = subprocess.run(words, check=False, capture_output=True, text=True, cwd=tmp_path)
        return [int(count) for count in re.findall(r"(\d) (?:passed|tests|for)", ended.stdout)]

    return run


def test_quick_skips_slow_tests(quick, tmp_path):
    """A slow shared fixture makes all tests that use it slow."""
    assert quick("--write-slow", "-p", "clock") == [6]
    listed = (tmp_path / "slow.txt").read_text("utf-8").split()
    assert listed == ["test_it.py::test_first", "test_it.py::test_long", "test_it.py::test_second"]
    assert quick("--quick", "60", "-p", "clock") == [4, 0, 2]


@pytest.mark.slow
def test_quick_starts_no_test_after_time_limit(quick, tmp_path):
    (tmp_path / "slow.txt").write_text("test_it.py::test_long\n")
    assert quick("--quick", "0", "-n", "2") == [2, 4]


def test_listed_slow_tests_exist():
    """`make slow` rewrites the list."""
    listed = (ROOT / "tests" / "slow.txt").read_text("utf-8").split()
    assert listed == sorted(set(listed))
    for name in listed:
        file, *_, function = name.split("::")
        assert re.search(rf"^\s*def {function}\(", (ROOT / file).read_text("utf-8"), re.M), name


# The way through the house


LAYERS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
    "importlinter"
]["contracts"][0]["layers"]


def test_package_table_follows_import_order():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = page.partition("| package |")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| (`.*?) \|", table, re.M)
    packages = [set(re.findall(r"`(\w+)/?`", row)) for row in rows]
    assert packages == [set(layer.split(" | ")) for layer in reversed(LAYERS)]


def test_files_named_in_record_walkthrough_exist():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([a-z_]+(?:/[a-z_]+)+\.py)`", page))
    assert len(named) > 20
    assert [
        name for name in named if not ((PACKAGE / name).exists() or (ROOT / name).exists())
    ] == []


def test_reading_path_of_internals_is_short():
    page = (ROOT / "docs" / "internals.md").read_text(encoding="utf-8")
    linked = re.findall(r"\(\.\./src/counterspin/(\S+\.py)\)", page)
    assert len(linked) == len(set(linked)) > 15
    assert sum(SOURCES[name].count("\n") for name in linked) <= 7000


# Words


#: Custom properties of style sheets, which look like options; the words that a result keeps, and
#: those that the page shows; pip's options.
DASHED = {
    "application/commands.py",
    "calibration/options.py",
    "errors.py",
    "reports/charts.py",
}
FLAG = re.compile(r"(?<![\w-])--[a-z]")


def flags_named(source):
    """Return the texts of a module, docstrings too, that name an option of the command line."""
    return [
        node.value
        for node in nodes_of(source)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and FLAG.search(node.value)
    ]


def test_lower_packages_name_no_command_line_option():
    """Lower packages name the argument; the command line adds the option."""
    named = offences(lambda name, source: not name.startswith("cli/") and flags_named(source))
    assert {name: flags for name, flags in named.items() if name not in DASHED} == {}


def test_command_line_option_is_detected():
    assert flags_named('raise Error(f"{path} exists; give --overwrite")')
    assert not flags_named('raise Error(f"{path} exists; give `overwrite=True` -- or not")')


def test_description_file_name_is_defined_once():
    named = [
        name
        for name, source in SOURCES.items()
        for node in nodes_of(source)
        if isinstance(node, ast.Constant) and node.value == "campaign.toml"
    ]
    assert named == ["campaign/documents.py"]


# Start-up


HELP = "from counterspin.cli import main; sys.argv[1:] = ['--help']; main()"


def modules_loaded_by(statement):
    """Return the names of all modules that a fresh interpreter has loaded after a statement."""
    code = f"""
import sys
try:
    {statement}
except SystemExit as end:
    assert not end.code
print("LOADED", *sys.modules)
"""
    run = subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, encoding="utf-8", check=True
    )
    return set(run.stdout.rpartition("LOADED ")[2].split())


@pytest.mark.parametrize("statement", ["import counterspin", HELP], ids=["import", "help"])
def test_start_up_loads_no_unused_slow_module(statement):
    loaded = modules_loaded_by(statement)
    assert "counterspin" in loaded
    assert loaded & {"matplotlib", "dask", "scipy.stats", "cyclopts.validators"} == set()


def test_javascript_imports_have_no_cycle():
    """Indirect imports count; TopologicalSorter raises for a cycle."""
    matches = {
        script.name: re.findall(r'from "\./(\w+\.js)"', script.read_text(encoding="utf-8"))
        for script in (PACKAGE / "application" / "assets").glob("*.js")
    }
    assert list(TopologicalSorter(matches).static_order())[-1] == "main.js"


def test_calibration_loads_no_unused_slow_module(tmp_path):
    """Loading SciPy would take as long as the whole computation."""
    simulate(write_description(tmp_path, SMALL, "plan.toml"), tmp_path)
    loaded = modules_loaded_by(
        f"from counterspin.cli import main; main(['calibrate', {str(tmp_path)!r}])"
    )
    assert "counterspin.calibration.joint" in loaded
    assert loaded & {"scipy", "matplotlib", "h5py", "dask", "difflib", "rich._emoji_codes"} == set()


def test_only_three_modules_start_processes():
    """Two modules run no program of the working folder; one runs a program that the user names."""
    start = re.compile(
        r"\b(Popen|get_context|ProcessPoolExecutor|SpawnContext|os\.(exec|spawn|popen|system))\b"
        r"|^\s*(import|from) subprocess\b",
        re.MULTILINE,
    )
    starting = set(offences(lambda _, source: start.search(source)))
    assert starting == {"workers.py", "records/reader_process.py", "certificates/signers.py"}


def test_physics_and_inference_load_no_slow_module():
    below = [
        path.relative_to(PACKAGE.parent).with_suffix("").as_posix().replace("/", ".")
        for room in ("physics", "inference")
        for path in sorted((PACKAGE / room).glob("[a-z]*.py"))
    ]
    loaded = modules_loaded_by(f"import {', '.join(below)}")
    assert set(below) <= loaded
    assert loaded & {"matplotlib", "scipy", "polars", "pydantic"} == set()


# What tests may do


def test_network_access_in_tests_raises():
    with pytest.raises(PermissionError, match=r"reaches the network: 1\.1\.1\.1"):
        socket.create_connection(("1.1.1.1", 80), timeout=1.0)


# What is published


def extras():
    """Return the extras except those that only the Makefile installs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return set(project["optional-dependencies"]) - {"bench", "dev", "docs"}


def test_named_extras_exist_and_are_documented():
    texts = {path: path.read_text(encoding="utf-8") for path in [*MODULES, *PAGES]}
    everything = "\n".join(texts.values())
    matches = set(re.findall(r"install_command\([\"'](\w+)[\"']\)", everything))
    named = set(re.findall(r"\bextra(?:\]\(\S+\))?\s`+(\w+)`", everything))
    named |= set(re.findall(r"\.(?:whl)?\[([a-z]+)\]'", everything))
    quickstart = texts[ROOT / "docs" / "quickstart.md"]
    section = quickstart.partition("## Extras")[2].partition("\n## ")[0]
    assert matches == named == extras()
    assert set(re.findall(r"^\| `(\w+)`", section, re.MULTILINE)) == extras()
    assert set(re.findall(r"'\.\[(\w+)\]'", texts[ROOT / "README.md"])) == extras()
    assert set(re.findall(r"counterspin-([\d.]+)-py3", quickstart)) == {__version__}


def test_instructions_do_not_install_from_index():
    by_name = re.compile(r"pip install\s+['\"]*counterspin\b(?!-)")
    texts = [*MODULES, *PAGES, *(PACKAGE / "application").rglob("*.js")]
    assert [path.name for path in texts if by_name.search(path.read_text(encoding="utf-8"))] == []
    assert by_name.search("pip install 'counterspin[excel]'")


def test_changelog_starts_with_current_version():
    """Unreleased changes may precede it."""
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    changelog = changelog.replace("\n## [Unreleased]\n", "\n", 1)
    entries = re.findall(r"^## \[(.+)\] - (Unreleased|\d{4}-\d\d-\d\d)$", changelog, re.MULTILINE)
    assert len(entries) == len(re.findall(r"^## ", changelog, re.MULTILINE))
    assert entries[0][0] == __version__


def test_citation_has_current_version():
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_pages_name_existing_make_targets():
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    assert {"demo", "test", "lint", "bench"} <= targets
    named = {
        target
        for page in PAGES
        for target in re.findall(r"(?:^|`)make (\w+)", page.read_text(encoding="utf-8"), re.M)
    }
    assert named <= targets


@pytest.mark.parametrize("pins", PINS, ids=lambda path: path.name)
def test_pins_have_hashes_and_no_url(pins):
    text = pins.read_text(encoding="utf-8")
    logical = re.sub(r"\\\n", " ", re.sub(r"^ *#.*\n", "", text, flags=re.MULTILINE)).splitlines()
    assert logical
    pin = re.compile(r"[a-z0-9.-]+==\S+( ; [^\\-]+?)?( +--hash=sha256:[0-9a-f]{64})+")
    assert [line for line in logical if not pin.fullmatch(line)] == []
    assert "//" not in text


@pytest.mark.parametrize(
    ("extra", "pins"),
    [
        ("dev", "dev.txt"),
        ("bench", "bench.txt"),
        ("docs", "docs.txt"),
        *((extra, "package.txt") for extra in sorted(extras())),
    ],
)
def test_pins_satisfy_requirements(extra, pins):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = [*project["dependencies"], *project["optional-dependencies"][extra]]
    text = (ROOT / "requirements" / pins).read_text(encoding="utf-8")
    pinned = {}
    for name, version in re.findall(r"^([a-z0-9.-]+)==([^ ;]+)", text, re.MULTILINE):
        pinned.setdefault(name, []).append(version)
    for requirement in map(Requirement, requirements):
        versions = pinned.get(requirement.name.lower(), [])
        assert versions, f"{requirement.name} has no pin: run make lock"
        assert all(requirement.specifier.contains(version) for version in versions)


@pytest.mark.parametrize("pins", ["bench.txt", "docs.txt", "package.txt"])
def test_pins_of_environment_are_consistent(pins):
    """The pins of an extra are installed in addition to those of dev."""
    line = re.compile(r"^([a-z0-9.-]+)==([^ ;]+)", re.MULTILINE)
    dev, more = (
        dict(line.findall((ROOT / "requirements" / name).read_text(encoding="utf-8")))
        for name in ("dev.txt", pins)
    )
    assert len(dev.keys() & more.keys()) > 10
    assert {name: more[name] for name in dev.keys() & more.keys() if more[name] != dev[name]} == {}


def test_javascript_lock_has_hashes_and_no_url():
    folder = ROOT / "requirements" / "javascript"
    wanted = json.loads((folder / "package.json").read_text(encoding="utf-8"))
    text = (folder / "package-lock.json").read_text(encoding="utf-8")
    packages = json.loads(text)["packages"]
    assert packages.pop("") == {"devDependencies": wanted["devDependencies"]}
    assert packages
    assert all(package["integrity"].startswith("sha512-") for package in packages.values())
    assert "//" not in re.sub(r'"sha512-[^"]*"', "", text)


def test_lint_without_node_prints_skipped(tmp_path):
    tools = tmp_path / "bin"
    tools.mkdir()
    for name in ("make", "sh", "rm", "mkdir", "cp", "touch"):
        path = shutil.which(name)
        if path is None:
            pytest.skip(f"there is no {name}")
        (tools / name).symlink_to(path)
    process = subprocess.run(
        [tools / "make", f"VENV={tmp_path}", tmp_path / "typescript" / ".ready"],
        cwd=ROOT,
        env={"PATH": str(tools)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "Skipped: the types of JavaScript" in process.stderr
    assert not (tmp_path / "typescript" / ".ready").exists()


def test_type_checks_are_strict_in_all_packages():
    types = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mypy"]
    assert types["strict"] is True
    # What others wrote may lack types; nothing of ours is let off.
    overrides = types.pop("overrides")
    assert not any(
        name.startswith("counterspin") for override in overrides for name in override["module"]
    )
    script = json.loads((ROOT / "jsconfig.json").read_text(encoding="utf-8"))
    assert script["compilerOptions"]["strict"] is True
    covered = {path for pattern in script["include"] for path in ROOT.glob(pattern)}
    own = {path for path in PACKAGE.rglob("*.js") if "uplot" not in path.parts}
    assert own == covered


def test_types_are_checked_per_platform_in_single_process():
    """Worker processes of mypy fail on a busy machine."""
    make = shutil.which("make") or pytest.skip("there is no make")
    shown = subprocess.run(
        [make, "--dry-run", "lint"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    commands = [line for line in shown.stdout.splitlines() if " -m mypy " in line]
    platforms = [command.partition("--platform ")[2].split()[:1] for command in commands]
    # The last process checks the scripts of benchmarks/ with the cache of the first.
    assert platforms == [["linux"], ["darwin"], ["win32"], ["linux"]]
    assert len({re.search(r"--cache-dir (\S+)", command)[1] for command in commands}) == 3
    whole, *selected, _ = commands
    assert whole.endswith("--platform linux")
    assert all("platform_modules.py)" in command for command in selected)
    types = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mypy"]
    scripts = {path.stem for path in (ROOT / "benchmarks").glob("*.py")}
    assert scripts in [set(override["module"]) for override in types["overrides"]]
    assert "num_workers" not in types
    assert not any("--num-workers" in command for command in commands)


def test_platform_dependent_modules_are_selected():
    """Their definitions do not depend on the platform, so importing modules do not either."""
    shown = subprocess.run(
        [sys.executable, ROOT / "requirements" / "platform_modules.py"],
        capture_output=True,
        text=True,
        check=True,
    )
    selected = {Path(line).relative_to(PACKAGE).as_posix() for line in shown.stdout.splitlines()}
    # Names of one platform, by the documentation of Python.
    some = r"\b(sys\.platform|fcntl|msvcrt|resource\.|WinDLL|os\.(fork|getuid|killpg|sched_|setp))"
    names = {name for name, source in SOURCES.items() if re.search(some, source)}
    assert len(names) >= 10
    assert names <= selected
    assert len(selected) < 60
    assert not offences(lambda name, source: re.search(r"^(el)?if .*sys\.platform", source, re.M))


def test_every_test_file_is_run_by_make():
    make = shutil.which("make") or pytest.skip("there is no make")
    shown = subprocess.run(
        [make, "--dry-run", "test", "docs-tests"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    fast, pages = (line.split() for line in shown.stdout.splitlines() if " -m pytest -n " in line)
    ignored = {word.removeprefix("--ignore=") for word in fast if word.startswith("--ignore=")}
    files = {f"tests/{path.as_posix()}": ROOT / "tests" / path for path in TESTS}
    assert ignored == {word for word in pages if word in files}
    assert not [word for word in fast if word in files]
    shown = subprocess.run(
        [make, "--dry-run", "ci"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    (everything,) = (line for line in shown.stdout.splitlines() if " -m pytest -n " in line)
    assert everything.split()[0] == "COUNTERSPIN_SITE=build/site"
    assert "--ignore" not in everything
    assert "tests/" not in everything
    browser = {name for name, path in files.items() if "needs_chromium" in path.read_text("utf-8")}
    assert browser - {"tests/test_house.py"} <= ignored


TEXT = {".py", ".md", ".toml", ".txt", ".json", ".csv", ".svg", ".html", ".css", ".ts", ""}
MACHINE_PATH = re.compile(r"(?<![\w.])/(?:home|root|Users|work)/|\b[A-Z]:\\+Users\b")


def test_no_file_contains_local_path():
    places = ("src", "tests", "docs", "benchmarks", "requirements", ".ci")
    files = [path for place in places for path in (ROOT / place).rglob("*")]
    # In a linked worktree .git is a file that holds a path.
    files += (path for path in ROOT.iterdir() if path.name != ".git")
    offenders = [
        path.relative_to(ROOT).as_posix()
        for path in files
        if path.is_file()
        and path.suffix in TEXT
        and MACHINE_PATH.search(path.read_text(encoding="utf-8"))
    ]
    assert offenders == []
    assert MACHINE_PATH.search("see " + "/home" + "/somebody/records")


# Codes of errors

#: Function -> position of its argument that is a code.
POSITIONS = {"InputError": 1, "Problem": 1, "error_code": 1, "add": 2, "_fail": 2}
#: Classes of errors without a code of their own.
GENERAL = {"CounterspinError", "RecordError", "CampaignError"}


def name_of(call):
    return ast.unparse(call.func).rpartition(".")[2]


def constants(node):
    if isinstance(node, ast.IfExp):
        return [*constants(node.body), *constants(node.orelse)]
    return [node.value] if isinstance(node, ast.Constant) and isinstance(node.value, str) else []


def codes_in(source):
    """Return all codes that a module gives to errors."""
    codes = set()
    for node in nodes_of(source):
        if isinstance(node, ast.Call):
            name, place = name_of(node), POSITIONS.get(name_of(node), 99)
            of_problems = name != "add" or "problems" in ast.unparse(node.func)
            codes |= (
                set(constants(node.args[place]))
                if len(node.args) > place and of_problems
                else set()
            )
            if name.endswith(("Error", "Warning")):
                codes |= {
                    c for word in node.keywords if word.arg == "code" for c in constants(word.value)
                }
        elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            codes |= set(constants(node.value)) if ast.unparse(target) == "code" else set()
        elif isinstance(node, ast.Dict):
            pairs = zip(node.keys, node.values, strict=True)
            codes |= {
                c
                for key, value in pairs
                if key and constants(key) == ["code"]
                for c in constants(value)
            }
    return codes


def without_code(_, source):
    """Return the lines that raise or return a general error without a code."""
    lines = []
    for node in nodes_of(source):
        call = getattr(node, "exc" if isinstance(node, ast.Raise) else "value", None)
        if not (isinstance(node, ast.Raise | ast.Return) and isinstance(call, ast.Call)):
            continue
        if name_of(call) not in GENERAL or "code" in {word.arg for word in call.keywords}:
            continue
        # Problems that were collected have codes.
        if name_of(call) != "CampaignError" or isinstance(call.args[1], ast.List):
            lines.append(call.lineno)
    return lines


def test_error_codes_are_described_and_used():
    used = set().union(*(codes_in(s) for name, s in SOURCES.items() if name != "error_codes.py"))
    assert used == set(CODES)
    assert codes_in(
        'raise RecordError("x", code="a")\nproblems.add(p, "x", "b" if c else "d")'
    ) == {
        "a",
        "b",
        "d",
    }


def test_error_codes_and_descriptions_have_uniform_format():
    assert [code for code in CODES if not re.fullmatch(r"[a-z]+(-[a-z]+)*", code)] == []
    assert [text for text in CODES.values() if not text.endswith(".") or len(text) > 80] == []
    text = SOURCES["error_codes.py"]
    assert [code for code in CODES if text.count(f'\n    "{code}":') != 1] == []


def test_every_error_has_code():
    assert offences(without_code) == {}
    assert without_code("", 'raise RecordError("x")\nraise UsageError("x", ["y"])') == [1]
    assert without_code("", 'return CampaignError("x", ["y"])\nraise CampaignError(a, b)') == [1]
