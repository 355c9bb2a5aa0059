"""Report files: format, atomic writing and date."""

from datetime import UTC, datetime, timedelta, timezone

import pytest
from prose import ROOT
from raising import raises
from results import make_qx_result

from counterspin.cli import main
from counterspin.reports.publication import REPORT_SUFFIXES, parse_issue_date, report, write_report

EXAMPLE = ROOT / "docs" / "examples" / "three-rate" / "result.json"

FIXED = datetime(2026, 3, 1, 12, tzinfo=UTC)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", REPORT_SUFFIXES)
def test_report_formats_are_reproducible(suffix, tmp_path):
    first, second = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    write_report(make_qx_result(), first, issued=FIXED)
    write_report(make_qx_result(), second, issued=FIXED)
    assert first.read_bytes() == second.read_bytes()
    assert len(first.read_bytes()) > 1000
    calibration = make_qx_result(warnings=["Qx: odd"])
    with raises("file-exists", "`overwrite"):
        write_report(calibration, second, issued=FIXED)
    assert first.read_bytes() == second.read_bytes()
    write_report(calibration, second, issued=FIXED, overwrite=True)
    assert first.read_bytes() != second.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == [first.name, second.name]


@pytest.mark.parametrize("kind", ["html", "md", "pdf"])
def test_returned_report_equals_written_file(kind, tmp_path):
    file = tmp_path / f"a.{kind}"
    write_report(make_qx_result(), file, identifier="LAB 7/26", issued=FIXED)
    report_result = report(make_qx_result(), kind, identifier="LAB 7/26", issued=FIXED)
    assert (
        report_result if isinstance(report_result, bytes) else report_result.encode()
    ) == file.read_bytes()
    with raises("wrong-usage", "kind:", "'txt'", "html", "md", "pdf"):
        report(make_qx_result(), "txt")


def test_report_does_not_overwrite_other_file(tmp_path):
    record = tmp_path / "record.md"
    record.write_text("mine", encoding="utf-8")
    with raises("file-exists", "calibration report"):
        write_report(make_qx_result(), record, issued=FIXED, overwrite=True)
    assert record.read_text(encoding="utf-8") == "mine"


def test_identifier_is_in_report(tmp_path):
    write_report(make_qx_result(), tmp_path / "a.md", identifier="LAB 7/26", issued=FIXED)
    text = (tmp_path / "a.md").read_text(encoding="utf-8")
    assert text.endswith("\n\nEnd of LAB 7/26, 2026-03-01 12:00 UTC.\n")
    write_report(make_qx_result(), tmp_path / "a.html", issued=FIXED)
    assert make_qx_result().identifier in (tmp_path / "a.html").read_text(encoding="utf-8")
    write_report(
        make_qx_result(), tmp_path / "a.html", identifier="LAB 7/26", issued=FIXED, overwrite=True
    )
    assert "LAB 7/26" in (tmp_path / "a.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("2026-03-01", datetime(2026, 3, 1, tzinfo=UTC)),
        ("2026-03-01T14:30:00", datetime(2026, 3, 1, 14, 30, tzinfo=UTC)),
        (
            "2026-03-01T14:30:00+01:00",
            datetime(2026, 3, 1, 14, 30, tzinfo=timezone(timedelta(hours=1))),
        ),
    ],
)
def test_iso_8601_dates(text, wanted):
    assert parse_issue_date(text) == wanted
    assert parse_issue_date(text).utcoffset() == wanted.utcoffset()


def test_source_date_epoch_sets_date(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert parse_issue_date() == datetime(1970, 1, 2, tzinfo=UTC)
    assert parse_issue_date("2026-03-01").year == 2026
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "soon")
    with raises("invalid-date", "SOURCE_DATE_EPOCH:", "'soon'"):
        parse_issue_date()


def test_current_date_has_whole_seconds(monkeypatch):
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    before = datetime.now(UTC).replace(microsecond=0)
    issue_date = parse_issue_date()
    assert issue_date.microsecond == 0
    assert before <= issue_date <= datetime.now(UTC)


# Command line


@pytest.fixture
def result_file(tmp_path):
    path = tmp_path / "result.json"
    make_qx_result().write(path)
    return path


def test_report_without_file_is_printed(result_file, capsys):
    assert main(["report", str(result_file)]) == 0
    output = capsys.readouterr().out
    assert "27.0000 ± 0.0010 µg/g²" in output
    assert "Quality checks" in output
    assert "counterspin calibrate ." in output


def test_campaign_is_calibrated_before_report(tmp_path, capsys):
    assert main(["demo", "-o", str(tmp_path / "demo")]) == 0
    assert main(["report", str(tmp_path / "demo"), "-o", str(tmp_path / "r.md")]) == 0
    assert "Quality checks" in (tmp_path / "r.md").read_text(encoding="utf-8")
    assert capsys.readouterr().out.endswith(f"Wrote {tmp_path / 'r.md'}.\n")


def test_result_file_may_have_any_name(result_file, capsys):
    other = result_file.rename(result_file.with_name("result of May"))
    assert main(["report", str(other)]) == 0
    assert "Quality checks" in capsys.readouterr().out
    other.write_text("hello", "utf-8")
    assert main(["report", str(other)]) == 1
    assert "not a result file" in capsys.readouterr().err


def test_campaign_file_is_calibrated_before_report(tmp_path, capsys):
    assert main(["report", str(tmp_path / "campaign.toml")]) == 2
    assert "file not found; `counterspin init DIR`" in capsys.readouterr().err
    (tmp_path / "campaign.toml").write_text("schema = 1", "utf-8")
    assert main(["report", str(tmp_path / "campaign.toml")]) == 2
    assert "site: is missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["-o", "{}/report.doc"], 2, "report.doc: the file name must end in .html, .pdf or .md"),
        (["-o", "{}/none/report.md"], 1, "report.md cannot be written"),
        (["--date", "yesterday"], 2, "--date: 'yesterday' is not a date"),
        (["--date", "9999-12-31T23:59:00-05:00"], 2, "is not a date"),
    ],
)
def test_rejects_invalid_arguments(arguments, status, words, result_file, tmp_path, capsys):
    typed = [argument.format(tmp_path) for argument in arguments]
    assert main(["report", str(result_file), *typed]) == status
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [result_file]


def test_damaged_or_newer_result_writes_no_report(result_file, tmp_path, capsys):
    target = tmp_path / "report.html"
    text = result_file.read_text(encoding="utf-8")
    for spoilt, words in (
        (text[: len(text) // 2], "not a result file, or damaged"),
        (text.replace('"schema": 2', '"schema": 99'), "written by a newer version of counterspin"),
    ):
        result_file.write_text(spoilt, encoding="utf-8")
        assert main(["report", str(result_file), "-o", str(target)]) == 1
        assert words in capsys.readouterr().err
        assert not target.exists()


@pytest.fixture(scope="module")
def demonstration(tmp_path_factory):
    """Return a folder with a small campaign, its result and outputs of commands."""
    folder = tmp_path_factory.mktemp("files")
    assert main(["demo", "-o", str(folder / "demo")]) == 0
    assert main(["calibrate", str(folder / "demo"), "--json", str(folder / "result.json")]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "title", "mark"),
    [
        (["history", str(EXAMPLE)], "History of K_II", "a history"),
        (["compare", "result.json", str(EXAMPLE)], "Comparison of results", "a comparison"),
        (["plan", "--check", "demo"], "", "a plan's result"),
        (["rerun", "result.json"], "Repeated calibration", "a repeat of a result"),
        (["check", "--campaign", "demo", "demo/run1.csv"], "run1: ", "a check"),
        (["reproduce"], "", "a reproduction"),
        (["study", "demo", "--trials", "3"], "", "a study's result"),
    ],
)
def test_results_of_all_commands_have_reports(
    command, title, mark, demonstration, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(demonstration)
    file = tmp_path / "found.json"
    assert main([*command, "--json", str(file)]) in (0, 1)
    capsys.readouterr()
    assert main(["report", str(file), "-o", str(tmp_path / "found.md")]) == 0
    written = (tmp_path / "found.md").read_text(encoding="utf-8")
    assert f"# {title}".replace("_", r"\_") in written
    assert f"<!-- Made by counterspin: {mark}. -->" in written
    assert main(["report", str(file), "-o", str(tmp_path / "found.md"), "--overwrite"]) == 0
    capsys.readouterr()
    assert main(["report", str(file)]) == 0
    assert title in capsys.readouterr().out
    # A file that is not a report of the same type is not overwritten.
    write_report(make_qx_result(), tmp_path / "other.md", issued=FIXED)
    assert main(["report", str(file), "-o", str(tmp_path / "other.md"), "--overwrite"]) == 1
    assert f"is not {mark} written by counterspin" in capsys.readouterr().err
