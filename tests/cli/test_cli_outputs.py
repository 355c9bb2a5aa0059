"""No command loses a file: its inputs, other files or its own result."""

import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from campaigns import SMALL, replace_parts, write_description
from raising import raises
from results import make_qx_result

from certificates import write_lab
from counterspin import cli
from counterspin.calibration.calibrate import calibrate
from counterspin.simulation.simulate import simulate
from counterspin.validation.validate import validate, write_dossier

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples" / "three-rate"

#: Files of a laboratory, which no other type of output may overwrite.
KEPT = {
    "campaign.toml": "a campaign",
    "slow.csv": "a record",
    "LAB.toml": "the laboratory's file",
    "r.json": "a result",
    "history.json": "another command's result",
    "report.md": "a report",
    "issued.xml": "a certificate",
    "issued.pdf": "a certificate on paper",
    "notes.txt": "notes",
}

#: Command with an output -> the files of its own type that it may overwrite.
WRITERS = {
    ("calibrate", "camp", "--json"): {"r.json"},
    ("history", "r.json", "--json"): {"history.json"},
    ("check", "camp/slow.csv", "--campaign", "camp", "--json"): set(),
    ("compare", "r.json", "r.json", "--json"): set(),
    ("compare", "r.json", "r.json", "--report"): set(),
    ("rerun", "camp/result.json", "--json"): set(),
    ("reproduce", "--json"): set(),
    ("plan", "PLAN.toml", "--json"): set(),
    ("study", "camp", "--trials", "2", "--json"): set(),
    ("report", "r.json", "-o"): {"report.md"},
    ("apply", "r.json", "camp/slow.csv", "--accelerometer", "Qx", "-o"): set(),
}


@pytest.fixture(scope="module")
def output_folder(tmp_path_factory):
    """Return a folder with one file of each type."""
    folder = tmp_path_factory.mktemp("desk")
    simulate(write_description(folder, SMALL, "plan.toml"), folder / "camp")
    for name in ("campaign.toml", "slow.csv"):
        shutil.copy(folder / "camp" / name, folder)
    dated = make_qx_result().model_copy(update={"details": {"date": "2026-01-14"}})
    dated.write(folder / "r.json")
    calibrate(folder / "camp").write(folder / "camp" / "result.json")
    write_lab(folder)
    shutil.copy(EXAMPLES / "certificate.xml", folder / "issued.xml")
    shutil.copy(EXAMPLES / "certificate.pdf", folder / "issued.pdf")
    (folder / "notes.txt").write_text("mine")
    assert cli.main(["history", f"{folder}/r.json", "--json", f"{folder}/history.json"]) == 0
    assert cli.main(["report", f"{folder}/r.json", "-o", f"{folder}/report.md"]) == 0
    assert cli.main(["plan", "--init", f"{folder}/PLAN.toml"]) == 0
    plan = folder / "PLAN.toml"
    short = ("runs = 14", "runs = 2"), ('total_time = "700 s"', 'total_time = "100 s"')
    plan.write_text(replace_parts(plan.read_text("utf-8"), *short), "utf-8")
    return folder


@pytest.fixture
def work_folder(output_folder, tmp_path, monkeypatch):
    shutil.copytree(output_folder, tmp_path / "desk")
    monkeypatch.chdir(tmp_path / "desk")
    return tmp_path / "desk"


def read_contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("words", WRITERS, ids=lambda words: words[0] + words[-1])
def test_output_does_not_overwrite_other_file_types(words, work_folder, capsys):
    before = read_contents(work_folder)
    for name in KEPT.keys() - WRITERS[words]:
        for more in ([], ["--overwrite"]):
            assert cli.main([*words, name, *more]) in (1, 2), name
            captured = capsys.readouterr()
            assert name in captured.err
            assert "internal" not in captured.err
            assert captured.out == ""  # rejected before any calculation
    assert read_contents(work_folder) == before


@pytest.mark.parametrize("name", KEPT)
def test_certificate_does_not_overwrite_files(name, work_folder, capsys):
    before = read_contents(work_folder)
    assert cli.main(["certificate", "r.json", "LAB.toml", "-o", name]) in (1, 2)
    assert name in capsys.readouterr().err
    for text in ("certificate", "plan"):
        assert cli.main([text, "--init", name]) == 1
        assert f"{name} already exists" in capsys.readouterr().err
    assert read_contents(work_folder) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["calibrate", "camp", "--json", "new.json"],
        ["calibrate", "camp", "camp", "--json", "new.json"],
        ["history", "r.json", "--json", "new.json", "--figure", "new.svg"],
        ["report", "r.json", "-o", "new.html"],
        ["report", "r.json", "-o", "new.pdf"],
        ["apply", "r.json", "indicated.csv", "--accelerometer", "Qx", "-o", "new.csv"],
        ["apply", "r.json", "indicated.csv", "--accelerometer", "Qx", "-o", "new.parquet"],
        ["simulate", "plan.toml", "-o", "new"],
    ],
    ids=lambda words: f"{words[0]} {words[-1]}",
)
def test_overwrite_option_replaces_earlier_output(words, work_folder, capsys):
    (work_folder / "indicated.csv").write_text("Qx\n0.5\n1.0\n")
    assert cli.main(words) == 0
    before = read_contents(work_folder)
    capsys.readouterr()
    assert cli.main(words) == 1
    captured = capsys.readouterr()
    assert "exists; " in captured.err
    assert "--overwrite" in captured.err
    assert read_contents(work_folder) == before
    assert cli.main([*words, "--overwrite"]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("figure", ["svg", "png", "pdf"])
def test_overwrite_replaces_demonstration_and_figure(figure, work_folder, capsys):
    words = ["demo", "-o", "shown", "--figure", figure]
    assert cli.main(words) == 0
    assert cli.main(words) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert cli.main([*words, "--overwrite"]) == 0
    drawn = work_folder / "shown" / f"displacement.{figure}"
    drawn.write_bytes(b"not counterspin's")
    assert cli.main([*words, "--overwrite"]) == 1
    assert "figure of the demonstration" in capsys.readouterr().err


def test_apply_does_not_overwrite_input(work_folder, capsys):
    (work_folder / "indicated.csv").write_text("Qx\n0.5\n1.0\n")
    words = ["apply", "r.json", "indicated.csv", "--accelerometer", "Qx", "-o", "new.csv"]
    assert cli.main(words) == 0
    before = read_contents(work_folder)
    (work_folder / "link.csv").symlink_to("new.csv")
    for output in ("new.csv", "link.csv"):
        again = ["apply", "r.json", "new.csv", "--accelerometer", "Qx", "-o", output, "--overwrite"]
        assert cli.main([*again, "--input", "Qx"]) == 2
        assert "is the input" in capsys.readouterr().err
    (work_folder / "link.csv").unlink()
    assert read_contents(work_folder) == before


def test_missing_output_folder_raises_before_calibration(work_folder, capsys):
    assert cli.main(["calibrate", "camp", "--json", "none/r.json"]) == 1
    captured = capsys.readouterr()
    assert "none/r.json cannot be written: " in captured.err
    assert captured.out == ""


def test_result_is_printed_if_file_cannot_be_written(work_folder, capsys):
    (work_folder / "full.json").symlink_to("/dev/full")
    assert cli.main(["calibrate", "camp", "--json", "full.json"]) == 1
    captured = capsys.readouterr()
    assert "full.json cannot be written" in captured.err
    assert "K_II" in captured.out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["plan", "PLAN.toml", "-o", "new"], "new/campaign.toml"),
        (["compare", "r.json", "r.json", "--report", "new.md"], "new.md"),
        (["history", "r.json", "--figure", "new.svg"], "new.svg"),
    ],
    ids=lambda part: part[0] if isinstance(part, list) else part,
)
def test_files_are_written_before_output_is_printed(words, name, work_folder, monkeypatch):
    class FullDevice:
        def __getattr__(self, name):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(sys, "stdout", FullDevice())
    with suppress(Exception):
        cli.main(words)
    assert (work_folder / name).exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["noise", "slow.csv", "--json", "x.html", "--report", "./x.html"],
            "--report: x.html is also the file of --json",
        ),
        (
            ["noise", "slow.csv", "--report", "x.pdf", "--plot", "x.pdf"],
            "--plot: x.pdf is also the file of --report",
        ),
        (
            ["compare", "r.json", "r.json", "--report", "x.md", "--json", "x.md"],
            "--report: x.md is also the file of --json",
        ),
        (
            ["history", "r.json", "--figure", "x.svg", "--json", "x.svg"],
            "--figure: x.svg is also the file of --json",
        ),
        (
            ["applied", ".", "--figure", "x.pdf", "--certificate", "x.pdf", "--lab", "LAB.toml"],
            "--certificate: x.pdf is also the file of --figure",
        ),
    ],
)
def test_outputs_must_be_different_files(words, message, work_folder, capsys):
    assert cli.main(words) == 2
    assert capsys.readouterr().err == f"counterspin: {message}\n"
    assert not list(work_folder.glob("x.*"))


@pytest.mark.parametrize(
    "words",
    [
        ["compare", "r.json", "history.json"],
        ["rerun", "history.json"],
        ["export", "history.json", "-o", "x.csv"],
        ["certificate", "history.json", "LAB.toml", "-o", "x.xml"],
    ],
)
def test_other_kind_of_result_is_named(words, work_folder, capsys):
    assert cli.main(words) == 1
    message = "history.json: the file of a history, not of a result; give the JSON file of a result"
    assert capsys.readouterr().err == f"counterspin: {message}\n"


def test_ledger_is_unchanged_if_a_result_cannot_be_read(work_folder, capsys):
    words = ["ledger", "add", "l.jsonl", "r.json", "none.json", "--who", "A. Erste", "--why"]
    assert cli.main([*words, "yearly"]) == 1
    assert "none.json: file not found" in capsys.readouterr().err
    assert cli.main([*words, " "]) == 2
    assert not (work_folder / "l.jsonl").exists()


@pytest.mark.slow
@pytest.mark.parametrize("way", ["full", "broken"])
def test_result_is_written_if_output_fails(way, work_folder):
    """Standard output is a full device or a closed pipe."""
    command = f"{sys.executable} -m counterspin calibrate camp --json new.json"
    command += " > /dev/full" if way == "full" else " | true"
    run = subprocess.run(
        ["bash", "-c", f"{command}; exit ${{PIPESTATUS[0]}}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert cli.main(["report", "new.json", "-o", "new.md"]) == 0
    if way == "full":
        assert run.returncode == 1
        assert run.stderr == "counterspin: the output cannot be written: no space left on device\n"
    else:
        assert (run.returncode, run.stderr) == (0, "")


@pytest.mark.parametrize(
    "words",
    [
        ["report", "r.json", "-o", "c.html"],
        ["report", "r.json", "-o", "c.pdf"],
        ["compare", "r.json", "r.json", "--report", "c.md"],
        ["compare", "r.json", "r.json", "--json", "c.json"],
        ["history", "r.json", "--figure", "c.svg"],
        ["apply", "r.json", "indicated.csv", "--accelerometer", "Qx", "-o", "c.csv"],
        ["certificate", "r.json", "LAB.toml", "-o", "c.xml"],
        ["certificate", "--init", "c.toml"],
        ["plan", "--init", "c.toml"],
    ],
)
def test_circular_link_as_output_raises(words, work_folder, capsys):
    (work_folder / "indicated.csv").write_text("Qx\n0.5\n1.0\n")
    write_lab(work_folder)
    (work_folder / words[-1]).symlink_to(words[-1])
    assert cli.main(words) == 1
    error = capsys.readouterr().err
    assert f"{words[-1]} cannot be written" in error
    assert "circular link" in error


#: Commands that write a page or a figure.
PAGES = {
    "report": ["report", "r.json", "-o"],
    "comparison": ["compare", "r.json", "r.json", "--report"],
    "chart": ["history", "r.json", "--figure"],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second", "name"),
    [
        ("report", "comparison", "page.html"),
        ("comparison", "report", "page.md"),
        ("report", "comparison", "page.pdf"),
        ("comparison", "report", "page.pdf"),
        ("report", "chart", "page.pdf"),
        ("chart", "report", "page.pdf"),
    ],
)
def test_page_does_not_overwrite_other_page_type(first, second, name, work_folder, capsys):
    assert cli.main([*PAGES[first], name]) == 0
    before = read_contents(work_folder)
    assert cli.main([*PAGES[second], name, "--overwrite"]) == 1
    assert "not overwritten" in capsys.readouterr().err
    assert read_contents(work_folder) == before
    assert cli.main([*PAGES[first], name, "--overwrite"]) == 0


@pytest.mark.parametrize("name", ["validation.html", "validation.pdf"])
def test_report_does_not_overwrite_dossier(name, work_folder, capsys):
    write_dossier(validate(chosen=()), "dossier")
    before = read_contents(work_folder / "dossier")
    assert cli.main(["report", "r.json", "-o", f"dossier/{name}", "--overwrite"]) == 1
    assert "not a calibration report" in capsys.readouterr().err
    assert read_contents(work_folder / "dossier") == before
    write_dossier(validate(chosen=()), "dossier", overwrite=True)
    assert cli.main(["report", "r.json", "-o", name]) == 0
    (work_folder / name).replace(work_folder / "dossier" / name)
    with raises("file-exists", "validation dossier"):
        write_dossier(validate(chosen=()), "dossier", overwrite=True)
