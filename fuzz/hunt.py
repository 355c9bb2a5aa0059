"""The hunt: cases are drawn, tried and judged; what is found is kept.

A case is known by format, seed and number, and comes out the same each time. A file is refused with
a `CounterspinError` in words that a terminal may show, or it is accepted; everything else is a
find: another exception, a warning of a library, anything on standard error, more than 10 s of
processor time, more than 1 GB, the end of the process.

- `content`: the file of a case
- `judge`: what comes of one file
- `work`: tries cases, in a process of its own
- `hunt`: has them tried, and starts again where the process did not survive a case
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
from fuzz.formats import FORMATS, Format, formats

#: What a case may take: processor time in s, and memory in bytes beyond what there was before.
SECONDS = 10.0
BYTES = 1_000_000_000
#: More than this the process does not get.
_MOST_BYTES = 3_000_000_000
#: A worker that has used no processor time for so long hangs; s. `SECONDS` ends one that is busy.
_HANGS = 180.0
#: The longest message.
_CHARACTERS = 20_000


class TookTooLongError(BaseException):
    """A case exceeded its limit of processor time."""


def content(name: str, form: Format, seed: int, number: int) -> bytes:
    """Return the content of the file of a case."""
    for attempt in range(50):
        try:
            return form.make(Random(f"{name}/{seed}/{number}/{attempt}"))
        except KeyboardInterrupt:
            raise
        except BaseException:  # a tree too deep to be written, a type that the format lacks
            continue
    raise RuntimeError(f"no file could be made of {name}")


def judge(form: Format, path: Path) -> tuple[str, str]:
    """Return ("accepted" or "refused", "") or ("found", description)."""
    before = _stderr_length()
    verdict, words = _judge_unguarded(form, path)
    if verdict != "found" and _stderr_length() > before:
        return "found", "a library wrote to standard error"
    return verdict, words


def _stderr_length() -> int:
    """Return the size of standard error in bytes, including output of native code; 0 if no file."""
    status = os.fstat(2)
    return status.st_size if stat.S_ISREG(status.st_mode) else 0


def _judge_unguarded(form: Format, path: Path) -> tuple[str, str]:
    _processor_time_limit(SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", CounterspinWarning)
            form.use(path)
    except CounterspinError as error:
        words = str(error)
        _processor_time_limit(0.0)
        if len(words) > _CHARACTERS:
            return "found", f"a message of {len(words)} characters\n{words[:300]}"
        if "Traceback" in words:
            return "found", f"unfit words\n{words}"
        return "refused", ""
    except KeyboardInterrupt:
        raise
    except BaseException:
        return "found", traceback.format_exc()
    finally:
        _processor_time_limit(0.0)
    taken = max(_peak(resource.RUSAGE_SELF), _peak(resource.RUSAGE_CHILDREN)) - _FIRST
    if taken > BYTES:
        return "found", f"took {taken / 1e9:.2f} GB"
    return "accepted", ""


def _peak(who: int) -> int:
    return resource.getrusage(who).ru_maxrss * 1024


_FIRST = _peak(resource.RUSAGE_SELF)


def _processor_time_limit(seconds: float) -> None:
    """Raise `TookTooLongError` after this much processor time; 0: never."""

    def late(*_: object) -> None:
        raise TookTooLongError(f"more than {seconds:g} s of processor time")

    signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, seconds)


def _schedule(names: Sequence[str], first: int, count: int) -> Iterator[tuple[int, str]]:
    """Yield number and format of each case; draw formats in proportion to their shares."""
    shares = [FORMATS[name].share for name in names]
    for number in range(first, first + count):
        yield number, Random(f"which/{number}").choices(names, shares)[0]


def work(names: Sequence[str], seed: int, first: int, count: int, folder: Path) -> None:
    """Try cases; `folder` takes the number of the case at hand, and lines of what came of them."""
    os.environ["COUNTERSPIN_DEBUG"] = "1"  # what is unforeseen is raised
    soft = resource.getrlimit(resource.RLIMIT_DATA)[0]
    if soft == resource.RLIM_INFINITY:
        resource.setrlimit(resource.RLIMIT_DATA, (_MOST_BYTES, resource.RLIM_INFINITY))
    temporary = Path("/dev/shm") if os.access("/dev/shm", os.W_OK) else None
    place = Path(tempfile.mkdtemp(prefix="fuzz", dir=temporary))
    at = mmap.mmap(os.open(folder / "at", os.O_RDWR), 8)
    try:
        chosen = formats(place, names)
        global _FIRST  # noqa: PLW0603 -- what is loaded by now is nobody's
        _FIRST = _peak(resource.RUSAGE_SELF)
        counts: Counter[str] = Counter()
        told = time.monotonic()
        with (folder / "lines").open("a", encoding="utf-8") as lines:

            def tell(**entry: object) -> None:
                lines.write(json.dumps(entry) + "\n")
                lines.flush()

            for number, name in _schedule(names, first, count):
                at[:] = number.to_bytes(8, "little")
                form = chosen[name]
                path = place / name / f"case{form.suffix}"
                path.write_bytes(content(name, form, seed, number))
                verdict, words = judge(form, path)
                counts[f"{name} {verdict}"] += 1
                if verdict == "found":
                    tell(found=words, name=name, number=number, suffix=form.suffix)
                over = words.startswith("took ")
                if over or time.monotonic() > told + 2.0 or number == first + count - 1:
                    tell(counts=counts, next=number + 1)
                    counts.clear()
                    told = time.monotonic()
                if over:  # the most that was taken stays the most
                    return
    finally:
        shutil.rmtree(place, ignore_errors=True)


@dataclass
class HuntStatistics:
    """What a hunt has brought.

    Attributes
    ----------
    counts
        "FORMAT accepted", "FORMAT refused", "FORMAT found" -> how many.
    finds
        What is wrong, in one line -> the files of such cases, the first ones.
    seconds
        That it took.
    """

    counts: Counter[str] = field(default_factory=Counter)
    finds: dict[str, list[str]] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def tried(self) -> int:
        """How many cases were tried."""
        return sum(self.counts.values())

    def table(self) -> str:
        """Return the counts of each format as lines."""
        names = sorted({key.split()[0] for key in self.counts})
        lines = [f"{'format':<18}{'tried':>9}{'refused':>9}{'accepted':>9}{'finds':>7}"]
        for name in names:
            refused, accepted, found = (
                self.counts[f"{name} {verdict}"] for verdict in ("refused", "accepted", "found")
            )
            total = refused + accepted + found
            lines.append(f"{name:<18}{total:>9}{refused:>9}{accepted:>9}{found:>7}")
        return "\n".join(lines)


#: So many files of finds that look alike are kept.
_ALIKE = 3


def hunt(names: Sequence[str], seed: int, first: int, count: int, output: Path) -> HuntStatistics:
    """Have cases tried in a process that may die of one, and keep what is found in a folder."""
    bag, began, end = HuntStatistics(), time.monotonic(), first + count
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        while first < end:
            (folder / "at").write_bytes(bytes(8))
            (folder / "lines").write_text("")
            words = [",".join(names), str(seed), str(first), str(end - first), str(folder)]
            with (folder / "stderr").open("w") as complaints:
                worker = subprocess.Popen(
                    [sys.executable, "-m", "fuzz", "--work", *words], cwd=ROOT, stderr=complaints
                )
                ended = _watch_worker(worker, folder, bag, seed, output, began)
            reached = int.from_bytes((folder / "at").read_bytes(), "little")
            if ended is None:
                first = int(_LAST.get("next", end))
                continue
            last = (folder / "stderr").read_text(errors="replace")[-3000:]
            if reached < first:
                raise SystemExit(f"the worker did not start:\n{last}")
            _keep(bag, output, seed, names, reached, f"{ended}\n{last}")
            first = reached + 1
    bag.seconds = time.monotonic() - began
    _save(bag, output, seed)
    return bag


_LAST: dict[str, object] = {}


def _watch_worker(
    worker: subprocess.Popen[bytes],
    folder: Path,
    bag: HuntStatistics,
    seed: int,
    output: Path,
    began: float,
) -> str | None:
    """Follow a worker until it ends; return why, unless it was done."""
    _LAST.clear()
    place, at, since = 0, (b"", 0.0), time.monotonic()
    while True:
        status = worker.poll()
        with (folder / "lines").open(encoding="utf-8") as lines:
            lines.seek(place)
            text = lines.read()
        whole = text.rpartition("\n")[0]
        place += len((whole + "\n").encode()) if whole else 0
        for line in whole.splitlines():
            entry = json.loads(line)
            if "found" in entry:
                _record_finding(bag, output, entry["found"], entry["name"], seed, entry["number"])
            else:
                bag.counts.update(entry["counts"])
                _LAST.update(entry)
                bag.seconds = time.monotonic() - began
                _save(bag, output, seed)
        if status is not None:
            return None if status == 0 else f"the process ended with status {status}"
        now = (folder / "at").read_bytes(), _processor_time(worker.pid)
        if now != at:
            at, since = now, time.monotonic()
        elif time.monotonic() > since + _HANGS and int.from_bytes(now[0], "little"):
            worker.kill()
            worker.wait()
            return f"hung for {_HANGS:g} s"
        time.sleep(0.5)


def _processor_time(process: int) -> float:
    """Return the processor time of a process and of its children that have ended, s."""
    try:
        words = Path(f"/proc/{process}/stat").read_text("ascii").rpartition(")")[2].split()
    except OSError:  # it has ended, or the system is not Linux
        return 0.0
    return sum(map(int, words[11:15])) / os.sysconf("SC_CLK_TCK")


def _keep(
    bag: HuntStatistics, output: Path, seed: int, names: Sequence[str], number: int, words: str
) -> None:
    """Keep the case at which the process ended."""
    ((_, name),) = _schedule(names, number, 1)
    bag.counts[f"{name} found"] += 1
    _record_finding(bag, output, words, name, seed, number)


def _record_finding(
    bag: HuntStatistics, output: Path, words: str, name: str, seed: int, number: int
) -> None:
    sign = f"{name}: {_signature(words)}"
    alike = bag.finds.setdefault(sign, [])
    if len(alike) >= _ALIKE:
        return
    with tempfile.TemporaryDirectory() as place:
        form = formats(Path(place), [name])[name]
        stem = output / f"{name}-{seed}-{number}"
        stem.with_suffix(form.suffix).write_bytes(content(name, form, seed, number))
    stem.with_suffix(".txt").write_text(words, encoding="utf-8", errors="replace")
    alike.append(stem.name)
    print(f"{sign} ({stem.name})", flush=True)


def _signature(words: str) -> str:
    """Return in one line what is the same of finds of one cause."""
    lines = [line.strip() for line in words.strip().splitlines() if line.strip()]
    if not words.startswith("Traceback"):
        return lines[0][:100] if lines else ""
    own = [line for line in lines if line.startswith("File") and "counterspin" in line]
    where = own[-1].rpartition("counterspin/")[2].replace('"', "") if own else ""
    return f"{lines[-1].partition(':')[0]} at {where}"


def _save(bag: HuntStatistics, output: Path, seed: int) -> None:
    report = {"seed": seed, "tried": bag.tried, "seconds": round(bag.seconds)}
    report |= {"counts": dict(bag.counts), "finds": bag.finds}
    (output / "report.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
