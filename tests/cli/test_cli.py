"""The command line: arguments, error messages and exit status."""

import errno
import inspect
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pypdf
import pytest
from campaigns import SMALL

from counterspin import cli
from counterspin.calibration.result import Result
from counterspin.certificates import issuing
from counterspin.cli.program import validate
from counterspin.reports import charts, publication
from counterspin.reproduction.demo import demo
from counterspin.validation.validate import DOSSIER_FILES

#: The installed command, in the folder of the interpreter.
BESIDE = str(Path(sys.executable).parent)
COMMANDS = [name for name in cli.app if not name.startswith("-")]


@pytest.mark.parametrize("words", [[], ["--help"]])
def test_help_describes_each_command(words, capsys):
    assert cli.main(words) == 0
    rows = re.findall(r"^│ ([a-z]+) +(\S.*\S) +│$", capsys.readouterr().out, re.MULTILINE)
    descriptions = dict(rows)
    assert set(COMMANDS) <= descriptions.keys()
    assert all(len(descriptions[command].split()) > 2 for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_command(command, capsys):
    assert cli.main([command, "--help"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"Usage: counterspin {command}")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_wraps_lines_at_terminal_width(command, monkeypatch, capsys):
    """The first of two lines has no room for the next word."""
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main([command, "--help"]) == 0
    lines = [line.strip("│").rstrip() for line in capsys.readouterr().out.splitlines()]
    for line, after in pairwise(lines):
        begin = len(line) - len(line.lstrip())
        if begin > 8 and after.startswith(" " * begin) and after[begin] not in " [":
            assert len(line) + 1 + len(after.split()[0]) > 77, line


@pytest.mark.parametrize("command", COMMANDS)
def test_help_omits_negative_options_and_empty_defaults(command, monkeypatch, capsys):
    """Examples are `--no-yes`, `--empty-from` and `[default: ()]`."""
    monkeypatch.setenv("COLUMNS", "400")
    assert cli.main([command, "--help"]) == 0
    shown = capsys.readouterr().out
    assert not re.search(r"--empty-|\[default: (?:\(\)|\[\]|False|None|True|)\]", shown)
    off = set(re.findall(r"--no-([\w-]+)", shown))
    defaults = {
        argument.names[0].removeprefix("--"): argument.field_info.default
        for argument in cli.app[command].assemble_argument_collection()
    }
    assert [name for name in off if defaults[name] is False] == []
    on = {name for name, default in defaults.items() if default is True}
    assert on <= off
    assert shown.count("[default: on]") == len(on)


@pytest.mark.parametrize(
    ("command", "option", "endings"),
    [
        ("certificate", "output", issuing.FILE_SUFFIXES),
        ("report", "output", publication.REPORT_SUFFIXES),
        ("compare", "report", publication.REPORT_SUFFIXES),
        ("history", "figure", charts._METADATA),
    ],
)
def test_help_lists_file_endings(command, option, endings):
    text = inspect.getdoc(cli.app[command].default_command)
    endings_text = re.search(rf"^{option}\n((?:    .*\n?)+)", text, re.MULTILINE)[1]
    assert sorted(re.findall(r"\.[a-z]+\b", endings_text)) == sorted(endings)


def test_help_lists_files_of_dossier():
    for name in DOSSIER_FILES:
        assert name in inspect.getdoc(validate)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["calibrat"], 'Unknown command "calibrat". Did you mean "calibrate"?'),
        (["calibrate"], "calibrate: DIRECTORY is missing"),
        (["init"], "init: DIRECTORY is missing"),
        (["simulate"], "simulate: CAMPAIGN is missing"),
        (["study"], "study: CAMPAIGN is missing"),
        (["simulate", "x"], "simulate: --output is missing"),
        (["apply", "r.json"], "apply: FILE is missing"),
        (["calibrate", "x", "--json"], "calibrate: --json requires a value\n"),
        (["applied", "x", "--levels", "-1g"], "--levels requires a value; write --levels=-1g"),
        (["calibrate", "x", "--json", "a", "--json", "b"], "--json may be given only once"),
        (["simulate", "x", "-o", "y", "z"], "simulate: unexpected argument: z\n"),
        (["simulate", "x", "-o", "y", "a b", "z"], "simulate: unexpected arguments: 'a b' z\n"),
        (["study", "x", "--trials", "10.6"], '--trials: "10.6" is not a whole number'),
        (["study", "x", "--trials", "1.e999"], '--trials: "1.e999" is not a whole number'),
        (["watch", "x", "--interval", "often"], '--interval: "often" is not a number'),
        (["calibrate", "x", "--budget=maybe"], '--budget: "maybe" is not true or false'),
        (["calibrate", "x", "--method", "magic"], 'Invalid value "magic" for --method'),
        (["demo", "--figure", "gif"], 'Choose from: "svg", "png", "pdf"'),
        (["demo", "here"], "here"),
    ],
)
def test_usage_error_has_two_lines(words, message, capsys):
    assert cli.main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert message in captured.err
    assert captured.err.startswith("counterspin: ")
    own = "" if words == ["calibrat"] else f"{words[0]} "
    assert captured.err.endswith(f"\nTry counterspin {own}--help.\n")
    assert captured.err.count("\n") == 2


def test_unknown_option_without_command_is_named(capsys):
    assert cli.main(["--magic"]) == 2
    assert capsys.readouterr().err == (
        "counterspin: unknown option: --magic\nTry counterspin --help.\n"
    )


def test_completion_is_installed_for_shell(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cli.main(["--install-completion", "--shell", "bash"]) == 0
    (script,) = tmp_path.glob(".local/**/counterspin")
    assert capsys.readouterr().out.startswith(f"Wrote {script}. To use the completion, ")
    assert "calibrate" in script.read_text(encoding="utf-8")
    assert str(script) in (tmp_path / ".bashrc").read_text(encoding="utf-8")


def test_port_outside_range_is_rejected(tmp_path, capsys):
    for port in ("-1", "70000"):
        assert cli.main(["serve", str(tmp_path), "--port", port]) == 2
        message = f"counterspin: serve: --port: must be from 0 to 65535, not {port}\n"
        assert capsys.readouterr().err == message


def test_whole_numbers_may_have_exponents(capsys):
    assert cli.main(["study", "nowhere", "--trials", "1e3", "--seed", "30.0"]) == 2
    assert capsys.readouterr().err.startswith("counterspin: nowhere: file not found")


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["calibrate", ""], "the arguments of the command"),
        (["simulate", "x", "-o", ""], "-o"),
        (["calibrate", "x", "--json="], "--json"),
        (["compare", "a.json", ""], "the arguments of the command"),
        (["init", "x", "--from", ""], "--from"),
    ],
)
def test_empty_file_name_is_rejected(words, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == 2
    message = f"counterspin: {name}: the name of a file or folder is empty\n"
    assert capsys.readouterr().err == message
    assert not list(tmp_path.iterdir())


def test_option_without_file_name_may_be_empty(capsys):
    assert cli.main(["study", "nowhere", "--cluster", ""]) == 2
    assert capsys.readouterr().err.startswith("counterspin: nowhere: file not found")


def test_missing_campaign_exits_with_2(tmp_path, capsys):
    assert cli.main(["calibrate", str(tmp_path / "nowhere")]) == 2
    assert "file not found; `counterspin init DIR` creates" in capsys.readouterr().err


def test_failed_command_exits_with_1(tmp_path, capsys):
    assert cli.main(["init", str(tmp_path)]) == 0
    assert cli.main(["init", str(tmp_path)]) == 1
    assert "exists; edit it" in capsys.readouterr().err
    assert cli.main(["calibrate", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert all(f"run{i}.csv: file not found\n" in error for i in (1, 2, 3))


def test_suggested_command_can_be_run(tmp_path, capsys):
    folder = tmp_path / "with blanks"
    assert cli.main(["init", str(folder)]) == 0
    advice = capsys.readouterr().out.splitlines()[1:]
    for line in advice:
        assert cli.main([*shlex.split(line)[1:]]) == 0


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "no space left"),
        (MemoryError(), "not enough memory"),
        (OSError(errno.EIO, "worn out"), "the operating system reports: worn out"),
        (
            ImportError("libworn.so: cannot map"),
            "cannot be loaded (libworn.so: cannot map); reinstall",
        ),
        (ValueError("worn out"), "internal error (ValueError: worn out)"),
    ],
)
def test_expected_error_exits_with_1_and_message(error, words, monkeypatch, capsys):
    def raise_error():
        raise error

    monkeypatch.setattr("counterspin.reproduction.comparison.reproduce", raise_error)
    assert cli.main(["reproduce"]) == 1
    assert words in capsys.readouterr().err


def test_ctrl_c_exits_with_130(monkeypatch, capsys):
    def raise_interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("counterspin.ingest.starter.init", raise_interrupt)
    assert cli.main(["init", "x"]) == 130
    assert capsys.readouterr().err == "counterspin: stopped\n"


@pytest.mark.slow
def test_interrupted_study_prints_one_message_and_can_resume(hostile_campaign, monkeypatch, capsys):
    from counterspin.studies import study

    whole = study.study(hostile_campaign, trials=20)
    part = whole.model_copy(update={"complete": False})
    monkeypatch.setattr(study, "study", lambda *_, **__: part)
    assert cli.main(["study", str(hostile_campaign)]) == 130
    assert capsys.readouterr().err == "counterspin: stopped\n"
    assert cli.main(["study", str(hostile_campaign), "-o", str(hostile_campaign)]) == 130
    text = "counterspin: stopped; to continue, repeat the command with --resume\n"
    assert capsys.readouterr().err == text


@pytest.mark.parametrize(
    "command", [[sys.executable, "-m", "counterspin"], [shutil.which("counterspin", path=BESIDE)]]
)
def test_process_has_exit_status(command):
    def exit_status(*words):
        return subprocess.run([*command, *words], capture_output=True, check=False).returncode

    assert exit_status("--version") == 0
    assert exit_status("init") == 2
    assert (
        exit_status("apply", "no-result.json", "x.csv", "--accelerometer", "Qx", "-o", "y.csv") == 1
    )


@pytest.mark.skipif(sys.platform == "win32", reason="no such limits there")
@pytest.mark.parametrize("most", [150_000_000, 500_000_000, 1_200_000_000])
def test_insufficient_memory_limit_is_reported(most, tmp_path):
    """A library that lacks memory would end the process or print a backtrace."""
    resource = pytest.importorskip("resource")
    done = subprocess.run(
        [f"{BESIDE}/counterspin", "demo", "-o", str(tmp_path / "demo")],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (most, most)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith(f"counterspin: this process may take {most / 1e9:.2g} GB of")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("count", ["0", "-1", "", "two", "1e3", "1025", "99999999999999"])
def test_rejects_invalid_polars_max_threads(count, monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("POLARS_MAX_THREADS", count)
    assert cli.main(["simulate", str(tmp_path)]) == 2
    words = f"{count!r} is not a whole number from 1 to 1024; correct or unset it"
    assert (
        capsys.readouterr().err
        == f"counterspin: environment variable POLARS_MAX_THREADS: {words}\n"
    )


def test_polars_max_threads_is_checked_before_reading(tmp_path):
    (tmp_path / "campaign.toml").write_text(SMALL, encoding="utf-8")
    done = subprocess.run(
        [f"{BESIDE}/counterspin", "calibrate", str(tmp_path)],
        env=os.environ | {"POLARS_MAX_THREADS": "0"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("counterspin: environment variable POLARS_MAX_THREADS: '0' ")
    assert done.stderr.count("\n") == 1


# Text from files


#: Colours, a bell, a C1 control, right-to-left text and a forged output line.
HOSTILE = "x\x1b[31m\x07\x9b1m\u202e\u2066\nK_II = 1"


def control_characters(text):
    """Return the control characters of an output."""
    return {character for character in text if not character.isprintable()} - {"\n"}


@pytest.fixture(scope="module")
def hostile_campaign(tmp_path_factory):
    """Return a campaign with control sequences in its names and texts, and its result."""
    folder = tmp_path_factory.mktemp("hostile")
    demo(folder)
    text = (folder / "campaign.toml").read_text("utf-8")
    words = json.dumps(HOSTILE).replace("\x7f", "")
    text = text.replace('"The paper\'s plan"', f'{words}\ndate = "2026-03-01"')
    for run in ("run1", "run2"):
        text = text.replace(f'name = "{run}"', f"name = {json.dumps(run + HOSTILE)}")
    text = text.replace("[accelerometers.Qx]", f"[accelerometers.Qx]\nserial_number = {words}")
    (folder / "campaign.toml").write_text(text, "utf-8")
    assert cli.main(["calibrate", str(folder), "--json", str(folder / "result.json")]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["calibrate", ".", "--budget", "--details"],
        ["calibrate", ".", "."],
        ["report", "result.json"],
        ["plan", "--check", ".", "--revolutions", "20"],
        ["study", ".", "--trials", "50"],
        ["history", "result.json"],
        ["simulate", ".", "-o", HOSTILE],
        ["calibrate", HOSTILE],
        ["report", "."],
        [HOSTILE],
    ],
)
def test_output_has_no_control_characters_from_files(words, hostile_campaign, monkeypatch, capsys):
    monkeypatch.chdir(hostile_campaign)
    cli.main(words)
    shown = capsys.readouterr()
    assert shown.out + shown.err
    assert control_characters(shown.out + shown.err) == set()
    lines = (shown.out + shown.err).splitlines()
    assert not [line for line in lines if line.startswith("K_II = 1")]


def test_errors_with_hostile_text_stay_on_one_line(hostile_campaign, tmp_path, capsys):
    text = (hostile_campaign / "campaign.toml").read_text("utf-8")
    wrong = text.replace('"2.5 m"', json.dumps(HOSTILE)).replace("east", HOSTILE[:4])
    (tmp_path / "campaign.toml").write_text(wrong.replace("\x1b", "\\u001b"), "utf-8")
    assert cli.main(["calibrate", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert control_characters(error) == set()
    assert "centrifuge.radius" in error
    assert all(line.startswith("  ") for line in error.splitlines()[1:])


@pytest.mark.parametrize("words", [["report", "-o"], ["compare", "{}", "--report"]])
def test_hostile_report_is_safe_in_markdown(words, hostile_campaign, tmp_path):
    out, result = tmp_path / "report.md", str(hostile_campaign / "result.json")
    command, *more = (word.format(result) for word in words)
    assert cli.main([command, result, *more, str(out)]) == 0
    assert control_characters(out.read_text("utf-8")) == set()
    assert "K_II = 1" not in {line.strip("> \\") for line in out.read_text("utf-8").splitlines()}


@pytest.mark.slow
def test_hostile_report_is_safe_in_html_and_pdf(hostile_campaign, tmp_path):
    for kind in ("html", "pdf"):
        out = tmp_path / f"report.{kind}"
        assert cli.main(["report", str(hostile_campaign / "result.json"), "-o", str(out)]) == 0
    text = (tmp_path / "report.html").read_text("utf-8")
    # The page contains only its own scripts, such as uPlot.
    # A percent sign stays with its number.
    assert control_characters(re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)) <= {
        "\xa0"
    }
    assert not re.search(r"(^|>)\s*K_II = 1", text, re.M)
    pages = pypdf.PdfReader(tmp_path / "report.pdf").pages
    lines = "\n".join(page.extract_text() for page in pages).splitlines()
    assert [line for line in lines if r"\u202e\u2066\nK" in line]
    assert not [line for line in lines if re.match(r"\s*K_?II = 1\b", line)]


def test_hostile_result_is_safe_in_notebook(hostile_campaign):
    result = Result.read(hostile_campaign / "result.json")
    names = {
        f"{name}{HOSTILE}": accelerometer for name, accelerometer in result.accelerometers.items()
    }
    result = result.model_copy(update={"accelerometers": names})
    html, covariance = result._repr_html_(), result.covariance
    shown = [str(result), html, result._repr_markdown_()]
    for text in (*shown, str(covariance)):
        assert control_characters(text) == set()
        assert not [line for line in text.splitlines() if line.strip("> ").startswith("K_II = 1")]


def test_error_without_stderr_does_not_raise(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    assert cli.main(["calibrate", "nowhere"]) == 2
