"""Input formats of counterspin: seed files, mutations and readers.

- `FORMATS`: table of all formats; `make_formats`: make formats and the other files they need
- `run_command`: run a command that must not fail without a message

To fuzz another format, write a function that returns a `Format`, and add it to `FORMATS`.
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

# Seed files


def read_toml_blocks(page: str) -> list[str]:
    """Return the TOML code blocks of a page of the documentation."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(r"^```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def resource_text(package: str, name: str = "starter.toml") -> str:
    """Return the text of a resource file of a package."""
    return (files(f"counterspin.{package}") / name).read_text(encoding="utf-8")


def _toml_drawer(seeds: Sequence[str]) -> Callable[[Random], bytes]:
    trees = [tomllib.loads(text) for text in seeds]

    def draw(rng: Random) -> bytes:
        index = rng.randrange(len(seeds))
        choice = rng.random()
        if choice < 0.6:
            return write_toml(mutate_tree(rng, trees[index], trees)).encode("utf-8", "replace")
        if choice < 0.95:
            return mutate_text(rng, seeds[index]).encode("utf-8", "replace")
        return mutate_bytes(rng, seeds[index].encode())

    return draw


def _select_valid(seeds: Sequence[str], read: Callable[[Any], object], folder: Path) -> list[str]:
    """Return the seeds that are read without an error, which would hide the effect of mutations."""
    valid = []
    path = folder / "seed.toml"
    for text in seeds:
        path.write_text(text, encoding="utf-8")
        with contextlib.suppress(Exception):
            read(path)
            valid.append(text)
    path.unlink()
    return valid


def run_command(*arguments: str | Path) -> None:
    """Run a command; raise AssertionError for an internal error."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        status = main([str(argument) for argument in arguments])
    assert status in (0, 1, 2), status
    text = output.getvalue()
    assert "internal error" not in text, text
    assert "Traceback" not in text, text


# Documents


def campaign_format(folder: Path) -> Format:
    """Return the format of campaign descriptions."""
    shutil.copy(
        record_files.write_record(folder / "slow.csv", record_files.simulate_columns()),
        folder / "r.csv",
    )
    texts = [SMALL, resource_text("ingest"), resource_text("reproduction", "paper.toml")]
    texts += [text for page in ("campaign.md", "readings.md") for text in read_toml_blocks(page)]
    texts += [(ROOT / "docs/examples/three-rate/campaign.toml").read_text(encoding="utf-8")]
    texts += [_READING_CAMPAIGN]
    return Format(".toml", _toml_drawer(_select_valid(texts, read_campaign, folder)), read_campaign)


#: Number of runs of a long campaign.
_N_LONG_CAMPAIGN_RUNS = 10_000


def long_campaign_format(folder: Path) -> Format:
    """Return the format of campaigns of many runs, with one mutated run."""
    description, header, after = SMALL.partition("[simulation]")
    head, *runs = description.split("[[runs]]\n")

    def draw(rng: Random) -> bytes:
        run_sections = [rng.choice(runs) for _ in range(_N_LONG_CAMPAIGN_RUNS)]
        if rng.random() < 0.5:  # unique names
            run_sections = [
                re.sub(r'(?m)^name = "[^"]*"', f'name = "run {number}"', section)
                for number, section in enumerate(run_sections)
            ]
        index = rng.randrange(_N_LONG_CAMPAIGN_RUNS)
        run_sections[index] = mutate_text(rng, run_sections[index])
        text = "[[runs]]\n".join([head, *run_sections]) + header + after
        return text.encode("utf-8", "replace")

    return Format(".toml", draw, read_campaign)


def calibration_format(folder: Path) -> Format:
    """Return the format of campaign descriptions with records, which are calibrated."""
    source = folder / "source"
    source.mkdir()
    (source / "campaign.toml").write_text(SMALL, encoding="utf-8")
    simulate(source, folder, overwrite=True)
    texts = [(folder / "campaign.toml").read_text(encoding="utf-8"), SMALL]
    return Format(".toml", _toml_drawer(texts), lambda path: run_command("calibrate", path))


def plan_format(folder: Path) -> Format:
    """Return the format of plans of runs."""
    texts = [resource_text("planning"), *read_toml_blocks("plan.md")]

    def read(path: Path) -> None:
        read_plan(path)

    return Format(".toml", _toml_drawer(_select_valid(texts, read, folder)), read)


def reading_plan_format(folder: Path) -> Format:
    """Return the format of plans of readings."""
    texts = _select_valid(read_toml_blocks("plan.md"), read_reading_plan, folder)
    return Format(".toml", _toml_drawer(texts), read_reading_plan)


def study_format(folder: Path) -> Format:
    """Return the format of study descriptions."""
    texts = [
        SMALL,
        resource_text("reproduction", "paper.toml") + STUDY,
        *read_toml_blocks("study.md"),
    ]
    return Format(".toml", _toml_drawer(_select_valid(texts, read_study, folder)), read_study)


def sizes_format(folder: Path) -> Format:
    """Return the format of descriptions with extreme sizes: simulated, studied or planned."""
    campaign_text = SMALL.replace("revolutions = 20", "revolutions = 6") + "[study]\ntrials = 4\n"
    plan_text = resource_text("planning").replace("runs = 14", "runs = 2")
    texts = [
        campaign_text,
        campaign_text,
        plan_text,
        *_select_valid(read_toml_blocks("plan.md"), make_plan, folder),
    ]
    trees = [tomllib.loads(text) for text in texts]
    readers = (
        forecast_campaign,
        lambda path: study(path, trials=4),
        lambda path: simulate(read_campaign(path)),
    )

    def draw(rng: Random) -> bytes:
        return write_toml(mutate_sizes(rng, rng.choice(trees))).encode()

    def read(path: Path) -> None:
        content = path.read_bytes()
        if b'"limits"' in content:
            make_plan(path)
        else:
            readers[zlib.crc32(content) % len(readers)](path)

    return Format(".toml", draw, read)


def lab_format(folder: Path) -> Format:
    """Return the format of laboratory files."""
    result = results.make_qx_result()
    texts = [certificates.LAB, resource_text("certificates")]
    return Format(".toml", _toml_drawer(texts), lambda path: read_lab(path, result))


def result_format(folder: Path) -> Format:
    """Return the format of results: read, judged, reported, applied, and in a history."""
    trees = [json.loads(text) for text in _make_result_texts()]
    for tree in trees[1:]:  # otherwise the seal would reject every mutation
        tree["seal"] = None
    texts = [json.dumps(tree, indent=1) for tree in trees]

    def draw(rng: Random) -> bytes:
        index = rng.randrange(len(trees))
        choice = rng.random()
        if choice < 0.7:
            text = write_json(rng, mutate_tree(rng, trees[index], trees))
        elif choice < 0.95:
            text = mutate_text(rng, texts[index])
        else:
            return mutate_bytes(rng, texts[index].encode())
        return text.encode("utf-8", "surrogatepass" if rng.random() < 0.1 else "replace")

    def read(path: Path) -> None:
        result = judge_result(Result.read(path))
        full_report_blocks(result)
        result.to_json()
        for name in list(result.accelerometers)[:1]:
            with contextlib.suppress(RecordError):
                history([path])
            apply(result, name, np.array([0.1, -1.0, 3.0]))

    return Format(".json", draw, read)


def _make_result_texts() -> list[str]:
    texts = [
        results.make_qx_result().to_json(),
        results.make_qx_result(serial_number=None).to_json(),
    ]
    dated = json.loads(texts[0])
    dated["details"] = {"date": "2026-03-01", "serial_number": "C-7"}
    frozen_trees = [
        json.loads(path.read_text("utf-8"))
        for path in (ROOT / "tests/frozen").glob("schema-*.json")
    ]
    for tree in frozen_trees:  # remove the traces, which are long and uniform
        for accelerometer in tree["accelerometers"].values():
            accelerometer["traces"] = dict(list(accelerometer.get("traces", {}).items())[:0])
    return [*texts, json.dumps(dated), *map(json.dumps, frozen_trees)]


def history_format(folder: Path) -> Format:
    """Return the format of results in a folder, for the history command."""
    results_folder = folder / "results"
    results_folder.mkdir()
    results.make_qx_result().write(results_folder / "good.json")
    draw = result_format(folder).draw
    names = ["b.json", ".b.json", "c.JSON", "n\x1b[31m.json", "sub.json", "\u202egood.json"]

    def read(path: Path) -> None:
        content = path.read_bytes()
        mutated_file = results_folder / names[len(content) % len(names)]
        mutated_file.write_bytes(content)
        try:
            run_command("history", results_folder)
        finally:
            mutated_file.unlink()

    return Format(".json", draw, read)


def certificate_format(folder: Path) -> Format:
    """Return the format of certificate XML files."""
    xml = certificates.make_document(folder, results.make_qx_result())
    root = etree.fromstring(xml)

    def draw(rng: Random) -> bytes:
        choice = rng.random()
        if choice < 0.7:
            return mutate_xml(rng, root)
        if choice < 0.9:
            return mutate_text(rng, xml.decode()).encode("utf-8", "replace")
        return mutate_bytes(rng, xml)

    return Format(".xml", draw, check_certificate)


def signed_certificate_format(folder: Path) -> Format:
    """Return the format of signed certificate XML files, which are verified."""
    key, cert = signing_keys.write_pair(folder / "k", ec.generate_private_key(ec.SECP256R1()))
    result = results.make_qx_result()
    lab = certificates.read_lab_for(folder, result)
    unsigned = build_document(result, lab, certificates.ISSUE, {}, b"%PDF-1.7")
    xml = serialize_document(sign_document(unsigned, read_signer(key, cert)))
    root = etree.fromstring(xml)

    def draw(rng: Random) -> bytes:
        choice = rng.random()
        if choice < 0.4:
            return mutate_xml(rng, root)
        if choice < 0.7:  # only the signature, which is the last element
            mutated = etree.fromstring(xml)
            mutated[-1] = etree.fromstring(mutate_xml(rng, root[-1]))
            return etree.tostring(mutated)
        return mutate_text(rng, xml.decode()).encode("utf-8", "replace")

    signed_numbers = repr(
        check_certificate(_write_certificate(folder, xml), signer_certificate=cert).numbers
    )

    def read(path: Path) -> None:
        # A file with a valid signature contains the signed numbers.
        assert repr(check_certificate(path, signer_certificate=cert).numbers) == signed_numbers

    return Format(".xml", draw, read)


def _write_certificate(folder: Path, content: bytes) -> Path:
    path = folder / "whole.xml"
    path.write_bytes(content)
    return path


def certificate_pdf_format(folder: Path) -> Format:
    """Return the format of certificate PDF files."""
    writer = pypdf.PdfWriter()
    writer.add_blank_page(100, 100)
    writer.add_attachment("c.xml", certificates.make_document(folder, results.make_qx_result()))
    file = io.BytesIO()
    writer.write(file)
    small_pdf = file.getvalue()
    example_pdf = (ROOT / "docs/examples/three-rate/certificate.pdf").read_bytes()

    def draw(rng: Random) -> bytes:
        if rng.random() < 0.6:
            return native.damage(rng, small_pdf, None)
        end = len(example_pdf)
        return native.damage(rng, example_pdf, rng.choice(((end - 9000, end), (0, end))))

    return Format(".pdf", draw, check_certificate)


def signed_pdf_format(folder: Path) -> Format:
    """Return the format of certificate PDF files with signed XML and pages, which are verified."""
    key, cert = signing_keys.write_pair(folder / "k", ec.generate_private_key(ec.SECP256R1()))
    signer, result = read_signer(key, cert), results.make_qx_result()
    lab = certificates.read_lab_for(folder, result)
    xml = serialize_document(
        sign_document(build_document(result, lab, certificates.ISSUE, {}, b"%PDF-1.7"), signer)
    )
    writer = pypdf.PdfWriter()
    writer.add_blank_page(100, 100)
    writer.add_attachment("c.xml", xml)
    writer.generate_file_identifiers()
    file = io.BytesIO()
    writer.write(file)
    unsigned_pdf = file.getvalue()
    signed_pdf = sign_pages(unsigned_pdf, signer, certificates.ISSUE.date)
    signature_start = signed_pdf.index(b"/Contents <", len(unsigned_pdf)) + 11
    signature_end = signed_pdf.index(b">", signature_start)
    (folder / "whole.pdf").write_bytes(signed_pdf)
    signed_numbers = repr(check_certificate(folder / "whole.pdf", signer_certificate=cert).numbers)

    def draw(rng: Random) -> bytes:
        byte_range = rng.choice(
            (None, (len(unsigned_pdf), len(signed_pdf)), (signature_start, signature_end))
        )
        return native.damage(rng, signed_pdf, byte_range)

    def read(path: Path) -> None:
        check, content = check_certificate(path, signer_certificate=cert), path.read_bytes()
        assert repr(check.numbers) == signed_numbers
        if check.pages == "valid":
            # All bytes except the signature itself are unchanged.
            assert content[:signature_start] == signed_pdf[:signature_start]
            assert content[signature_end:] == signed_pdf[signature_end:]

    return Format(".pdf", draw, read)


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

#: Section that turns the paper's plan into a study.
STUDY = """
[study]
seed = 3
[study.analyses.exact]
method = "two-stage"
sigma = "residuals"
"""

_READING_COLUMNS = ("name", "motion", "rate", "attitude", "reading", "u", "temperature", "time")


def _make_reading_rows() -> list[list[str]]:
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


def make_readings_reader(folder: Path, suffix: str) -> Callable[[Path], object]:
    """Write a campaign that names a table of readings; return the function that reads it."""
    columns = ", ".join(
        f'{key} = "{name}"'
        for key, name in zip(_READING_COLUMNS, _make_reading_rows()[0], strict=True)
    )
    head = _READING_CAMPAIGN.partition("[[runs]]")[0]
    text = f'{head}[readings]\nfile = "case{suffix}"\ncolumns = {{ {columns} }}\n'
    (folder / "campaign.toml").write_text(text, encoding="utf-8")

    def read(_: Path) -> None:
        read_campaign(folder)
        run_command("calibrate", folder)

    return read


def readings_csv_format(folder: Path) -> Format:
    """Return the format of CSV tables of readings."""
    rows = _make_reading_rows()
    read = make_readings_reader(folder, ".csv")
    return Format(".csv", lambda rng: mutate_table(rng, rows), read)


def readings_parquet_format(folder: Path) -> Format:
    """Return the format of Parquet tables of readings."""
    rows = _make_reading_rows()
    read = make_readings_reader(folder, ".parquet")
    return Format(".parquet", lambda rng: native.draw_readings(rng, rows), read)


def readings_excel_format(folder: Path) -> Format:
    """Return the format of Excel tables of readings."""
    rows = _make_reading_rows()
    read = make_readings_reader(folder, ".xlsx")
    return Format(".xlsx", lambda rng: native.draw_workbook(rng, rows), read)


def record_csv_format(folder: Path) -> Format:
    """Return the format of CSV records."""
    rows = [
        line.split(",") for line in record_files.format_lines(record_files.simulate_columns(n=330))
    ]
    return Format(".csv", lambda rng: mutate_table(rng, rows), read_record)


def record_export_format(folder: Path) -> Format:
    """Return the format of recorder exports: with a preamble and decimal commas."""
    rows = [
        line.split(",") for line in record_files.format_lines(record_files.simulate_columns(n=330))
    ]
    commas = bytes.maketrans(b",.", b";,")

    def draw(rng: Random) -> bytes:
        preamble = rng.choice(("", "Messung\tä\n", "a;1\n\n", "s;rad;m\n")).encode("latin-1")
        content = preamble + mutate_table(rng, rows).translate(commas)
        return mutate_bytes(rng, content) if rng.random() < 0.3 else content

    def read(path: Path) -> None:
        guess_file(read_contents(path))
        read_record(path)

    return Format(".csv", draw, read)


def read_record(path: Path) -> None:
    """Read a record as in a calibration, and some records also as a table."""
    record_error = None
    try:
        record_files.read_written_record(path)
    except RecordError as error:
        record_error = error
    if len(path.read_bytes()) % 4 == 0:
        read_table(path)
        read_numbers(path, [record_files.TIME, record_files.SIGNAL])
    if record_error is not None:
        raise record_error


def record_excel_format(folder: Path) -> Format:
    """Return the format of Excel records."""
    rows = [
        line.split(",") for line in record_files.format_lines(record_files.simulate_columns(n=330))
    ]
    return Format(".xlsx", lambda rng: native.draw_workbook(rng, rows), read_record)


def _native_record_format(suffix: str, draw: Callable[[Random], bytes]) -> Callable[[Path], Format]:
    return lambda folder: Format(suffix, draw, read_record)


# Folder of a study


def study_progress_format(folder: Path) -> Format:
    """Return the format of the saved progress of a study, which is resumed."""
    (folder / "campaign.toml").write_text(
        resource_text("reproduction", "paper.toml") + STUDY, encoding="utf-8"
    )
    out = folder / "out"
    saved_files = {}

    def stop(n_done: int, _: int) -> None:
        if n_done:
            raise KeyboardInterrupt

    from counterspin.studies import batch_runner
    from counterspin.studies.folder import StudyFolder

    task_duration, batch_runner._TASK_DURATION = batch_runner._TASK_DURATION, 0.0
    study(folder, trials=20_000, output=StudyFolder(out, keep_trials=True), progress=stop)
    batch_runner._TASK_DURATION = task_duration
    for file in out.rglob("*"):
        if file.is_file():
            saved_files[file.relative_to(out)] = file.read_bytes()
    archive = saved_files[Path("progress.npz")]

    def read(path: Path) -> None:
        shutil.rmtree(out)
        for name, content in saved_files.items():
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (out / name).write_bytes(content)
        content = path.read_bytes()
        progress_files = [name for name in saved_files if name.parent.name == "progress"]
        target = (
            Path("progress.npz") if len(content) % 2 or not progress_files else progress_files[0]
        )
        (out / target).write_bytes(content)
        run_command("study", folder, "--trials", "20000", "-o", out, "--resume", "--keep-trials")

    def draw(rng: Random) -> bytes:
        return native.draw_numpy_archive(rng, archive)

    return Format(".npz", draw, read)


@dataclass(frozen=True)
class FormatEntry:
    """A row of the table of formats.

    Attributes
    ----------
    make
        Function that makes the format, and writes the other files that it needs into a folder.
    share
        Relative frequency of its cases, among formats with the same `native`.
    native
        Whether native code reads it.
    """

    make: Callable[[Path], Format]
    share: float = 1.0
    native: bool = False


FORMATS: dict[str, FormatEntry] = {
    "campaign": FormatEntry(campaign_format, 3.0),
    "campaign-long": FormatEntry(long_campaign_format, 0.02),
    "calibration": FormatEntry(calibration_format, 0.03),
    "plan": FormatEntry(plan_format),
    "reading-plan": FormatEntry(reading_plan_format),
    "study": FormatEntry(study_format),
    "sizes": FormatEntry(sizes_format, 0.02),
    "study-progress": FormatEntry(study_progress_format, 0.002),
    "lab": FormatEntry(lab_format, 1.5),
    "result": FormatEntry(result_format, 3.0),
    "history": FormatEntry(history_format, 0.1),
    "certificate": FormatEntry(certificate_format),
    "certificate-signed": FormatEntry(signed_certificate_format, 0.2),
    "readings-csv": FormatEntry(readings_csv_format),
    "record-csv": FormatEntry(record_csv_format, 0.6),
    "record-export": FormatEntry(record_export_format, 0.4),
    "requests": FormatEntry(requests.requests_format, 0.3),
    "connections": FormatEntry(connections.connections_format, 0.1),
    "certificate-pdf": FormatEntry(certificate_pdf_format, 0.5, native=True),
    "certificate-pdf-signed": FormatEntry(signed_pdf_format, 0.2, native=True),
    "readings-parquet": FormatEntry(readings_parquet_format, native=True),
    "readings-excel": FormatEntry(readings_excel_format, native=True),
    "record-parquet": FormatEntry(
        _native_record_format(".parquet", native.draw_parquet), 3.0, native=True
    ),
    "record-mat5": FormatEntry(_native_record_format(".mat", native.draw_mat5), native=True),
    "record-mat73": FormatEntry(_native_record_format(".mat", native.draw_mat73), native=True),
    "record-hdf5": FormatEntry(_native_record_format(".h5", native.draw_hdf5), native=True),
    "record-tdms": FormatEntry(_native_record_format(".tdms", native.draw_tdms), native=True),
    "record-excel": FormatEntry(record_excel_format, 0.5, native=True),
}


def make_formats(folder: Path, names: Sequence[str] = tuple(FORMATS)) -> dict[str, Format]:
    """Return name -> format; each format has its own subfolder of `folder`."""
    formats = {}
    for name in names:
        (folder / name).mkdir(parents=True)
        formats[name] = FORMATS[name].make(folder / name)
    return formats
