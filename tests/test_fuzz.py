"""No file makes counterspin fail without a message: previous findings and a few new cases."""

import json
import os
import re
import subprocess
import sys
from random import Random
from resource import RUSAGE_CHILDREN, RUSAGE_SELF

import fuzz.hunt
import pytest
from fuzz import ROOT
from fuzz.application_client import SECRET
from fuzz.formats import FORMATS, Format, make_formats, run_command
from fuzz.hunt import MAX_BYTES, MAX_SECONDS, draw_content, hunt, judge
from fuzz.kills import COMMANDS, Command, Trial, kill_all
from fuzz.requests import make_request, valid_requests
from fuzz.tracing import Runner, can_trace
from prose import find_numbers, parse_number, read_text

from counterspin.application.endpoints import ENDPOINTS
from counterspin.errors import CounterspinError

CASES = sorted((ROOT / "tests" / "cases").glob("*/*.case"))

#: Numbers of cases of documents and records in the short run.
N_DOCUMENTS, N_RECORDS = 200, 4
#: Formats with slow cases.
SLOW_FORMATS = ("calibration", "sizes", "study-progress", "requests", "connections")
#: Numbers of cases of requests to the application, and of connections to its server.
N_APPLICATION_CASES = {"requests": 30, "connections": 12}


@pytest.fixture(autouse=True)
def reset_peak_memory(monkeypatch):
    """Measure memory relative to the start, because earlier tests may have used much."""
    peaks = [fuzz.hunt._peak_memory(who) for who in (RUSAGE_SELF, RUSAGE_CHILDREN)]
    monkeypatch.setattr("fuzz.hunt._INITIAL_PEAK", max(peaks))


@pytest.fixture(scope="module")
def load_format(tmp_path_factory):
    """Return a function: name -> format and path of its case file."""
    folder, formats = tmp_path_factory.mktemp("formats"), {}

    def get(name):
        if name not in formats:
            formats.update(make_formats(folder, [name]))
        return formats[name], folder / name / f"case{formats[name].suffix}"

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COUNTERSPIN_DEBUG", "1")
        yield get


@pytest.mark.parametrize("case", CASES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_previous_findings_raise_clear_errors(load_format, case):
    format_, path = load_format(case.parent.name)
    path.write_bytes(case.read_bytes())
    verdict, description = judge(format_, path)
    assert verdict != "found", description


@pytest.mark.slow
def test_new_cases_of_each_format_have_no_findings(load_format):
    shares = {name: row.share for name, row in FORMATS.items() if name not in SLOW_FORMATS}
    for native, count in ((False, N_DOCUMENTS), (True, N_RECORDS)):
        names = [name for name in shares if FORMATS[name].native == native]
        rng = Random(4)
        verdicts = set()
        for number in range(count):
            (name,) = rng.choices(names, [shares[name] for name in names])
            format_, path = load_format(name)
            path.write_bytes(draw_content(name, format_, 2, number))
            verdict, description = judge(format_, path)
            assert verdict != "found", f"{name}, seed 2, number {number}\n{description}"
            verdicts.add(verdict)
        assert "refused" in verdicts


@pytest.mark.slow
def test_huge_sizes_in_description_do_not_exhaust_memory(load_format):
    format_, path = load_format("sizes")
    verdicts = []
    for number in range(10):
        path.write_bytes(draw_content("sizes", format_, 2, number))
        verdict, description = judge(format_, path)
        assert verdict != "found", f"seed 2, number {number}\n{description}"
        verdicts.append(verdict)
    assert verdicts.count("refused") > 2


@pytest.mark.slow
@pytest.mark.parametrize("name", N_APPLICATION_CASES)
def test_application_answers_random_requests(load_format, name):
    format_, path = load_format(name)
    verdicts = set()
    for number in range(N_APPLICATION_CASES[name]):
        path.write_bytes(draw_content(name, format_, 2, number))
        verdict, description = judge(format_, path)
        assert verdict != "found", f"seed 2, number {number}\n{description}"
        verdicts.add(verdict)
    assert verdicts == {"accepted", "refused"}


def fail(path):
    return 1 / len(path.read_bytes())


def loop_forever(_path):
    while True:
        pass


def write_to_stderr(_path):
    """Imitate native code, which does not use `sys.stderr`."""
    os.write(2, b"thread panicked\n")


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (fail, "ZeroDivisionError"),
        (loop_forever, "TookTooLongError"),
        (write_to_stderr, "standard error"),
        (lambda path: None, ""),
    ],
)
def test_judge_detects_failures(tmp_path, monkeypatch, read, message):
    monkeypatch.setattr("fuzz.hunt.MAX_SECONDS", 0.1)
    path = tmp_path / "case.x"
    path.write_bytes(b"")
    verdict, description = judge(Format(".x", lambda rng: b"", read), path)
    assert verdict == ("found" if message else "accepted")
    assert message in description


def read_outside_file(app_state):
    """Imitate a request that reads outside the folder."""
    return (app_state.folder.root.parent / "outside" / "secret.toml").read_text()


def leave_partial_file(app_state):
    """Imitate a request that fails while writing a file."""
    (app_state.folder.root / ".half").write_text("x")
    raise CounterspinError("no space")


@pytest.mark.parametrize(
    ("respond", "message"),
    [
        (read_outside_file, "outside was touched"),
        (leave_partial_file, "has changed ['.half']"),
        (lambda app_state: 1 / 0, "ZeroDivisionError"),
        (lambda app_state: {"text": SECRET}, "content from outside the folder was returned"),
        (lambda app_state: app_state.file("nowhere"), ""),
    ],
)
def test_wrong_response_is_detected(load_format, monkeypatch, respond, message):
    format_, path = load_format("requests")
    monkeypatch.setitem(ENDPOINTS, ("GET", "folder"), respond)
    path.write_text(json.dumps([make_request("GET", "/api/folder", {})]))
    verdict, description = judge(format_, path)
    assert verdict == ("found" if message else "refused")
    assert message in description


def test_every_endpoint_is_fuzzed(load_format):
    _, path = load_format("requests")
    valid = valid_requests(path.parent / "template").values()
    assert ENDPOINTS.keys() <= {(method, url.removeprefix("/api/")) for method, url, _ in valid}


def test_command_failing_without_message_is_detected(monkeypatch):
    monkeypatch.delenv("COUNTERSPIN_DEBUG", raising=False)
    monkeypatch.setattr("counterspin.input.open_file", None)
    with pytest.raises(AssertionError):
        run_command("report", ROOT / "tests/frozen/schema-1-joint.json", "--date", "2026-01-01")


@pytest.mark.slow
def test_hunt_counts_cases(tmp_path, load_format):
    statistics = hunt(["lab"], seed=5, first=1, count=30, output=tmp_path)
    format_, path = load_format("lab")
    n_refused = 0
    for number in range(1, 31):
        path.write_bytes(draw_content("lab", format_, 5, number))
        n_refused += judge(format_, path)[0] == "refused"
    assert statistics.counts == {"lab refused": n_refused, "lab accepted": 30 - n_refused}
    assert not statistics.finds
    assert "lab" in statistics.table()


#: Imitates a worker whose second case kills it.
KILLED_WORKER = """
import json, os, sys
first, count, folder = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
if first == 1:
    open(folder + "/at", "wb").write((2).to_bytes(8, "little"))
    os.abort()
open(folder + "/lines", "w").write(json.dumps({"counts": {"lab refused": count}, "next": 4}))
"""


def test_hunt_stores_killing_case_and_continues(tmp_path, monkeypatch):
    start = subprocess.Popen
    monkeypatch.setattr(
        "fuzz.hunt.subprocess.Popen",
        lambda arguments, **options: start(
            [sys.executable, "-c", KILLED_WORKER, *arguments[-3:]], **options
        ),
    )
    statistics = hunt(["lab"], seed=5, first=1, count=3, output=tmp_path)
    (signature,) = statistics.finds
    assert signature.startswith("lab: the process ended with status -6")
    format_ = make_formats(tmp_path / "bench", ["lab"])["lab"]
    assert (tmp_path / "lab-5-2.toml").read_bytes() == draw_content("lab", format_, 5, 2)
    assert statistics.counts["lab found"] == 1


needs_tracing = pytest.mark.skipif(not can_trace(), reason="processes cannot be traced here")


@needs_tracing
def test_killed_command_leaves_no_partial_file():
    messages = []
    n_done, faults = kill_all(2, ["plan-begin"], messages.append)
    assert faults == []
    assert n_done == 2
    assert [message.split()[0] for message in messages] == ["plan-begin:", "plan-begin"]


#: Writes its output in place, and changes its input.
UNSAFE_PROGRAM = """
open("result.json", "a").write("x")
with open("new.json", "w") as file:
    file.write("half ")
    file.flush()
    file.write("and half")
"""


@needs_tracing
def test_lost_file_is_detected(tmp_path, monkeypatch):
    (tmp_path / "unsafe.py").write_text(UNSAFE_PROGRAM)
    monkeypatch.syspath_prepend(tmp_path)
    inputs = tmp_path / "inputs"
    inputs.mkdir()
    (inputs / "result.json").write_text("")
    with Runner("unsafe") as runner:
        trial = Trial(runner, "unsafe", Command((), ("result.json",)), inputs, tmp_path)
        assert trial.n_calls == 5
        assert not trial.find_faults(1)
        assert any("result.json is lost or changed" in fault for fault in trial.find_faults(4))
        assert any("new.json is not whole" in fault for fault in trial.find_faults(5))


def test_page_states_fuzzing_limits():
    (seconds,) = find_numbers("harmful-files", "more than {} s of CPU time or")
    (gigabytes,) = find_numbers("harmful-files", "of CPU time or {} GB of memory")
    n_cases, n_requests = find_numbers(
        "harmful-files",
        "reads all of these and {} new cases, and sends {} cases to the application",
    )
    (commands,) = find_numbers("harmful-files", "killed {} commands at each")
    assert [
        parse_number(number) for number in (seconds, gigabytes, n_cases, n_requests, commands)
    ] == [
        MAX_SECONDS,
        MAX_BYTES / 1e9,
        N_DOCUMENTS + N_RECORDS,
        sum(N_APPLICATION_CASES.values()),
        len(COMMANDS),
    ]


#: Rows of the table with cases of the application.
_APPLICATION_ROWS = ("requests to the application", "connections to its server")


def test_page_states_number_of_cases():
    page = read_text("harmful-files")
    totals = dict.fromkeys(("DOCUMENTS", "RECORDS", "KILLS", "requests"), 0)
    command = (
        r"make fuzz (?:ONLY=(\S+) )?(SEED=\d+ DOCUMENTS=\d+ RECORDS=\d+ KILLS=\d+)"
        r"(?: # and so on to seed (\d+))?"
    )
    for only, settings, last_seed in re.findall(command, page):
        values = {key: int(number) for key, number in re.findall(r"(\w+)=(\d+)", settings)}
        n_seeds = int(last_seed or values["SEED"]) - values["SEED"] + 1
        for key in ("DOCUMENTS", "RECORDS", "KILLS"):
            total = "requests" if key == "DOCUMENTS" and only.startswith("requests") else key
            totals[total] += n_seeds * values[key]
    documents, refused = find_numbers("harmful-files", "| documents and CSV | {} | {} |")
    (records,) = find_numbers("harmful-files", "Excel and PDF | {} |")
    (kills,) = find_numbers("harmful-files", "| commands killed | {} |")
    # A stopped hunt has run fewer cases.
    assert 0.999 * totals["DOCUMENTS"] < parse_number(documents) <= totals["DOCUMENTS"]
    assert parse_number(refused) < parse_number(documents)
    assert [parse_number(records), parse_number(kills)] == [totals["RECORDS"], totals["KILLS"]]
    application_cases = [
        find_numbers("harmful-files", f"| {row} | {{}} | {{}} |") for row in _APPLICATION_ROWS
    ]
    assert sum(parse_number(n_cases) for n_cases, _ in application_cases) == totals["requests"]
    assert all(
        parse_number(refused) < parse_number(n_cases) for n_cases, refused in application_cases
    )
    # A case has 1 to 3 requests, 1.6 on average.
    (sent,) = find_numbers("harmful-files", "The `requests` cases sent {} requests")
    assert parse_number(sent) == pytest.approx(
        1.6 * parse_number(application_cases[0][0]), rel=0.01
    )
