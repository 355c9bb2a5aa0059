"""User effort from recorder files to a signed certificate: clicks, fields and time.

Count the clicks, fields and letters of the user and the words to read. The time is the time that a
user needs for them plus the run time of the program. The laboratory form is filled in once, for the
first certificate; its effort is counted separately and included in the time.
"""

import re

import numpy as np
import polars as pl
import pytest
from chromium import needs_chromium
from cryptography.hazmat.primitives.asymmetric import ec
from exports import RUNS, simulate_campaign
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat
from served import find_answer_field
from signing_keys import write_pkcs12
from workbooks import write_workbook

from certificates import write_filled_template
from counterspin.calibration.result import read_result
from counterspin.certificates.issuing import check_certificate

pytestmark = needs_chromium

#: Limits: five minutes for the user, including half a minute of run time.
MOST_CLICKS, MOST_FIELDS, MOST_SECONDS = 10, 8, 270.0

#: 60 words a minute, five letters each; to point and press, and to think before a field: Card,
#: Moran and Newell, The keystroke-level model, Comm. ACM 23 (1980) 396.
SECONDS_A_LETTER, SECONDS_A_CLICK, SECONDS_A_FIELD = 0.2, 1.3, 2.7

#: Silent reading: Brysbaert, How many words do we read per minute?, J. Mem. Lang. 109 (2019).
WORDS_A_MINUTE = 238.0

#: Fields of the laboratory's form that a first certificate needs.
LABORATORY = {
    "certificate.begin": "2026-01-12",
    "certificate.end": "2026-01-14",
    "certificate.traceability": "Radius by interferometer (certificate 17), time by standard 18.",
    "laboratory.name": "Bench Calibration",
    "laboratory.city": "Turin",
    "laboratory.country": "IT",
    "customer.name": "Inertial Works",
    "customer.city": "Lyon",
    "customer.country": "FR",
    "item.name": "accelerometer",
    "item.manufacturer": "Inertial Works",
    "item.model": "Q2",
    "item.serial_number": "1017",
    "persons[0].name": "A. Person",
    "persons[0].role": "Head of calibration",
    "conditions.temperature": "20.0 ± 0.3",
    "evidence.all": "Type test 4714.",
}

#: Start of a question that the files do not answer -> the answer of the user.
KNOWN = {
    "Which sheet contains the table": "all",
    "Local gravity": "9.8066 m/s^2",
    "Latitude": "45.75 deg",
    "Radius": "2.5 ± 1e-5 m",
    "Sense of rotation": "counterclockwise",
    "How many samples a second": "20 Hz",
    "Which column contains the time": "column 1",
    "Which column contains the spindle angle": "column 2",
    "What is the unit of the time column": "s",
    "What is the unit of the angle column": "rad",
    "What does column": "displacement",
    "What is the unit of column": "m",
    "Along which axis": "east",
}


def write_labview(frames, folder):
    """Write LabVIEW measurement files with a header, decimal commas and Windows line ends."""
    for name, frame in frames.items():
        lines = [
            "LabVIEW Measurement\t",
            "Separator\tTab",
            "***End_of_Header***\t",
            "Channels\t2",
            "Y_Unit_Label\trad\tm",
            "X_Dimension\tTime\tTime",
            "Delta_X\t0,05\t0,05",
            "***End_of_Header***\t\t",
            "X_Value\tAngle\tEast\tComment",
        ]
        lines += ["\t".join([repr(x).replace(".", ",") for x in row]) for row in frame.rows()]
        (folder / f"{name}.lvm").write_text("\r\n".join(lines) + "\r\n", encoding="latin-1")


def write_excel(frames, folder):
    """Write a workbook with a sheet for each run, with title and units above the numbers.

    The name of the axis is wrong, as after a change of cables, and is used for detection.
    """
    write_workbook(
        folder / "book.xlsx",
        {
            name: [
                ["Run", name, None],
                [*frame.columns[:-1], "north_m"],
                ["s", "rad", "m"],
                *map(list, frame.rows()),
            ]
            for name, frame in frames.items()
        },
    )


def write_matlab(frames, folder):
    """Write structs with a matrix of two columns."""
    for name, frame in frames.items():
        t, angle, east = frame.to_numpy().T
        fields = {"t": t, "pos": np.column_stack([angle, east]), "fs": 20.0}
        savemat(folder / f"{name}.mat", {"rec": fields})


def write_tdms(frames, folder):
    """Write waveforms, which have a step and no column of time."""
    for name, frame in frames.items():
        step = {"wf_increment": 0.05, "wf_start_offset": 0.0}
        channels = [
            ChannelObject("Run", column, frame[column].to_numpy(), step | {"unit_string": unit})
            for column, unit in (("angle_rad", "rad"), ("east_m", "m"))
        ]
        with TdmsWriter(folder / f"{name}.tdms") as file:
            file.write_segment(
                [
                    ChannelObject(channel.group, channel.channel, channel.data, channel.properties)
                    for channel in channels
                ]
            )


def write_blanks(frames, folder):
    """Write space-delimited columns without names."""
    for name, frame in frames.items():
        rows = ["".join(f"{x:20.12g}" for x in row) for row in frame.rows()]
        (folder / f"{name}.dat").write_text("\n".join(rows) + "\n")


#: Detected values that are wrong and corrected.
WRONG = {write_excel: {"Along which axis": "east"}}
#: Formats of the first certificate of the laboratory and of a later one.
FIRST, LATER = write_matlab, write_excel
#: From the result to the certificate: equal clicks and fields for all file formats.
CERTIFICATE_CLICKS, CERTIFICATE_FIELDS = 4, 1


#: Menu entries that are not selected.
CLOSED = """element => [...element.querySelectorAll("option:not(:checked)")]
  .filter(option => option.closest("select").checkVisibility())
  .map(option => option.textContent).join(" ")"""


class UserEffort:
    """A user whose clicks, fields, keystrokes and words read are counted."""

    def __init__(self, tab):
        self.tab, self.clicks, self.fields, self.letters, self.words = tab, 0, 0, 0, 0

    def read(self, *found):
        """Count the visible words; a closed menu shows its selected entry."""
        for element in found:
            seen, closed = element.inner_text(), element.evaluate(CLOSED)
            self.words += len(re.findall(r"\w+", seen)) - len(re.findall(r"\w+", closed))

    def click(self, locator):
        locator.click()
        self.clicks += 1

    def choose_files(self, locator, files):
        locator.set_input_files(files)
        self.clicks += 2  # the button, and Open in the system dialogue

    def fill(self, locator, text):
        """Type into a field or select an option; the user moves between fields with the tab key."""
        self.fields += 1
        if locator.evaluate("field => field.tagName") == "SELECT":
            locator.select_option(text)
        else:
            locator.fill(text)
            self.letters += len(text)

    @property
    def seconds(self):
        typed = SECONDS_A_LETTER * self.letters
        read = 60.0 / WORDS_A_MINUTE * self.words
        return typed + read + SECONDS_A_CLICK * self.clicks + SECONDS_A_FIELD * self.fields


def fill_laboratory_form(tab):
    """Fill in the laboratory form before the first certificate; return the user effort."""
    hand = UserEffort(tab)
    hand.read(tab.locator("#missing"))
    for key, text in LABORATORY.items():
        hand.fill(tab.locator(f'[id="f-{key}"]'), text)
        hand.words += len(re.findall("[a-z]+", key))  # section, label
    tab.locator('[id="f-evidence.all"]').blur()
    return hand


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    plain = simulate_campaign(tmp_path_factory.mktemp("plain"))
    return {name: pl.read_csv(plain / f"{name}.csv") for name in RUNS}


@pytest.mark.parametrize(
    "write", [write_labview, write_excel, write_matlab, write_tdms, write_blanks]
)
def test_files_to_certificate_within_effort_limits(open_window, frames, folder, tmp_path, write):
    files = tmp_path / "files"
    files.mkdir()
    write(frames, files)
    if write is not FIRST:
        write_filled_template(folder / "LAB.toml")
    key, cert = write_pkcs12(tmp_path, ec.generate_private_key(ec.SECP256R1()), b"secret")
    tab = open_window()
    hand = UserEffort(tab)
    hand.read(tab.locator(".drop"))
    hand.choose_files(tab.get_by_label("Recorder files"), sorted(files.iterdir()))
    find_answer_field(tab, "Local gravity").wait_for()
    hand.read(*tab.locator(".site, .columns, .unused, .checklist").all())
    for question, answer in KNOWN.items():
        for field in find_answer_field(tab, question).all():
            if field.input_value() == "":
                hand.fill(field, answer)
    for question, answer in WRONG.get(write, {}).items():
        wrong = find_answer_field(tab, question)
        assert wrong.input_value() == "north"
        hand.fill(wrong, answer)
    hand.click(tab.get_by_role("button", name="Calibrate"))
    certificate = tab.locator(".head").get_by_role("link", name="Certify", exact=True)
    certificate.wait_for()
    hand.read(*tab.locator(".instrument, .warning").all())
    (campaign_folder,) = {file.parent for file in folder.glob("*/result.json")} - {folder / "three"}
    (accelerometer,) = read_result(campaign_folder / "result.json").accelerometers.values()
    k_ii = accelerometer.coefficients["K_II"]
    assert abs(k_ii.value - 2.7e-5) < 4.0 * k_ii.u
    clicks, fields = hand.clicks + CERTIFICATE_CLICKS, hand.fields + CERTIFICATE_FIELDS
    assert clicks <= MOST_CLICKS
    assert fields <= MOST_FIELDS
    assert hand.seconds <= MOST_SECONDS
    if write not in (FIRST, LATER):
        return
    hand.click(certificate)
    tab.get_by_label("Signature").wait_for()
    office = fill_laboratory_form(tab) if write is FIRST else UserEffort(tab)
    hand.choose_files(tab.get_by_label("Key file (PEM or PKCS #12)"), key)
    hand.fill(tab.get_by_label("Key password"), "secret")
    hand.click(tab.get_by_role("button", name="Sign and issue"))
    tab.get_by_role("heading", name=re.compile("^Certificate .* signed and issued")).wait_for()
    for name in ("certificate.xml", "certificate.pdf"):
        assert (
            check_certificate(campaign_folder / name, signer_certificate=cert).signature == "valid"
        )
    assert (hand.clicks, hand.fields) == (clicks, fields)
    assert office.fields == (len(LABORATORY) if write is FIRST else 0)
    assert hand.seconds + office.seconds <= MOST_SECONDS
