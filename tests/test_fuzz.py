"""No file makes counterspin fail without words: cases that once did, and a few new ones."""

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
from fuzz.asking import SECRET
from fuzz.formats import FORMATS, Format, command, formats
from fuzz.hunt import BYTES, SECONDS, content, hunt, judge
from fuzz.kills import COMMANDS, Command, Trial, kill_all
from fuzz.requests import request_of, valid_requests
from fuzz.tracing import Runner, possible
from prose import find_numbers, parse_number, read_text

from counterspin.application.endpoints import ENDPOINTS
from counterspin.errors import CounterspinError

CASES = sorted((ROOT / "tests" / "cases").glob("*/*.case"))

#: Cases of the short run: of documents, and of records, whose reader starts again after many.
DOCUMENTS, RECORDS = 200, 4
#: Formats of which a case takes long.
SLOW = ("calibration", "sizes", "study-progress", "requests", "connections")
#: Cases of requests to the application, and of connections to its server.
ASKED = {"requests": 30, "connections": 12}


@pytest.fixture(autouse=True)
def memory_counts_from_now(monkeypatch):
    """Measure memory relative to the start, because earlier tests may have used much."""
    peaks = [fuzz.hunt._peak(who) for who in (RUSAGE_SELF, RUSAGE_CHILDREN)]
    monkeypatch.setattr("fuzz.hunt._FIRST", max(peaks))


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Return a function that returns a format and its cached folder."""
    place, programs = tmp_path_factory.mktemp("bench"), {}

    def get(name):
        if name not in programs:
            programs.update(formats(place, [name]))
        return programs[name], place / name / f"case{programs[name].suffix}"

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COUNTERSPIN_DEBUG", "1")
        yield get


@pytest.mark.parametrize("case", CASES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_previous_finds_raise_clear_errors(bench, case):
    form, path = bench(case.parent.name)
    path.write_bytes(case.read_bytes())
    verdict, words = judge(form, path)
    assert verdict != "found", words


@pytest.mark.slow
def test_few_new_cases_of_each_format_have_no_find(bench):
    shares = {name: row.share for name, row in FORMATS.items() if name not in SLOW}
    for native, count in ((False, DOCUMENTS), (True, RECORDS)):
        names = [name for name in shares if FORMATS[name].native == native]
        rng = Random(4)
        verdicts = set()
        for number in range(count):
            (name,) = rng.choices(names, [shares[name] for name in names])
            form, path = bench(name)
            path.write_bytes(content(name, form, 2, number))
            verdict, words = judge(form, path)
            assert verdict != "found", f"{name}, seed 2, number {number}\n{words}"
            verdicts.add(verdict)
        assert "refused" in verdicts


@pytest.mark.slow
def test_huge_sizes_in_description_do_not_exhaust_memory(bench):
    form, path = bench("sizes")
    verdicts = []
    for number in range(10):
        path.write_bytes(content("sizes", form, 2, number))
        verdict, words = judge(form, path)
        assert verdict != "found", f"seed 2, number {number}\n{words}"
        verdicts.append(verdict)
    assert verdicts.count("refused") > 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ASKED)
def test_application_answers_random_requests(bench, name):
    form, path = bench(name)
    verdicts = set()
    for number in range(ASKED[name]):
        path.write_bytes(content(name, form, 2, number))
        verdict, words = judge(form, path)
        assert verdict != "found", f"seed 2, number {number}\n{words}"
        verdicts.add(verdict)
    assert verdicts == {"accepted", "refused"}


def fail(path):
    return 1 / len(path.read_bytes())


def turn(_path):
    while True:
        pass


def complain(_path):
    """Imitate native code, which does not use `sys.stderr`."""
    os.write(2, b"thread panicked\n")


@pytest.mark.parametrize(
    ("use", "words"),
    [
        (fail, "ZeroDivisionError"),
        (turn, "TookTooLongError"),
        (complain, "standard error"),
        (lambda path: None, ""),
    ],
)
def test_judge_detects_failures(tmp_path, monkeypatch, use, words):
    monkeypatch.setattr("fuzz.hunt.SECONDS", 0.1)
    path = tmp_path / "case.x"
    path.write_bytes(b"")
    verdict, detail = judge(Format(".x", lambda rng: b"", use), path)
    assert verdict == ("found" if words else "accepted")
    assert words in detail


def touch_outside(desk):
    """Imitate a request that reads outside the folder."""
    return (desk.folder.root.parent / "outside" / "secret.toml").read_text()


def leave_half(desk):
    """Imitate a request that fails while writing a file."""
    (desk.folder.root / ".half").write_text("x")
    raise CounterspinError("no space")


@pytest.mark.parametrize(
    ("respond", "words"),
    [
        (touch_outside, "outside was touched"),
        (leave_half, "has changed ['.half']"),
        (lambda desk: 1 / 0, "ZeroDivisionError"),
        (lambda desk: {"told": SECRET}, "what is outside was told"),
        (lambda desk: desk.file("nowhere"), ""),
    ],
)
def test_wrong_answer_is_detected(bench, monkeypatch, respond, words):
    form, path = bench("requests")
    monkeypatch.setitem(ENDPOINTS, ("GET", "folder"), respond)
    path.write_text(json.dumps([request_of("GET", "/api/folder", {})]))
    verdict, detail = judge(form, path)
    assert verdict == ("found" if words else "refused")
    assert words in detail


def test_every_endpoint_is_fuzzed(bench):
    _, path = bench("requests")
    valid = valid_requests(path.parent / "template").values()
    assert ENDPOINTS.keys() <= {(method, where.removeprefix("/api/")) for method, where, _ in valid}


def test_command_failing_without_message_is_detected(monkeypatch):
    monkeypatch.delenv("COUNTERSPIN_DEBUG", raising=False)
    monkeypatch.setattr("counterspin.input.open_file", None)
    with pytest.raises(AssertionError):
        command("report", ROOT / "tests/frozen/schema-1-joint.json", "--date", "2026-01-01")


@pytest.mark.slow
def test_hunt_counts_cases(tmp_path, bench):
    bag = hunt(["lab"], seed=5, first=1, count=30, output=tmp_path)
    form, path = bench("lab")
    refused = 0
    for number in range(1, 31):
        path.write_bytes(content("lab", form, 5, number))
        refused += judge(form, path)[0] == "refused"
    assert bag.counts == {"lab refused": refused, "lab accepted": 30 - refused}
    assert not bag.finds
    assert "lab" in bag.table()


#: Stands for a worker that its second case kills.
DYING = """
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
        lambda words, **more: start([sys.executable, "-c", DYING, *words[-3:]], **more),
    )
    bag = hunt(["lab"], seed=5, first=1, count=3, output=tmp_path)
    (sign,) = bag.finds
    assert sign.startswith("lab: the process ended with status -6")
    form = formats(tmp_path / "bench", ["lab"])["lab"]
    assert (tmp_path / "lab-5-2.toml").read_bytes() == content("lab", form, 5, 2)
    assert bag.counts["lab found"] == 1


needs_tracing = pytest.mark.skipif(not possible(), reason="processes cannot be traced here")


@needs_tracing
def test_killed_command_leaves_no_partial_file():
    messages = []
    done, faults = kill_all(2, ["plan-begin"], messages.append)
    assert faults == []
    assert done == 2
    assert [words.split()[0] for words in messages] == ["plan-begin:", "plan-begin"]


#: Writes its output in place, and spoils its input.
CARELESS = """
open("result.json", "a").write("x")
with open("new.json", "w") as file:
    file.write("half ")
    file.flush()
    file.write("and half")
"""


@needs_tracing
def test_lost_file_is_detected(tmp_path, monkeypatch):
    (tmp_path / "careless.py").write_text(CARELESS)
    monkeypatch.syspath_prepend(tmp_path)
    inputs = tmp_path / "inputs"
    inputs.mkdir()
    (inputs / "result.json").write_text("")
    with Runner("careless") as runner:
        trial = Trial(runner, "careless", Command((), ("result.json",)), inputs, tmp_path)
        assert trial.calls == 5
        assert not trial.faults(1)
        assert any("result.json is lost or changed" in fault for fault in trial.faults(4))
        assert any("new.json is not whole" in fault for fault in trial.faults(5))


def test_page_states_fuzzing_limits():
    (seconds,) = find_numbers("harmful-files", "more than {} s of CPU time or")
    (gigabytes,) = find_numbers("harmful-files", "of CPU time or {} GB of memory")
    new, n_requests = find_numbers(
        "harmful-files",
        "reads all of these and {} new cases, and sends {} cases to the application",
    )
    (commands,) = find_numbers("harmful-files", "killed {} commands at each")
    assert [parse_number(number) for number in (seconds, gigabytes, new, n_requests, commands)] == [
        SECONDS,
        BYTES / 1e9,
        DOCUMENTS + RECORDS,
        sum(ASKED.values()),
        len(COMMANDS),
    ]


#: Kinds of cases of the application.
_OF_APPLICATION = ("requests to the application", "connections to its server")


def test_page_states_number_of_tried_cases():
    page = read_text("harmful-files")
    fromkeys = dict.fromkeys(("DOCUMENTS", "RECORDS", "KILLS", "requests"), 0)
    command = (
        r"make fuzz (?:ONLY=(\S+) )?(SEED=\d+ DOCUMENTS=\d+ RECORDS=\d+ KILLS=\d+)"
        r"(?: # and so on to seed (\d+))?"
    )
    for only, words, last in re.findall(command, page):
        given = {key: int(number) for key, number in re.findall(r"(\w+)=(\d+)", words)}
        seeds = int(last or given["SEED"]) - given["SEED"] + 1
        for key in ("DOCUMENTS", "RECORDS", "KILLS"):
            kind = "requests" if key == "DOCUMENTS" and only.startswith("requests") else key
            fromkeys[kind] += seeds * given[key]
    documents, refused = find_numbers("harmful-files", "| documents and CSV | {} | {} |")
    (records,) = find_numbers("harmful-files", "Excel and PDF | {} |")
    (kills,) = find_numbers("harmful-files", "| commands killed | {} |")
    # A hunt that is stopped has tried fewer.
    assert 0.999 * fromkeys["DOCUMENTS"] < parse_number(documents) <= fromkeys["DOCUMENTS"]
    assert parse_number(refused) < parse_number(documents)
    assert [parse_number(records), parse_number(kills)] == [fromkeys["RECORDS"], fromkeys["KILLS"]]
    asked_of = [
        find_numbers("harmful-files", f"| {kind} | {{}} | {{}} |") for kind in _OF_APPLICATION
    ]
    assert sum(parse_number(tried) for tried, _ in asked_of) == fromkeys["requests"]
    assert all(parse_number(refused) < parse_number(tried) for tried, refused in asked_of)
    # A case of requests has 1 to 3 of them, 1.6 in the mean.
    (sent,) = find_numbers("harmful-files", "The `requests` cases sent {} requests")
    assert parse_number(sent) == pytest.approx(1.6 * parse_number(asked_of[0][0]), rel=0.01)
