"""Every format that counterspin reads: files to begin with, how they are changed, who reads them.

- `formats`: all, with the files that they need beside them written to a folder
- `command`: a command of the command line that must not fail without words

To fuzz another format, write a function that returns a `Format` and name it in `FORMATS`.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import re
import shutil
import tomllib
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pypdf
import record_files
import results
import signing_keys
from campaigns import SMALL
from cryptography.hazmat.primitives.asymmetric import ec
from lxml import etree
from reading_descriptions import ACCELEROMETER, format_arm_run, format_rest_run, format_site

import certificates
from counterspin.calibration.findings import judge_result
from counterspin.calibration.pages.document import full_report_blocks
from counterspin.calibration.result import Result
from counterspin.campaign.description import read_campaign
from counterspin.certificates.build import build_document, serialize_document
from counterspin.certificates.issuing import check_certificate
from counterspin.certificates.lab import read_lab
from counterspin.certificates.signature import sign_document, sign_pages
from counterspin.certificates.signers import read_signer
from counterspin.cli import main
from counterspin.correction.apply import apply
from counterspin.errors import RecordError
from counterspin.histories.history import history
from counterspin.ingest.column_roles import guess_file
from counterspin.ingest.contents import read_contents
from counterspin.planning.plan import check as forecast_campaign
from counterspin.planning.plan import plan as make_plan
from counterspin.planning.plan_file import read_plan
from counterspin.planning.stations import read_reading_plan
from counterspin.records.formats import read_numbers, read_table
from counterspin.simulation.simulate import simulate
from counterspin.studies.description import read_study
from counterspin.studies.study import study
from fuzz import ROOT, connections, native, requests
from fuzz.format import Format
from fuzz.mutations import (
    mutate_bytes,
    mutate_sizes,
    mutate_table,
    mutate_text,
    mutate_tree,
    mutate_xml,
    write_json,
    write_toml,
)

# What files begin as


def _tables_of(page: str) -> list[str]:
    """Return the TOML that a page of the documentation shows."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(r"^```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def resource_text(room: str, name: str = "starter.toml") -> str:
    """Return a text that the package carries."""
    return (files(f"counterspin.{room}") / name).read_text(encoding="utf-8")


def _toml_maker(seeds: Sequence[str]) -> Callable[[Random], bytes]:
    trees = [tomllib.loads(text) for text in seeds]

    def make(rng: Random) -> bytes:
        at = rng.randrange(len(seeds))
        kind = rng.random()
        if kind < 0.6:
            return write_toml(mutate_tree(rng, trees[at], trees)).encode("utf-8", "replace")
        if kind < 0.95:
            return mutate_text(rng, seeds[at]).encode("utf-8", "replace")
        return mutate_bytes(rng, seeds[at].encode())

    return make


def _whole(seeds: Sequence[str], use: Callable[[Any], object], place: Path) -> list[str]:
    """Return those that are read without complaint: what is wrong from the start hides the rest."""
    kept = []
    path = place / "seed.toml"
    for text in seeds:
        path.write_text(text, encoding="utf-8")
        with contextlib.suppress(Exception):
            use(path)
            kept.append(text)
    path.unlink()
    return kept


def command(*words: str | Path) -> None:
    """Run a command; AssertionError if it ends with another status than 0, 1 or 2."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = main([str(word) for word in words])
    assert status in (0, 1, 2), status
    text = printed.getvalue()
    assert "internal error" not in text, text
    assert "Traceback" not in text, text


# Documents


def campaign(place: Path) -> Format:
    """Return the description of a campaign."""
    shutil.copy(
        record_files.write_record(place / "slow.csv", record_files.simulate_columns()),
        place / "r.csv",
    )
    texts = [SMALL, resource_text("ingest"), resource_text("reproduction", "paper.toml")]
    texts += [text for page in ("campaign.md", "readings.md") for text in _tables_of(page)]
    texts += [(ROOT / "docs/examples/three-rate/campaign.toml").read_text(encoding="utf-8")]
    texts += [_READING_CAMPAIGN]
    return Format(".toml", _toml_maker(_whole(texts, read_campaign, place)), read_campaign)


#: Runs of a long campaign.
_MANY_RUNS = 10_000


def long_campaign(place: Path) -> Format:
    """Return the description of a campaign of many runs, with a few of them changed."""
    described, mark, after = SMALL.partition("[simulation]")
    head, *runs = described.split("[[runs]]\n")

    def make(rng: Random) -> bytes:
        parts = [rng.choice(runs) for _ in range(_MANY_RUNS)]
        if rng.random() < 0.5:  # names of their own
            parts = [
                re.sub(r'(?m)^name = "[^"]*"', f'name = "run {number}"', part)
                for number, part in enumerate(parts)
            ]
        changed = rng.randrange(_MANY_RUNS)
        parts[changed] = mutate_text(rng, parts[changed])
        text = "[[runs]]\n".join([head, *parts]) + mark + after
        return text.encode("utf-8", "replace")

    return Format(".toml", make, read_campaign)


def calibration(place: Path) -> Format:
    """Return a description beside its records, calibrated."""
    source = place / "source"
    source.mkdir()
    (source / "campaign.toml").write_text(SMALL, encoding="utf-8")
    simulate(source, place, overwrite=True)
    texts = [(place / "campaign.toml").read_text(encoding="utf-8"), SMALL]
    return Format(".toml", _toml_maker(texts), lambda path: command("calibrate", path))


def plan(place: Path) -> Format:
    """Return a plan's file."""
    texts = [resource_text("planning"), *_tables_of("plan.md")]

    def use(path: Path) -> None:
        read_plan(path)

    return Format(".toml", _toml_maker(_whole(texts, use, place)), use)


def reading_plan(place: Path) -> Format:
    """Return a plan of readings."""
    texts = _whole(_tables_of("plan.md"), read_reading_plan, place)
    return Format(".toml", _toml_maker(texts), read_reading_plan)


def study_file(place: Path) -> Format:
    """Return a study's description."""
    texts = [SMALL, resource_text("reproduction", "paper.toml") + STUDY, *_tables_of("study.md")]
    return Format(".toml", _toml_maker(_whole(texts, read_study, place)), read_study)


def sizes(place: Path) -> Format:
    """Return a description of which all is made that needs no records; its sizes are extreme."""
    of_campaign = SMALL.replace("revolutions = 20", "revolutions = 6") + "[study]\ntrials = 4\n"
    plan_text = resource_text("planning").replace("runs = 14", "runs = 2")
    texts = [of_campaign, of_campaign, plan_text, *_whole(_tables_of("plan.md"), make_plan, place)]
    trees = [tomllib.loads(text) for text in texts]
    makers = (
        forecast_campaign,
        lambda path: study(path, trials=4),
        lambda path: simulate(read_campaign(path)),
    )

    def make(rng: Random) -> bytes:
        return write_toml(mutate_sizes(rng, rng.choice(trees))).encode()

    def use(path: Path) -> None:
        content = path.read_bytes()
        if b'"limits"' in content:
            make_plan(path)
        else:
            makers[zlib.crc32(content) % len(makers)](path)

    return Format(".toml", make, use)


def lab(place: Path) -> Format:
    """Return a laboratory's file."""
    given = results.make_qx_result()
    texts = [certificates.LAB, resource_text("certificates")]
    return Format(".toml", _toml_maker(texts), lambda path: read_lab(path, given))


def result_file(place: Path) -> Format:
    """Return a result: read, judged, set as pages, applied, and in a history."""
    trees = [json.loads(text) for text in _result_texts()]
    for tree in trees[1:]:  # or the seal would keep every change from all that comes after it
        tree["seal"] = None
    texts = [json.dumps(tree, indent=1) for tree in trees]

    def make(rng: Random) -> bytes:
        at = rng.randrange(len(trees))
        kind = rng.random()
        if kind < 0.7:
            text = write_json(rng, mutate_tree(rng, trees[at], trees))
        elif kind < 0.95:
            text = mutate_text(rng, texts[at])
        else:
            return mutate_bytes(rng, texts[at].encode())
        return text.encode("utf-8", "surrogatepass" if rng.random() < 0.1 else "replace")

    def use(path: Path) -> None:
        found = judge_result(Result.read(path))
        full_report_blocks(found)
        found.to_json()
        for name in list(found.accelerometers)[:1]:
            with contextlib.suppress(RecordError):
                history([path])
            apply(found, name, np.array([0.1, -1.0, 3.0]))

    return Format(".json", make, use)


def _result_texts() -> list[str]:
    made = [
        results.make_qx_result().to_json(),
        results.make_qx_result(serial_number=None).to_json(),
    ]
    dated = json.loads(made[0])
    dated["details"] = {"date": "2026-03-01", "serial_number": "C-7"}
    frozen = [
        json.loads(path.read_text("utf-8"))
        for path in (ROOT / "tests/frozen").glob("schema-*.json")
    ]
    for tree in frozen:  # their traces are long, and all of one kind
        for part in tree["accelerometers"].values():
            part["traces"] = dict(list(part.get("traces", {}).items())[:0])
    return [*made, json.dumps(dated), *map(json.dumps, frozen)]


def history_folder(place: Path) -> Format:
    """Return a file of a folder with results, for the command."""
    inside = place / "results"
    inside.mkdir()
    results.make_qx_result().write(inside / "good.json")
    made = result_file(place).make
    names = ["b.json", ".b.json", "c.JSON", "n\x1b[31m.json", "sub.json", "\u202egood.json"]

    def use(path: Path) -> None:
        content = path.read_bytes()
        other = inside / names[len(content) % len(names)]
        other.write_bytes(content)
        try:
            command("history", inside)
        finally:
            other.unlink()

    return Format(".json", made, use)


def certificate_file(place: Path) -> Format:
    """Return a certificate's XML."""
    whole = certificates.make_document(place, results.make_qx_result())
    root = etree.fromstring(whole)

    def make(rng: Random) -> bytes:
        kind = rng.random()
        if kind < 0.7:
            return mutate_xml(rng, root)
        if kind < 0.9:
            return mutate_text(rng, whole.decode()).encode("utf-8", "replace")
        return mutate_bytes(rng, whole)

    return Format(".xml", make, check_certificate)


def signed_certificate(place: Path) -> Format:
    """Return a signed certificate's XML, verified."""
    key, cert = signing_keys.write_pair(place / "k", ec.generate_private_key(ec.SECP256R1()))
    given = results.make_qx_result()
    lab_read = certificates.read_lab_for(place, given)
    plain = build_document(given, lab_read, certificates.ISSUE, {}, b"%PDF-1.7")
    whole = serialize_document(sign_document(plain, read_signer(key, cert)))
    root = etree.fromstring(whole)

    def make(rng: Random) -> bytes:
        kind = rng.random()
        if kind < 0.4:
            return mutate_xml(rng, root)
        if kind < 0.7:  # the signature alone, which is the last element
            changed = etree.fromstring(whole)
            changed[-1] = etree.fromstring(mutate_xml(rng, root[-1]))
            return etree.tostring(changed)
        return mutate_text(rng, whole.decode()).encode("utf-8", "replace")

    true = repr(check_certificate(_written(place, whole), signer_certificate=cert).numbers)

    def use(path: Path) -> None:
        # What passes for signed has the numbers that were signed.
        assert repr(check_certificate(path, signer_certificate=cert).numbers) == true

    return Format(".xml", make, use)


def _written(place: Path, content: bytes) -> Path:
    path = place / "whole.xml"
    path.write_bytes(content)
    return path


def certificate_pdf(place: Path) -> Format:
    """Return a certificate's PDF."""
    writer = pypdf.PdfWriter()
    writer.add_blank_page(100, 100)
    writer.add_attachment("c.xml", certificates.make_document(place, results.make_qx_result()))
    file = io.BytesIO()
    writer.write(file)
    small = file.getvalue()
    made = (ROOT / "docs/examples/three-rate/certificate.pdf").read_bytes()

    def make(rng: Random) -> bytes:
        if rng.random() < 0.6:
            return native.damaged(rng, small, None)
        end = len(made)
        return native.damaged(rng, made, rng.choice(((end - 9000, end), (0, end))))

    return Format(".pdf", make, check_certificate)


def signed_pdf(place: Path) -> Format:
    """Return a certificate's PDF whose XML and pages are signed, verified."""
    key, cert = signing_keys.write_pair(place / "k", ec.generate_private_key(ec.SECP256R1()))
    signer, given = read_signer(key, cert), results.make_qx_result()
    lab_read = certificates.read_lab_for(place, given)
    xml = serialize_document(
        sign_document(build_document(given, lab_read, certificates.ISSUE, {}, b"%PDF-1.7"), signer)
    )
    writer = pypdf.PdfWriter()
    writer.add_blank_page(100, 100)
    writer.add_attachment("c.xml", xml)
    writer.generate_file_identifiers()
    file = io.BytesIO()
    writer.write(file)
    plain = file.getvalue()
    whole = sign_pages(plain, signer, certificates.ISSUE.date)
    begin = whole.index(b"/Contents <", len(plain)) + 11
    end = whole.index(b">", begin)
    (place / "whole.pdf").write_bytes(whole)
    true = repr(check_certificate(place / "whole.pdf", signer_certificate=cert).numbers)

    def make(rng: Random) -> bytes:
        where = rng.choice((None, (len(plain), len(whole)), (begin, end)))
        return native.damaged(rng, whole, where)

    def use(path: Path) -> None:
        found, content = check_certificate(path, signer_certificate=cert), path.read_bytes()
        assert repr(found.numbers) == true
        if found.pages == "valid":
            # Not a byte differs but those of the signature itself.
            assert content[:begin] == whole[:begin]
            assert content[end:] == whole[end:]

    return Format(".pdf", make, use)


# Tables

_READING_CAMPAIGN = "".join(
    (
        format_site("1.0 ± 1e-3 m"),
        ACCELEROMETER,
        format_rest_run("tumble 30", "30 ± 0.001 deg about north", "1.082532 ± 2e-6 mA"),
        format_arm_run("in", "9.9 rad/s", "12.5 ± 2e-6 mA", pendulous="up", mounting="in"),
        'temperature = "23.4 degC"\n',
    )
)

#: Makes the paper's plan a study.
STUDY = """
[study]
seed = 3
[study.analyses.exact]
method = "two-stage"
sigma = "residuals"
"""

_READING_COLUMNS = ("name", "motion", "rate", "attitude", "reading", "u", "temperature", "time")


def _reading_rows() -> list[list[str]]:
    rows = [["name", "motion", "rate", "deg", "mA", "u", "degC", "s"]]
    for i in range(12):
        value = 1.25 * math.cos(math.radians(30 * i))
        rows.append(
            [
                f"p{i}",
                "static",
                "0",
                str(30 * i),
                repr(value),
                "2e-6",
                f"{20 + i / 10}",
                str(60 * i),
            ]
        )
    return rows


def readings_campaign(place: Path, suffix: str) -> Callable[[Path], object]:
    """Return what reads a table of readings: the campaign that names it."""
    columns = ", ".join(
        f'{key} = "{name}"' for key, name in zip(_READING_COLUMNS, _reading_rows()[0], strict=True)
    )
    head = _READING_CAMPAIGN.partition("[[runs]]")[0]
    text = f'{head}[readings]\nfile = "case{suffix}"\ncolumns = {{ {columns} }}\n'
    (place / "campaign.toml").write_text(text, encoding="utf-8")

    def use(_: Path) -> None:
        read_campaign(place)
        command("calibrate", place)

    return use


def readings_csv(place: Path) -> Format:
    """Return a table of readings as CSV."""
    rows = _reading_rows()
    use = readings_campaign(place, ".csv")
    return Format(".csv", lambda rng: mutate_table(rng, rows), use)


def readings_parquet(place: Path) -> Format:
    """Return a table of readings as Parquet."""
    rows = _reading_rows()
    use = readings_campaign(place, ".parquet")
    return Format(".parquet", lambda rng: native.readings(rng, rows), use)


def readings_excel(place: Path) -> Format:
    """Return a table of readings as Excel writes it."""
    rows = _reading_rows()
    use = readings_campaign(place, ".xlsx")
    return Format(".xlsx", lambda rng: native.workbook(rng, rows), use)


def record_csv(place: Path) -> Format:
    """Return a record as CSV."""
    rows = [
        line.split(",") for line in record_files.format_lines(record_files.simulate_columns(n=330))
    ]
    return Format(".csv", lambda rng: mutate_table(rng, rows), read_record)


def record_export(place: Path) -> Format:
    """Return a record as a recorder exports it: lines before the names, commas in numbers."""
    rows = [
        line.split(",") for line in record_files.format_lines(record_files.simulate_columns(n=330))
    ]
    commas = bytes.maketrans(b",.", b";,")

    def make(rng: Random) -> bytes:
        about = rng.choice(("", "Messung\tä\n", "a;1\n\n", "s;rad;m\n")).encode("latin-1")
        content = about + mutate_table(rng, rows).translate(commas)
        return mutate_bytes(rng, content) if rng.random() < 0.3 else content

    def use(path: Path) -> None:
        guess_file(read_contents(path))
        read_record(path)

    return Format(".csv", make, use)


def read_record(path: Path) -> None:
    """Read a record as a calibration does, and as a table."""
    failed = None
    try:
        record_files.read_written_record(path)
    except RecordError as error:
        failed = error
    if len(path.read_bytes()) % 4 == 0:  # some of them, in the two other ways
        read_table(path)
        read_numbers(path, [record_files.TIME, record_files.SIGNAL])
    if failed is not None:
        raise failed


def record_excel(place: Path) -> Format:
    """Return a record as Excel writes it."""
    rows = [
        line.split(",") for line in record_files.format_lines(record_files.simulate_columns(n=330))
    ]
    return Format(".xlsx", lambda rng: native.workbook(rng, rows), read_record)


def _native(suffix: str, make: Callable[[Random], bytes]) -> Callable[[Path], Format]:
    return lambda place: Format(suffix, make, read_record)


# A study's folder


def study_progress(place: Path) -> Format:
    """Return what a begun study has kept, resumed."""
    (place / "campaign.toml").write_text(
        resource_text("reproduction", "paper.toml") + STUDY, encoding="utf-8"
    )
    out = place / "out"
    begun = {}

    def stop(done: int, _: int) -> None:
        if done:
            raise KeyboardInterrupt

    from counterspin.studies import batch_runner
    from counterspin.studies.folder import StudyFolder

    before, batch_runner._TASK_DURATION = batch_runner._TASK_DURATION, 0.0
    study(place, trials=20_000, output=StudyFolder(out, keep_trials=True), progress=stop)
    batch_runner._TASK_DURATION = before
    for file in out.rglob("*"):
        if file.is_file():
            begun[file.relative_to(out)] = file.read_bytes()
    whole = begun[Path("progress.npz")]

    def use(path: Path) -> None:
        shutil.rmtree(out)
        for name, content in begun.items():
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (out / name).write_bytes(content)
        content = path.read_bytes()
        parts = [name for name in begun if name.parent.name == "progress"]
        target = Path("progress.npz") if len(content) % 2 or not parts else parts[0]
        (out / target).write_bytes(content)
        command("study", place, "--trials", "20000", "-o", out, "--resume", "--keep-trials")

    def make(rng: Random) -> bytes:
        return native.numpy_archive(rng, whole)

    return Format(".npz", make, use)


@dataclass(frozen=True)
class Entry:
    """A row of the table of formats.

    Attributes
    ----------
    begin
        Makes the format, with the files that it needs beside it in a folder of its own.
    share
        How many of its cases are tried among those of all formats of its kind.
    native
        Whether native code reads it, in the reader's process.
    """

    begin: Callable[[Path], Format]
    share: float = 1.0
    native: bool = False


FORMATS: dict[str, Entry] = {
    "campaign": Entry(campaign, 3.0),
    "campaign-long": Entry(long_campaign, 0.02),
    "calibration": Entry(calibration, 0.03),
    "plan": Entry(plan),
    "reading-plan": Entry(reading_plan),
    "study": Entry(study_file),
    "sizes": Entry(sizes, 0.02),
    "study-progress": Entry(study_progress, 0.002),
    "lab": Entry(lab, 1.5),
    "result": Entry(result_file, 3.0),
    "history": Entry(history_folder, 0.1),
    "certificate": Entry(certificate_file),
    "certificate-signed": Entry(signed_certificate, 0.2),
    "readings-csv": Entry(readings_csv),
    "record-csv": Entry(record_csv, 0.6),
    "record-export": Entry(record_export, 0.4),
    "requests": Entry(requests.application, 0.3),
    "connections": Entry(connections.connections, 0.1),
    "certificate-pdf": Entry(certificate_pdf, 0.5, native=True),
    "certificate-pdf-signed": Entry(signed_pdf, 0.2, native=True),
    "readings-parquet": Entry(readings_parquet, native=True),
    "readings-excel": Entry(readings_excel, native=True),
    "record-parquet": Entry(_native(".parquet", native.parquet), 3.0, native=True),
    "record-mat5": Entry(_native(".mat", native.mat5), native=True),
    "record-mat73": Entry(_native(".mat", native.mat73), native=True),
    "record-hdf5": Entry(_native(".h5", native.hdf5), native=True),
    "record-tdms": Entry(_native(".tdms", native.tdms), native=True),
    "record-excel": Entry(record_excel, 0.5, native=True),
}


def formats(place: Path, names: Sequence[str] = tuple(FORMATS)) -> dict[str, Format]:
    """Return formats by name, each with a folder of its own below `place`."""
    made = {}
    for name in names:
        (place / name).mkdir(parents=True)
        made[name] = FORMATS[name].begin(place / name)
    return made
