"""`init --from`: from recorder files to a result on the command line."""

import io
import math
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, suppress

import numpy as np
import pytest
from exports import EXPORTS, simulate_campaign, write_records

from counterspin.calibration.result import Result
from counterspin.cli import main

PLACE = ["--answer", "gravity=9.8066 m/s^2", "--answer", "latitude=45.75 deg"]
ANSWERED = [*PLACE, "--answer", "radius=2.5 m"]


class Terminal(io.StringIO):
    """A terminal that answers each question with one line."""

    def isatty(self):
        return True


@pytest.fixture(scope="module")
def plain_folder(tmp_path_factory):
    return simulate_campaign(tmp_path_factory.mktemp("exports"))


def read_k_ii(folder):
    assert main(["calibrate", str(folder), "--json", str(folder / "result.json")]) == 0
    return Result.read(folder / "result.json").accelerometers["Qx"].coefficients["K_II"]


@pytest.fixture(scope="module")
def reference(plain_folder, tmp_path_factory):
    """Return K_II of the plain records with the same answers."""
    folder = tmp_path_factory.mktemp("plain")
    files = [str(plain_folder / f"{name}.csv") for name in ("slow", "fast")]
    words = ["--answer", "sense=counterclockwise"]
    assert main(["init", str(folder), "--from", *files, "--yes", *ANSWERED, *words]) == 0
    return read_k_ii(folder)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["labview", "tdms", "clockwise from north", "pulse"])
def test_exports_to_result(tmp_path, plain_folder, reference, name, capsys):
    files = write_records(plain_folder, tmp_path / "files", EXPORTS[name])
    sense = "clockwise" if "clockwise" in name else "counterclockwise"
    words = ["--yes", *ANSWERED, "--answer", f"sense={sense}"]
    folder = tmp_path / "campaign"
    assert main(["init", str(folder), "--from", *map(str, files), *words]) == 0
    output = capsys.readouterr().out
    assert "Detected in the files:" in output
    assert "Detected for the test type double-turntable (please check):" in output
    assert f"counterspin calibrate {folder}" in output
    text = (folder / "campaign.toml").read_text(encoding="utf-8")
    assert "# - pendulous axes: assumed down" in text
    k_ii = read_k_ii(folder)
    assert abs(k_ii.value - reference.value) < 0.01 * reference.u


def test_arm_table_to_result(tmp_path, monkeypatch, capsys):
    rows = ["side,period_s,out_V", "up,0,1.003", "down,0,-0.997", "up,0,1.0031", "down,0,-0.9971"]
    for period in (2.0, 1.2, 0.8, 0.6):
        force = (2.0 * math.pi / period) ** 2 / 9.8066
        rows += [f"in,{period},{force + 0.003:.5f}", f"out,{period},{-force + 0.003:.5f}"]
    (tmp_path / "arm.csv").write_text("\n".join(rows) + "\n")
    words = [str(tmp_path / "a"), "--from", str(tmp_path / "arm.csv"), *PLACE]
    monkeypatch.setattr("sys.stdin", Terminal("\n1.0 ± 1e-3 m\nleft\ncw\n1\n1e-4\n"))
    assert main(["init", *words]) == 0
    output = capsys.readouterr().out
    assert "4 readings at rest (rate 0)" in output
    assert "'left' is not one of counterclockwise, clockwise. Try again:" in output
    assert "The data suggest about 1 V/g. (for example 1.25 V/g)" in output
    assert main(["calibrate", str(tmp_path / "a"), "--json", str(tmp_path / "r.json")]) == 0
    coefficients = Result.read(tmp_path / "r.json").accelerometers["A"].coefficients
    assert coefficients["K_F"].value == pytest.approx(0.003, abs=1e-4)
    assert coefficients["K_I"].value == pytest.approx(1.0, abs=1e-4)


def test_question_names_text_that_hides_an_axis(tmp_path, capsys):
    """Two axes show the sense of rotation, but one of them contains a word."""
    time = np.arange(1500) * 0.02
    rows = [
        f"{t:.2f},{1.5 * t:.6f},{2.5 * np.cos(1.5 * t):.5f},{2.5 * np.sin(1.5 * t):.5f}"
        for t in time
    ]
    rows[500] = rows[500].rpartition(",")[0] + ",?"
    path = tmp_path / "run.csv"
    path.write_text("\n".join(["time_s,angle_rad,east_m,north_m", *rows]), encoding="utf-8")
    assert main(["init", str(tmp_path / "a"), "--from", str(path), *PLACE, "--yes"]) == 2
    stderr = capsys.readouterr().err
    assert "Not read: run.csv, line 502: column 'north_m' contains the text '?'" in stderr


def test_missing_answer_is_requested(tmp_path, plain_folder, monkeypatch, capsys):
    words = ["init", str(tmp_path), "--from", str(plain_folder / "slow.csv"), *PLACE]
    assert main([*words, "--yes"]) == 2
    stderr = capsys.readouterr().err
    assert 'Set this value with --answer, for example "radius=2.5' in stderr
    assert "sense: In which sense does the angle increase" in stderr
    assert not (tmp_path / "campaign.toml").exists()
    assert main(words) == 2  # no terminal for questions

    monkeypatch.setattr("sys.stdin", Terminal("bench\n\n2,5 kg\n2,5\nleft\ncw\n"))
    assert main(words) == 0
    stderr = capsys.readouterr().out
    assert "'bench' is not one of double-turntable, tumble, arm, poses. Try again:" in stderr
    assert "unknown unit 'kg'" in stderr
    assert "'left' is not one of counterclockwise, clockwise. Try again:" in stderr
    assert 'sense = "clockwise"' in (tmp_path / "campaign.toml").read_text(encoding="utf-8")
    monkeypatch.setattr("sys.stdin", Terminal(""))
    assert main(["init", str(tmp_path / "b"), *words[2:]]) == 1
    assert "no answer was given" in capsys.readouterr().err


def test_rejects_invalid_options(tmp_path, plain_folder, capsys):
    assert main(["init", str(tmp_path), "--yes"]) == 2
    assert "--from FILE" in capsys.readouterr().err
    words = ["init", str(tmp_path), "--from", str(plain_folder / "slow.csv"), "--answer", "radius"]
    assert main(words) == 2
    assert "KEY=VALUE" in capsys.readouterr().err
    words[-1:] = ["radius=2 m", "--answer", "radius=3 m"]
    assert main(words) == 2
    assert "answer: radius has two different answers" in capsys.readouterr().err
    assert main(["init", str(tmp_path / "new"), "--from"]) == 2
    assert capsys.readouterr().err == "counterspin: init: give the data files: --from FILE ...\n"
    assert not (tmp_path / "new").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
def test_interrupt_ends_prompt_at_once(tmp_path, plain_folder):
    terminal, stdin = os.openpty()
    # Processes of a shell in the background ignore SIGINT.
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from counterspin.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    words = ["init", str(tmp_path / "new"), "--from", str(plain_folder / "slow.csv")]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *words],
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    with process, ExitStack() as stack:
        stack.callback(os.close, terminal)
        stack.callback(os.close, stdin)
        stack.callback(process.kill)
        output = b""
        while not output.endswith(b"> "):
            output += os.read(process.stdout.fileno(), 4096)
        error = None
        for _ in range(6):
            time.sleep(0.2)
            process.send_signal(signal.SIGINT)  # too early if the process does not read yet
            with suppress(subprocess.TimeoutExpired):
                _, error = process.communicate(timeout=10)
                break
    assert (process.returncode, error) == (130, b"counterspin: stopped\n")
    assert not (tmp_path / "new").exists()
