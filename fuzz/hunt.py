"""Draw, run and judge cases; store the findings.

Format, seed and number determine a case. A file is either refused with a `CounterspinError` or
accepted. Every other outcome is a finding: another exception, a warning of a library, output on
standard error, more than 10 s of processor time, more than 1 GB of memory, or the end of the
process.

- `draw_content`: draw the file of a case
- `judge`: read a file, and classify the outcome
- `run_worker`: run cases in a worker process
- `hunt`: run cases in a worker; restart it after a case that ends the process
"""

from __future__ import annotations

import json
import mmap
import os
import resource
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from counterspin.errors import CounterspinError, CounterspinWarning
from fuzz import ROOT
from fuzz.formats import FORMATS, Format, make_formats

#: Limits of a case: processor time in s, and additional memory in bytes.
MAX_SECONDS = 10.0
MAX_BYTES = 1_000_000_000
#: Memory limit of the worker process, bytes.
_PROCESS_MEMORY_LIMIT = 3_000_000_000
#: A worker that uses no processor time for this long hangs, s; `MAX_SECONDS` stops a busy one.
_HANG_TIME = 180.0
#: Maximum length of an error message, characters.
_MAX_MESSAGE_LENGTH = 20_000


class TookTooLongError(BaseException):
    """A case exceeded its limit of processor time."""


def draw_content(name: str, format_: Format, seed: int, number: int) -> bytes:
    """Return the content of the file of a case."""
    for attempt in range(50):
        try:
            return format_.draw(Random(f"{name}/{seed}/{number}/{attempt}"))
        except KeyboardInterrupt:
            raise
        except BaseException:  # the tree is too deep, or the format lacks a type
            continue
    raise RuntimeError(f"no case of the format {name} could be drawn")


def judge(format_: Format, path: Path) -> tuple[str, str]:
    """Return ("accepted" or "refused", "") or ("found", description)."""
    previous_length = _stderr_length()
    verdict, description = _judge_unguarded(format_, path)
    if verdict != "found" and _stderr_length() > previous_length:
        return "found", "a library wrote to standard error"
    return verdict, description


def _stderr_length() -> int:
    """Return the size of standard error in bytes, including output of native code; 0 if no file."""
    status = os.fstat(2)
    return status.st_size if stat.S_ISREG(status.st_mode) else 0


def _judge_unguarded(format_: Format, path: Path) -> tuple[str, str]:
    _limit_processor_time(MAX_SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", CounterspinWarning)
            format_.read(path)
    except CounterspinError as error:
        message = str(error)
        _limit_processor_time(0.0)
        if len(message) > _MAX_MESSAGE_LENGTH:
            return "found", f"a message of {len(message)} characters\n{message[:300]}"
        if "Traceback" in message:
            return "found", f"a traceback in the message\n{message}"
        return "refused", ""
    except KeyboardInterrupt:
        raise
    except BaseException:
        return "found", traceback.format_exc()
    finally:
        _limit_processor_time(0.0)
    memory = (
        max(_peak_memory(resource.RUSAGE_SELF), _peak_memory(resource.RUSAGE_CHILDREN))
        - _INITIAL_PEAK
    )
    if memory > MAX_BYTES:
        return "found", f"took {memory / 1e9:.2f} GB"
    return "accepted", ""


def _peak_memory(who: int) -> int:
    return resource.getrusage(who).ru_maxrss * 1024


_INITIAL_PEAK = _peak_memory(resource.RUSAGE_SELF)


def _limit_processor_time(seconds: float) -> None:
    """Raise `TookTooLongError` after this much processor time; 0: never."""

    def raise_error(*_: object) -> None:
        raise TookTooLongError(f"more than {seconds:g} s of processor time")

    signal.signal(signal.SIGPROF, raise_error)
    signal.setitimer(signal.ITIMER_PROF, seconds)


def _schedule(names: Sequence[str], first: int, count: int) -> Iterator[tuple[int, str]]:
    """Yield number and format of each case; draw formats in proportion to their shares."""
    shares = [FORMATS[name].share for name in names]
    for number in range(first, first + count):
        yield number, Random(f"which/{number}").choices(names, shares)[0]


def run_worker(names: Sequence[str], seed: int, first: int, count: int, folder: Path) -> None:
    """Run cases; write the current case number and the outcomes as JSON lines to `folder`."""
    os.environ["COUNTERSPIN_DEBUG"] = "1"  # raise unexpected errors
    soft_limit = resource.getrlimit(resource.RLIMIT_DATA)[0]
    if soft_limit == resource.RLIM_INFINITY:
        resource.setrlimit(resource.RLIMIT_DATA, (_PROCESS_MEMORY_LIMIT, resource.RLIM_INFINITY))
    temporary = Path("/dev/shm") if os.access("/dev/shm", os.W_OK) else None
    format_folder = Path(tempfile.mkdtemp(prefix="fuzz", dir=temporary))
    current_case = mmap.mmap(os.open(folder / "at", os.O_RDWR), 8)
    try:
        worker_formats = make_formats(format_folder, names)
        global _INITIAL_PEAK  # noqa: PLW0603 -- loaded modules do not count
        _INITIAL_PEAK = _peak_memory(resource.RUSAGE_SELF)
        counts: Counter[str] = Counter()
        last_report = time.monotonic()
        with (folder / "lines").open("a", encoding="utf-8") as lines:

            def write_entry(**entry: object) -> None:
                lines.write(json.dumps(entry) + "\n")
                lines.flush()

            for number, name in _schedule(names, first, count):
                current_case[:] = number.to_bytes(8, "little")
                format_ = worker_formats[name]
                path = format_folder / name / f"case{format_.suffix}"
                path.write_bytes(draw_content(name, format_, seed, number))
                verdict, description = judge(format_, path)
                counts[f"{name} {verdict}"] += 1
                if verdict == "found":
                    write_entry(found=description, name=name, number=number, suffix=format_.suffix)
                exceeded_memory = description.startswith("took ")
                if (
                    exceeded_memory
                    or time.monotonic() > last_report + 2.0
                    or number == first + count - 1
                ):
                    write_entry(counts=counts, next=number + 1)
                    counts.clear()
                    last_report = time.monotonic()
                if exceeded_memory:  # the peak memory of a process never decreases
                    return
    finally:
        shutil.rmtree(format_folder, ignore_errors=True)


@dataclass
class HuntStatistics:
    """Numbers and findings of a hunt.

    Attributes
    ----------
    counts
        "FORMAT accepted", "FORMAT refused" or "FORMAT found" -> number of cases.
    finds
        One-line description of a finding -> file stems of its first cases.
    seconds
        Duration of the hunt.
    """

    counts: Counter[str] = field(default_factory=Counter)
    finds: dict[str, list[str]] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def tried(self) -> int:
        """Number of cases."""
        return sum(self.counts.values())

    def table(self) -> str:
        """Return the counts by format as a text table."""
        names = sorted({key.split()[0] for key in self.counts})
        lines = [f"{'format':<18}{'tried':>9}{'refused':>9}{'accepted':>9}{'finds':>7}"]
        for name in names:
            refused, accepted, found = (
                self.counts[f"{name} {verdict}"] for verdict in ("refused", "accepted", "found")
            )
            total = refused + accepted + found
            lines.append(f"{name:<18}{total:>9}{refused:>9}{accepted:>9}{found:>7}")
        return "\n".join(lines)


#: Number of stored files of findings with the same signature.
_MAX_FILES_PER_FINDING = 3


def hunt(names: Sequence[str], seed: int, first: int, count: int, output: Path) -> HuntStatistics:
    """Run cases in a worker process that a case may end; store the findings in a folder."""
    statistics, start, end = HuntStatistics(), time.monotonic(), first + count
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        while first < end:
            (folder / "at").write_bytes(bytes(8))
            (folder / "lines").write_text("")
            arguments = [",".join(names), str(seed), str(first), str(end - first), str(folder)]
            with (folder / "stderr").open("w") as error_output:
                worker = subprocess.Popen(
                    [sys.executable, "-m", "fuzz", "--work", *arguments],
                    cwd=ROOT,
                    stderr=error_output,
                )
                failure = _watch_worker(worker, folder, statistics, seed, output, start)
            last_case = int.from_bytes((folder / "at").read_bytes(), "little")
            if failure is None:
                first = int(_LAST_ENTRY.get("next", end))
                continue
            errors = (folder / "stderr").read_text(errors="replace")[-3000:]
            if last_case < first:
                raise SystemExit(f"the worker did not start:\n{errors}")
            _record_fatal_case(statistics, output, seed, names, last_case, f"{failure}\n{errors}")
            first = last_case + 1
    statistics.seconds = time.monotonic() - start
    _save_report(statistics, output, seed)
    return statistics


_LAST_ENTRY: dict[str, object] = {}


def _watch_worker(
    worker: subprocess.Popen[bytes],
    folder: Path,
    statistics: HuntStatistics,
    seed: int,
    output: Path,
    start: float,
) -> str | None:
    """Watch a worker until it ends; return the reason, or None if it has finished."""
    _LAST_ENTRY.clear()
    offset, progress, last_progress = 0, (b"", 0.0), time.monotonic()
    while True:
        status = worker.poll()
        with (folder / "lines").open(encoding="utf-8") as lines:
            lines.seek(offset)
            text = lines.read()
        complete_lines = text.rpartition("\n")[0]
        offset += len((complete_lines + "\n").encode()) if complete_lines else 0
        for line in complete_lines.splitlines():
            entry = json.loads(line)
            if "found" in entry:
                _record_finding(
                    statistics, output, entry["found"], entry["name"], seed, entry["number"]
                )
            else:
                statistics.counts.update(entry["counts"])
                _LAST_ENTRY.update(entry)
                statistics.seconds = time.monotonic() - start
                _save_report(statistics, output, seed)
        if status is not None:
            return None if status == 0 else f"the process ended with status {status}"
        new_progress = (folder / "at").read_bytes(), _read_processor_time(worker.pid)
        if new_progress != progress:
            progress, last_progress = new_progress, time.monotonic()
        elif time.monotonic() > last_progress + _HANG_TIME and int.from_bytes(
            new_progress[0], "little"
        ):
            worker.kill()
            worker.wait()
            return f"hung for {_HANG_TIME:g} s"
        time.sleep(0.5)


def _read_processor_time(process: int) -> float:
    """Return the processor time of a process and of its terminated children, s."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text("ascii").rpartition(")")[2].split()
    except OSError:  # it has ended, or the system is not Linux
        return 0.0
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def _record_fatal_case(
    statistics: HuntStatistics,
    output: Path,
    seed: int,
    names: Sequence[str],
    number: int,
    description: str,
) -> None:
    """Record the case that ended the worker."""
    ((_, name),) = _schedule(names, number, 1)
    statistics.counts[f"{name} found"] += 1
    _record_finding(statistics, output, description, name, seed, number)


def _record_finding(
    statistics: HuntStatistics, output: Path, description: str, name: str, seed: int, number: int
) -> None:
    signature = f"{name}: {_signature(description)}"
    stored_files = statistics.finds.setdefault(signature, [])
    if len(stored_files) >= _MAX_FILES_PER_FINDING:
        return
    with tempfile.TemporaryDirectory() as folder:
        format_ = make_formats(Path(folder), [name])[name]
        stem = output / f"{name}-{seed}-{number}"
        stem.with_suffix(format_.suffix).write_bytes(draw_content(name, format_, seed, number))
    stem.with_suffix(".txt").write_text(description, encoding="utf-8", errors="replace")
    stored_files.append(stem.name)
    print(f"{signature} ({stem.name})", flush=True)


def _signature(description: str) -> str:
    """Return one line that is equal for findings with the same cause."""
    lines = [line.strip() for line in description.strip().splitlines() if line.strip()]
    if not description.startswith("Traceback"):
        return lines[0][:100] if lines else ""
    own_lines = [line for line in lines if line.startswith("File") and "counterspin" in line]
    location = own_lines[-1].rpartition("counterspin/")[2].replace('"', "") if own_lines else ""
    return f"{lines[-1].partition(':')[0]} at {location}"


def _save_report(statistics: HuntStatistics, output: Path, seed: int) -> None:
    report = {"seed": seed, "tried": statistics.tried, "seconds": round(statistics.seconds)}
    report |= {"counts": dict(statistics.counts), "finds": statistics.finds}
    (output / "report.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
