"""The pages do what they say: commands run, Python runs, campaigns are read, numbers agree.

Each page is read from the top in an empty folder with records of the paper's plan in
``my-campaign/``. Fenced blocks are taken by their language:

- ``toml``: checked as a campaign, or as a plan of readings; a fragment is checked in the place of
  the same keys of the starter. ``<!-- file: PATH -->`` above it writes it there.
- ``csv``: written to the file named above it.
- ``bash``, ``sh``: lines that begin with ``counterspin`` are run and must succeed.
- ``console``: the same after ``$ ``, and what follows must be what is printed; a line ``...``
  stands for any lines.
- ``python``: executed, one namespace a page.
- ``matlab``: see `test_docs_matlab`.
"""

import re
import runpy
import shlex
import shutil
import sys
import tempfile
import tomllib
from functools import partial
from importlib.resources import files
from itertools import pairwise
from pathlib import Path

import pytest

import counterspin as cs
from counterspin import cli
from counterspin.planning import plan as planning
from counterspin.planning.stations import read_reading_plan

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").rglob("*.md"))
BLOCK = re.compile(
    r"(?:^<!-- file: (?P<file>\S+) -->\n)?^```(?P<language>\w+)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")

#: Folder and text of a plan -> what was found.
SEARCHED = {}

every_page = pytest.mark.parametrize(
    "page", [README, *DOCS], ids=lambda path: path.relative_to(ROOT).as_posix()
)


@pytest.fixture(scope="session")
def records(tmp_path_factory):
    """Return a folder with simulated records of the plan in the paper."""
    return Path(cs.demo(tmp_path_factory.mktemp("records")).campaign.folder)


@pytest.fixture
def working_folder(tmp_path, monkeypatch, records):
    """Change to an empty folder with the records and a terminal of 80 columns."""
    (tmp_path / "my-campaign").mkdir()
    for record in records.glob("*.csv"):
        shutil.copy(record, tmp_path / "my-campaign")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    return tmp_path


def blocks(page):
    return list(BLOCK.finditer(page.read_text(encoding="utf-8")))


def run(command, capsys):
    """Run one command line of counterspin and return what it prints."""
    words = shlex.split(command, comments=True)
    assert words[0] == "counterspin"
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planning, "plan", partial(plan_once, planning.plan))
        status = cli.main(words[1:])
    printed = capsys.readouterr()
    assert status == 0, printed.err
    return printed.out


def plan_once(plan, file):
    """Plan a file as `plan` does, with a cache per folder."""
    key = (Path.cwd(), file.read_text(encoding="utf-8"))
    if key not in SEARCHED:
        SEARCHED[key] = plan(file)
    return SEARCHED[key]


def assert_same_output(shown, printed):
    """Compare the output on a page with the printed output, numbers to the last digit."""
    shown, printed = (text.rstrip().splitlines() for text in (shown, printed))
    parts = " \n".join(" ".join(line.split()) for line in shown).split("...")
    text = " \n".join(" ".join(line.split()) for line in printed)
    place = 0
    for part in parts:
        pattern = NUMBER.sub("\0", part.strip())
        regular = re.escape(pattern).replace("\0", f"({NUMBER.pattern})").replace(r"\ \n", r" ?\n")
        match = re.compile(regular).search(text, place)
        assert match, f"not printed:\n{part}\nbut:\n{text}"
        assert len(parts) > 1 or match.span() == (0, len(text)), text
        for ours, theirs in zip(NUMBER.findall(part), match.groups(), strict=True):
            digits = len(ours.partition("e")[0].partition(".")[2])
            scale = float("1e" + (ours.partition("e")[2] or "0"))
            assert abs(float(ours) - float(theirs)) <= 1.01 * 10.0**-digits * scale, part
        place = match.end()


def inline(value):
    """Write a value as TOML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{k}" = {inline(v)}' for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(inline, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, int | float) else f'"{value}"'


def complete(fragment):
    """Return the starter campaign with the sections of a fragment replaced."""
    starter = files("counterspin.ingest") / "starter.toml"
    document = tomllib.loads(starter.read_text("utf-8"))
    given = tomllib.loads(fragment)
    for key, value in given.items():
        table = isinstance(value, dict) and key not in {"noise", "model"}
        document[key] = document.get(key, {}) | value if table else value
    return "".join(f"{key} = {inline(value)}\n" for key, value in document.items())


def run_block(block, namespace, capsys):
    """Run the code or command of a block."""
    text = block["text"]
    match block["language"]:
        case "toml":
            place = Path(block["file"] or "fragment.toml")
            place.parent.mkdir(exist_ok=True)
            whole = "schema =" in text
            place.write_text(text if whole else complete(text), encoding="utf-8")
            if "[[stations]]" in text:
                read_reading_plan(place)
            else:
                cs.read_campaign(place)
        case "csv":
            Path(block["file"]).parent.mkdir(exist_ok=True)
            Path(block["file"]).write_text(text, encoding="utf-8")
        case "bash" | "sh":
            for line in text.splitlines():
                if line.startswith("counterspin "):
                    run(line, capsys)
        case "console":
            for command, shown in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", text, re.MULTILINE):
                assert_same_output(shown, run(command, capsys))
        case "python":
            exec(compile(text, "page", "exec"), namespace)
        case "json":
            cs.Result.model_validate_json(text)
        case other:
            assert other in {"text", "matlab"}, f"no rule for a block of {other}"


@every_page
def test_examples_of_page_print_shown_output(page, working_folder, capsys):
    namespace = {}
    for block in blocks(page):
        run_block(block, namespace, capsys)


@every_page
def test_links_have_existing_targets(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[\w-]+)?\)", text):
        if "://" not in target:
            assert (page.parent / target).exists(), target


def test_readme_lists_every_command():
    rows = re.findall(r"^\| `counterspin (\w+)", README.read_text(encoding="utf-8"), re.MULTILINE)
    assert rows == sorted(rows, key=rows.index)
    assert set(rows) == {name for name in cli.app if not name.startswith("-")}


def test_picture_matches_demonstration(records, tmp_path):
    from counterspin.reports.charts import save_figure
    from counterspin.reproduction.page import demonstration_plots

    # Not byte for byte: matplotlib versions differ in the digits of a path.
    save_figure(demonstration_plots(cs.demo(records, overwrite=True)), tmp_path / "now.svg")
    now, kept = (
        path.read_text(encoding="utf-8")
        for path in (tmp_path / "now.svg", ROOT / "docs" / "images" / "displacement.svg")
    )
    labels = re.compile(r"<text [^>]*>([^<]*)</text>")
    assert labels.findall(kept) == labels.findall(now)
    assert kept.count("<use ") == pytest.approx(now.count("<use "), abs=5)
    assert len(re.findall(r"<use ", kept)) > 300


# The rules of this file


def test_output_comparison_detects_different_number():
    assert_same_output("K = 1.25 ± 0.02\n", "K  =  1.25 ± 0.02  \n")
    assert_same_output("a\n...\nd 4\n", "a\nb\nc\nd 4\n")
    for wrong in ("K = 1.27 ± 0.02", "K = 1.25 ± 0.02 m", "k = 1.25 ± 0.02", "K = 1.25"):
        with pytest.raises(AssertionError):
            assert_same_output(wrong, "K = 1.25 ± 0.02\n")


def test_blocks_are_found_with_file_names():
    text = "<!-- file: a.toml -->\n```toml\nx = 1\n```\n\n```python\ny = 2\n```\n"
    first, second = BLOCK.finditer(text)
    assert (first["file"], first["language"], first["text"]) == ("a.toml", "toml", "x = 1\n")
    assert (second["file"], second["language"]) == (None, "python")


def test_heading_levels_are_not_skipped():
    for page in [README, *DOCS]:
        text = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.M | re.DOTALL)
        levels = [len(marks) for marks in re.findall(r"^(#+) ", text, re.MULTILINE)]
        assert levels[0] == 1
        assert levels.count(1) == 1
        assert all(after <= before + 1 for before, after in pairwise(levels)), page


def unknown_result_attributes(text):
    """Return the attributes of `result` in a page that a `Result` does not have."""
    names = set(re.findall(r"`result\.([a-z_]+)[.(\[`]", text)) - {"json", "csv", "mat", "xlsx"}
    known = {*cs.Result.model_fields, *dir(cs.Result)}
    return sorted(names - known)


def test_attributes_of_result_in_text_exist():
    text = "\n".join(page.read_text(encoding="utf-8") for page in [README, *DOCS])
    assert unknown_result_attributes(text) == []
    assert unknown_result_attributes("`result.table()`, `result.frame()`") == ["frame"]


@pytest.mark.parametrize(
    "study", ["coverage", "false_alarms", "incredible", "tumbled", "varied", "violations"]
)
def test_help_of_study_starts_no_computation(study, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [study, "--help"])
    monkeypatch.setattr(tempfile, "TemporaryDirectory", None)  # every computation needs a folder
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "docs" / f"{study}.py"), run_name="__main__")
    assert ended.value.code == 0
    assert f"usage: {study}" in capsys.readouterr().out


def test_standards_page_names_existing_commands():
    page = (ROOT / "docs" / "standards.md").read_text(encoding="utf-8")
    tables = page.partition("## Other standards")[0]
    rows = [line.split(" | ") for line in tables.splitlines() if line.count(" | ") == 3]
    assert len(rows) > 30
    named = {name for row in rows[1:] for name in re.findall(r"`(\w+)`", row[2])}
    assert named <= set(cli.app)
    assert {"applied", "calibrate", "plan"} <= named
