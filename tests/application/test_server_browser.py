"""The page in a browser, operated as by a user."""

import io
import math
import re
import shutil

import numpy as np
import pypdf
import pytest
from campaigns import replace_parts
from chromium import MAX_WAIT, needs_chromium, wait_until
from cryptography.hazmat.primitives.asymmetric import ec
from planning_setups import PERFECT
from posed_records import simulate_poses
from served import PLACES, find_answer_field, read_token
from signing_keys import write_pair, write_pkcs12

from certificates import write_filled_template
from counterspin.application.campaign_files import TRASH_FOLDER
from counterspin.application.server import _write_redirect
from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.result import Result
from counterspin.campaign.description import read_campaign
from counterspin.certificates.issuing import check_certificate
from counterspin.planning.plan import write_example

pytestmark = needs_chromium

#: In the example plan, so that u comes from the runs, which a plan can change.

#: What no file says.
PLACE = (
    ("Local gravity", "9.8066 m/s^2"),
    ("Latitude", "45.75 deg"),
    ("Radius", "2.5 ± 1e-5 m"),
)
PHONE = {"width": 360, "height": 740}


def wait_for_plots(tab):
    """Wait for a plot of the open chapter and for a plot of the residuals."""
    still = tab.locator("figure:not(.zoomable)").first
    still.scroll_into_view_if_needed()
    still.locator("svg").wait_for()
    tab.get_by_role("tab", name="Residuals").click()
    tab.locator("figure.zoomed canvas").first.wait_for()


def leave_and_return(tab):
    """Reload the Confirm step, discard its files and undo: files and answers remain."""
    find_answer_field(tab, "Radius").blur()
    tab.reload()
    find_answer_field(tab, "Radius").wait_for()
    assert find_answer_field(tab, "Radius").input_value() == "2.5"
    tab.get_by_role("button", name="Discard").click()
    tab.get_by_role("button", name="Undo").click()


def test_exports_to_certificate_workflow(open_window, app, folder):
    """Upload recorder files, calibrate, inspect the result and issue the certificate."""
    tab = open_window()
    tab.get_by_label("Folder for the new campaign").fill("mine")
    assert "token" not in tab.url
    records = [folder / "three" / f"{run}.csv" for run in ("slow", "middle", "fast")]
    tab.get_by_label("Recorder files").set_input_files(records)
    for question, place_answer in PLACE:
        find_answer_field(tab, question).fill(place_answer)
    leave_and_return(tab)
    # The drawing shows the requested axes and angle.
    tab.get_by_role("img", name="Double turntable").wait_for()
    # The detected role of a column can be changed and reset before files are written.
    role_menu = tab.get_by_label("Role of column north_m")
    role_menu.select_option("velocity")
    tab.get_by_label("What is the unit of column 'north_m'?").wait_for()
    tab.get_by_role("button", name="Calibrate").click()
    tab.get_by_text("Required, for example m/s.").wait_for()
    assert not (folder / "mine" / "campaign.toml").exists()
    assert tab.get_by_label("Latitude", exact=True).input_value() == "45.75"
    role_menu.select_option("displacement")
    tab.get_by_text("Required, for example m/s.").wait_for(state="detached")
    tab.get_by_label("Latitude", exact=True).fill("45.75 degs")
    tab.get_by_role("button", name="Calibrate").click()
    tab.get_by_text("unknown unit 'degs'").wait_for()
    # The same files can be uploaded again.
    with tab.expect_response(lambda answer: answer.url.endswith("/api/draft")):
        tab.get_by_label("Recorder files").set_input_files(records[::-1])
    tab.get_by_label("Latitude", exact=True).wait_for()
    for question, place_answer in PLACE:
        find_answer_field(tab, question).fill(place_answer)
    # A reloaded page finds the running calibration; another job is simulated,
    # so that the calibration does not end first.
    with app.jobs._run_lock:
        tab.get_by_role("button", name="Calibrate").click()
        tab.get_by_role("progressbar").wait_for()
        tab.reload()
        tab.get_by_role("progressbar").wait_for()
        tab.get_by_text(re.compile(r"^Waiting for another job, \d+ s$")).wait_for()
        # Screen readers do not announce seconds.
        assert tab.locator(".job [aria-live]").all_inner_texts() == ["Waiting for another job"]
    tab.get_by_role("heading", name="Quality checks").wait_for()
    assert (folder / "mine" / "result.json").is_file()
    assert tab.locator(".instrument").count() == 2
    # Static plots are loaded when scrolled near.
    wait_for_plots(tab)
    tab.get_by_role("link", name="Certify", exact=True).last.click()
    tab.get_by_label("Signature").select_option("No signature")
    tab.get_by_role("button", name="Write draft").click()
    with tab.expect_download() as saved:
        tab.get_by_role("button", name="Save mine/certificate.xml").click()
    assert saved.value.suggested_filename == "certificate.xml"
    certificate = folder / "mine" / "certificate.xml"
    assert saved.value.path().read_bytes() == certificate.read_bytes()
    tab.get_by_text("Equivalent command").click()
    shown = tab.locator("code:visible").last.inner_text()
    assert shown.startswith("counterspin certificate ")
    assert b"digitalCalibrationCertificate" in certificate.read_bytes()


@pytest.mark.parametrize("kind", ["pkcs12", "pem"])
def test_certificate_is_signed_by_mouse(open_window, folder, tmp_path, kind):
    write_filled_template(folder / "LAB.toml", keep=("Example Customer",))
    write = write_pkcs12 if kind == "pkcs12" else write_pair
    key, cert = write(tmp_path, ec.generate_private_key(ec.SECP256R1()), b"vy secret")
    tab = open_window("/certificate/three%2Fresult.json")
    # Template values are empty fields, and signing requires them to be filled in.
    tab.get_by_role("heading", name="Complete 2 entries before you sign").wait_for()
    tab.get_by_role("img", name="Page 1 of").wait_for()
    customer = tab.locator('[id="f-customer.name"]')
    assert customer.input_value() == ""
    assert customer.get_attribute("placeholder") == "Example Calibration Ltd"
    button = tab.get_by_role("button", name="Sign and issue")
    assert button.get_attribute("aria-disabled") == "true"
    button.click(force=True)
    assert customer.evaluate("field => field === document.activeElement")
    customer.fill("Own customer")
    customer.blur()
    tab.get_by_label("Key file (PEM or PKCS #12)").set_input_files(key)
    tab.get_by_role("heading", name="All required entries are complete.").wait_for()
    assert button.get_attribute("aria-disabled") is None
    if kind == "pem":
        tab.get_by_label("Signer's certificate (PEM)").set_input_files(cert)
    password = tab.get_by_label("Key password")
    password.fill("wrong")
    button.click()
    tab.get_by_text("cannot be read with this password").wait_for()
    assert password.input_value() == ""
    assert not (folder / "three" / "certificate.xml").exists()
    password.fill("vy secret")
    button.click()
    tab.get_by_role("heading", name=re.compile("^Certificate .* signed and issued")).wait_for()
    assert tab.get_by_label("Key password").count() == 0
    tab.get_by_role("button", name="Verify three/certificate.pdf").click()
    tab.get_by_text("The signatures of the XML and the pages are valid").wait_for()
    for name in ("certificate.xml", "certificate.pdf"):
        assert tab.get_by_role("button", name=f"Save three/{name}").is_visible()
        assert (
            check_certificate(folder / "three" / name, signer_certificate=cert).signature == "valid"
        )
    assert (
        check_certificate(
            folder / "three" / "certificate.pdf", signer_certificate=cert
        ).page_signature
        == "valid"
    )
    kept = tab.evaluate("JSON.stringify([{...localStorage}, {...sessionStorage}])")
    assert "secret" not in kept


def test_drawing_is_shown_beside_fields(open_window):
    tab = open_window("/description/three")
    for question, name in (
        ("Accelerometer axes", "Axes of an accelerometer"),
        ("Zero angle and positive direction", "Double turntable"),
    ):
        tab.get_by_text(question).click()
        tab.get_by_role("img", name=name).wait_for()
    # The drawing stays after the fields are rendered again.
    radius = tab.locator('[id="f-centrifuge.radius"]')
    radius.fill("2.6")
    radius.press("Tab")
    tab.get_by_role("img", name="Double turntable").wait_for()


def test_manual_page_opens_beside_form_and_keeps_input(open_window):
    tab = open_window("/description/three")
    tab.locator('[id="f-site.gravity"]').fill("9.81")
    with tab.expect_popup() as beside:
        tab.get_by_role("link", name="Documentation of records").click()
    page = beside.value
    heading = page.get_by_role("heading", name="[records]", exact=True)
    heading.wait_for()
    page.wait_for_function("scrollY > 0")
    assert abs(heading.bounding_box()["y"]) < PHONE["height"]
    page.get_by_role("navigation", name="Documentation").get_by_text("Readings: tumble").click()
    page.get_by_role("heading", level=1, name="Readings: tumble").wait_for()
    assert tab.locator('[id="f-site.gravity"]').input_value() == "9.81"


def test_answers_persist_after_change_of_test_type(open_window, folder):
    tab = open_window()
    tab.get_by_label("Folder for the new campaign").fill("mine")
    records = [folder / "three" / f"{run}.csv" for run in ("slow", "middle", "fast")]
    tab.get_by_label("Recorder files").set_input_files(records)
    for question, answer in PLACE:
        find_answer_field(tab, question).fill(answer)
    kind = tab.get_by_label("Test type")
    kind.select_option("tumble")
    tab.locator(".panel").get_by_role("alert").wait_for()
    kind.select_option("double-turntable")
    for question, answer in PLACE:
        find_answer_field(tab, question).wait_for()
        assert find_answer_field(tab, question).input_value().startswith(answer.split()[0])


def test_table_of_readings_to_result_workflow(open_window, folder, tmp_path):
    rows = [
        f"{angle},{1.25 * math.cos(math.radians(angle)) + 0.003:.6f},2e-6"
        for angle in range(0, 360, 30)
    ]
    (tmp_path / "tumble.csv").write_text("\n".join(["angle_deg,reading_mA,u_mA", *rows]) + "\n")
    tab = open_window()
    tab.get_by_label("Folder for the new campaign").fill("tumble")
    files = tab.get_by_label("Recorder files")
    files.set_input_files(tmp_path / "tumble.csv")
    tab.get_by_label("What is the nominal sensitivity").wait_for()
    # With a slow server, an unchecked answer is kept for the next file.
    held, holding = [], [True]
    tab.route("**/api/draft", lambda route: held.append(route) if holding else route.continue_())
    for question, answer in (*PLACE[:2], ("What is the nominal sensitivity", "1.25 mA/g")):
        find_answer_field(tab, question).fill(answer)
    assert tab.get_by_label("In which direction does the input axis point").input_value() == "up"
    # Detected values of a file do not apply to another.
    kind = tab.get_by_label("Test type")
    assert kind.input_value() == "tumble"
    files.set_input_files(folder / "three" / "slow.csv")
    holding.clear()
    for route in held:
        route.continue_()
    tab.get_by_label("Radius", exact=True).wait_for()
    assert kind.input_value() == "double-turntable"
    files.set_input_files(tmp_path / "tumble.csv")
    tab.get_by_label("What is the nominal sensitivity").wait_for()
    assert tab.get_by_label("Latitude", exact=True).input_value() == PLACE[1][1].split()[0]
    # With a slow click, the last answer is applied before the button is released.
    tab.get_by_role("button", name="Calibrate").hover()
    tab.mouse.down()
    tab.wait_for_timeout(1000)
    tab.mouse.up()
    tab.get_by_role("heading", name="Quality checks").wait_for()
    assert (folder / "tumble" / "result.json").is_file()


def test_corrected_file_can_be_uploaded_under_same_name(open_window, folder):
    record = {"name": "run.csv", "mimeType": "text/csv"}
    contents = [(folder / "three" / f"{run}.csv").read_bytes() for run in ("slow", "fast")]
    tab = open_window()
    tab.get_by_label("Recorder files").set_input_files([record | {"buffer": b"hello world\n"}])
    message = tab.get_by_text("no column contains only numbers")
    message.wait_for()
    assert "\n" in message.inner_text()
    # Two files of this name, for example from two folders.
    files = [record | {"buffer": content} for content in contents]
    tab.get_by_label("Recorder files").set_input_files(files)
    tab.get_by_role("heading", name="Columns in run.csv, 2 files").wait_for()
    tab.get_by_text("If you choose files again, they replace the files below.").wait_for()
    tab.get_by_text("Moved the files of run to the trash.").wait_for()
    assert sorted(path.name for path in folder.iterdir()) == [TRASH_FOLDER, "run", "three"]
    assert [(folder / "run" / f"run{n}.csv").read_bytes() for n in ("", "-2")] == contents


def test_altered_result_is_reported_on_campaign_page(open_window, folder):
    result = folder / "three" / "result.json"
    result.write_text(result.read_text().replace('"three"', '"four"', 1))
    open_window("/campaign/three").get_by_text("was changed after it was written").wait_for()


@pytest.mark.usefixtures("inline_jobs")
def test_pasted_arm_table_to_result_workflow(open_window, folder):
    rows = ["side\trpm\treading_mA", "oben\t0\t1.2532", "unten\t0\t-1.2468"]
    for rpm in (30, 45, 60, 90, 120):
        force = 1.25 * (rpm * math.pi / 30.0) ** 2 / 9.8066
        rows += [f"A\t{rpm}\t{force + 0.003:.5f}", f"B\t{rpm}\t{-force + 0.003:.5f}"]
    tab = open_window()
    tab.get_by_label("Folder for the new campaign").fill("arm")
    tab.get_by_text("Paste a table").click()
    tab.get_by_label("Table copied from a spreadsheet").fill("\n".join([*rows, rows[1], rows[2]]))
    tab.get_by_role("button", name="Use this table").click()
    tab.get_by_label("Sense of rotation").select_option("clockwise")
    known = (*PLACE[:2], ("Radius", "1.0 ± 1e-3 m"))
    for question, answer in (*known, ("What is the nominal sensitivity", "1.25 mA/g")):
        find_answer_field(tab, question).fill(answer)
    # Detected values are shown, also of text columns.
    assert tab.get_by_label("Test type").input_value() == "arm"
    assert tab.get_by_label("Role of column side").input_value() == "position"
    assert tab.get_by_label("in the mounting 'B'").input_value() == "outward"
    tab.get_by_role("button", name="Calibrate").click()
    tab.get_by_role("heading", name="Quality checks").wait_for()
    assert (folder / "arm" / "result.json").is_file()


@pytest.mark.usefixtures("inline_jobs")
def test_pose_log_to_triad_workflow(open_window, folder, tmp_path):
    np.savetxt(tmp_path / "imu.log", simulate_poses(3.0, 1.0, count=24).values, fmt="%.5f")
    tab = open_window()
    tab.get_by_label("Folder for the new campaign").fill("triad")
    tab.get_by_label("Recorder files").set_input_files(tmp_path / "imu.log")
    answers = (*PLACE[:2], ("What is the sampling rate", "100 Hz"))
    for question, answer in answers:
        find_answer_field(tab, question).fill(answer)
    # Detected values are shown.
    kind = tab.get_by_label("Test type")
    assert kind.input_value() == "poses"
    assert tab.get_by_label("Role of column column 2").input_value() == "Y"
    assert tab.get_by_label("What is the unit of the three axes?").input_value() == "m/s^2"
    tab.get_by_role("button", name="Calibrate").click()
    tab.get_by_role("heading", name="Quality checks").wait_for()
    result = Result.read(folder / "triad" / "result.json")
    assert len(result.triad.poses) == 24


def test_campaigns_are_copied_renamed_searched_and_deleted(open_window, folder, tmp_path):
    tab = open_window("/campaign/three")
    tab.get_by_role("tab", name="Coefficients").press("End")
    assert tab.evaluate("document.activeElement.textContent") == "Inputs"
    tab.get_by_role("heading", name="Inputs and reproducibility").wait_for()
    tab.get_by_text("Add records, copy").click()
    tab.get_by_label("Folder name").fill("four")
    tab.get_by_role("button", name="Copy", exact=True).click()
    tab.get_by_text(re.compile(r" four$")).wait_for()
    tab.get_by_text("Add records, copy").click()
    # Every second row, so that the samples differ from those of existing runs.
    rows = (folder / "three" / "slow.csv").read_text().splitlines()
    other = tmp_path / "slower.csv"
    other.write_text("\n".join(rows[:1] + rows[1::2]))
    tab.get_by_label("Records to add").set_input_files(other)
    tab.get_by_text("Added run: slower at 0.25 rev/s.").wait_for()
    # The page is then rendered again with folded parts.
    tab.locator("#view:not([aria-busy])").wait_for()
    assert read_campaign(folder / "four").runs[-1].record == folder / "four" / "slower.csv"
    tab.get_by_text("Add records, copy").click()
    tab.get_by_label("Folder name").fill("three")
    tab.get_by_role("button", name="Rename").click()
    tab.get_by_text("three already exists; choose another name").wait_for()
    tab.goto(tab.url.partition("#")[0] + "#/")
    tab.locator(".card").nth(1).wait_for()
    tab.get_by_label("Search").fill("fou")
    tab.get_by_text("1 of 2").wait_for()
    tab.locator(".card a").click()
    tab.get_by_text(re.compile(r" four$")).wait_for()
    tab.get_by_text("Add records, copy").click()
    tab.get_by_role("button", name="Move to trash").click()
    tab.wait_for_url("**#/")
    assert not (folder / "four").exists()
    # Items in the trash can be restored immediately or later from the list.
    tab.get_by_role("button", name="Undo").click()
    tab.wait_for_url("**#/campaign/four")
    assert (folder / "four" / "campaign.toml").is_file()
    # The page may be rendered again, with folded parts, after its first display.
    button = tab.get_by_role("button", name="Move to trash")
    for _ in range(100):
        if button.is_visible():
            break
        tab.get_by_text("Add records, copy").click()
        tab.wait_for_timeout(200)
    button.click()
    tab.get_by_text("Trash (1)").click()
    tab.get_by_role("button", name="Restore four").click()
    tab.wait_for_url("**#/campaign/four")
    assert (folder / "three" / "campaign.toml").is_file()


def test_record_plot_loads_more_samples_on_zoom(open_window):
    tab = open_window("/runs/three")
    tab.locator(".canvas canvas").nth(2).wait_for()
    tab.get_by_label("Run").select_option("fast")
    tab.get_by_text("The plot shows every row.").wait_for()
    drawing = "document.querySelector('.canvas canvas').toDataURL()"
    whole = tab.evaluate(drawing)
    with tab.expect_response(lambda answer: "/api/record?" in answer.url) as response_info:
        tab.get_by_role("button", name="Zoom in").click()
    assert "low=1.5&high=4.5" in response_info.value.url
    tab.locator(".canvas canvas").first.wait_for()
    wait_until(tab, lambda: tab.evaluate(drawing) != whole)


@pytest.mark.usefixtures("inline_jobs")
def test_pasted_readings_become_campaign(open_window, folder):
    tab = open_window()
    tab.get_by_label("Folder for the new campaign").fill("pasted")
    tab.get_by_text("Paste a table").click()
    rows = [(angle, 1.25 * (0.002 + math.cos(math.radians(angle)))) for angle in range(0, 360, 30)]
    # As copied from a spreadsheet with decimal commas.
    lines = ["position_deg\treading_mA", *(f"{a}\t{v:.6f}".replace(".", ",") for a, v in rows)]
    tab.get_by_label("Table copied from a spreadsheet").fill("\r\n".join(lines))
    tab.get_by_role("button", name="Use this table").click()
    circle = tab.get_by_role("img", name="Input-axis direction at 12 positions")
    circle.wait_for()
    assert circle.locator("path").count() == 12
    for words, answer in (*PLACE[:2], ("What is the nominal sensitivity", "1.25 mA/g")):
        find_answer_field(tab, words).fill(answer)
    tab.get_by_role("button", name="Save without calibrating").click()
    tab.wait_for_url("**#/campaign/pasted")
    assert (folder / "pasted" / "readings.txt").is_file()
    tab.get_by_role("button", name="Calibrate", exact=True).click()
    tab.get_by_text("K_F").first.wait_for()


def test_plan_search_starts_on_click_and_can_be_stopped(open_window, app, folder):
    example = write_example(folder / "PLAN.toml")
    example.write_text(replace_parts(example.read_text(), ("runs = 14", "runs = 2"), *PERFECT))
    tab = open_window("/plans")
    tab.get_by_role("link", name="A day at the centrifuge").click()
    search = tab.get_by_role("button", name="Calculate plan")
    # A reloaded page finds the search and its limits.
    with app.jobs._run_lock:
        tab.get_by_label("Highest rate").fill("0.5")
        search.click()
        tab.get_by_role("progressbar").wait_for()
        tab.reload()
        tab.get_by_role("progressbar").wait_for()
        assert float(tab.get_by_label("Highest rate").input_value()) == pytest.approx(0.5)
        tab.get_by_label("Highest rate").fill("1")
    tab.get_by_role("button", name="Stop").click()
    tab.get_by_text("The plan was stopped.").wait_for()
    search.click()
    tab.get_by_role("heading", name="Active limits").wait_for()
    # In the unit of the file; announced once, by the slider and not by the number beside it.
    tab.get_by_label("Highest rate").fill("0.6366")
    assert tab.get_by_label("Highest rate").get_attribute("aria-valuetext") == "0.6366 rev/s"
    assert tab.locator("output:not([aria-live=off])").count() == 0
    tab.get_by_text("The limits have changed since this plan was calculated.").wait_for()
    search.click()
    tab.get_by_text("highest rate 3.99988 rad/s").wait_for()
    assert not tab.get_by_text(
        "The limits have changed since this plan was calculated."
    ).is_visible()
    tab.get_by_label("Folder for the planned campaign").fill("new")
    tab.get_by_role("button", name="Save limits and create campaign").click()
    tab.wait_for_url("**#/campaign/new")
    assert (folder / "new" / "campaign.toml").is_file()


def test_invalid_goal_is_marked_at_field_and_can_be_corrected(open_window):
    tab = open_window("/live/three")
    goal = tab.get_by_label("Goal")
    goal.fill("0.001")
    goal.press("Tab")
    wrong = tab.locator("#goal-mistake")
    wrong.get_by_text("is not estimated").wait_for()
    assert goal.get_attribute("aria-invalid") == "true"
    goal.fill("K_II 1 g/g^2")
    goal.press("Tab")
    tab.get_by_text(": met").first.wait_for()
    assert wrong.inner_text() == ""
    assert goal.get_attribute("aria-invalid") is None


def test_phone_has_no_horizontal_scrolling(open_window, folder):
    long_name = "accelerometer" * 12
    shutil.copytree(folder / "three", folder / long_name)
    tab = open_window()
    tab.set_viewport_size(PHONE)
    width = "document.documentElement.scrollWidth"
    tab.get_by_text(long_name).first.wait_for()
    assert tab.evaluate(width) <= PHONE["width"]
    tab.evaluate(f"location.hash = '#/campaign/{long_name}'")
    tab.get_by_role("heading", name="Quality checks").wait_for()
    assert tab.evaluate(width) <= PHONE["width"]


def test_colour_scheme_persists_after_reload(open_window):
    tab = open_window("/compare")
    tab.get_by_role("button", name="Use dark colours").click()
    tab.reload()
    tab.get_by_role("button", name="Use light colours").wait_for()


def test_page_without_key_shows_instructions(open_window, server_credentials):
    used = server_credentials.link
    tab = open_window()
    tab.get_by_role("link", name="three").wait_for()
    tab.reload()
    tab.get_by_role("link", name="three").wait_for()
    tab.evaluate("sessionStorage.clear()")
    for open_again in (tab.reload, lambda: tab.goto(used)):
        # In the same window the page reloads for a link.
        open_again()
        tab.wait_for_url(lambda address: "token" not in address)
        tab.get_by_role("heading", name="This window is not authorised").wait_for()
        tab.get_by_text("Open the most recent link that is shown in the terminal").wait_for()
    # In the same window, where only the fragment differs.
    tab.goto(server_credentials.link)
    tab.get_by_role("link", name="three").wait_for()
    assert "token" not in tab.url


def test_window_opened_from_page_has_key(open_window):
    tab = open_window()
    with tab.context.expect_page() as other:
        tab.get_by_role("link", name="three").click(modifiers=["Control"])
    other.value.get_by_role("heading", name="Quality checks").wait_for()


def test_browser_starts_from_private_redirect_file(browser, server_credentials, tmp_path):
    address = _write_redirect(tmp_path, server_credentials.link)
    (file,) = tmp_path.glob("*.html")
    assert file.stat().st_mode & 0o777 == 0o600
    assert read_token(server_credentials) not in address
    tab = browser.new_page()
    tab.goto(address)
    tab.get_by_role("link", name="three").wait_for(timeout=MAX_WAIT)
    assert "token" not in tab.url
    tab.close()


def test_problems_are_at_fields_and_form_follows_text(open_window, folder):
    tab = open_window("/description/three")
    radius, text = tab.get_by_label("Radius", exact=True), tab.get_by_label("campaign.toml")
    unit = tab.get_by_label("Unit of Radius")
    radius.fill("2.5 kg")
    radius.press("Tab")
    wrong = tab.locator(".field", has=radius).locator(".wrong")
    wrong.wait_for()
    assert radius.get_attribute("aria-invalid") == "true"
    assert 'radius = "2.5 kg"' in text.input_value()
    text.fill(text.input_value().replace("2.5 kg", "2.75 m"))
    wrong.wait_for(state="detached")
    assert (radius.input_value(), unit.input_value()) == ("2.75", "m")
    radius.fill("2750 ± 0.5")
    unit.select_option("mm")
    wait_until(tab, lambda: "2750 ± 0.5 mm" in text.input_value())
    # An edit can be undone and redone in the form and in the text.
    undo, redo = (tab.get_by_role("button", name=name) for name in ("Undo", "Redo"))
    assert redo.is_disabled()
    unit.select_option("m")
    wait_until(tab, lambda: '2750 ± 0.5 m"' in text.input_value())
    for button, expected in ((undo, "mm"), (redo, "m"), (undo, "mm")):
        button.click()
        wait_until(tab, lambda expected=expected: unit.input_value() == expected)
        assert f'radius = "2750 ± 0.5 {expected}"' in text.input_value()
    # Input during saving is preserved.
    held = []

    def hold_route(route):
        held.append(route)

    tab.route("**/api/text", hold_route)
    tab.get_by_role("button", name="Save").click()
    wait_until(tab, lambda: held)
    typed = f"{text.input_value()}# typed during the save\n"
    text.fill(typed)
    held[0].continue_()
    tab.get_by_text("Saved three/campaign.toml").wait_for()
    wait_until(tab, lambda: tab.locator(".working").count() == 0)
    assert text.input_value() == typed
    assert 'radius = "2750 ± 0.5 mm"' in (folder / "three" / "campaign.toml").read_text()
    tab.unroute("**/api/text")
    with tab.expect_response("**/api/text"):
        tab.get_by_role("button", name="Save").click()


def test_term_list_shows_effects_and_known_values(open_window, folder):
    tab = open_window("/description/three")
    model = tab.locator("#s-model")
    model.locator("details.terms").first.wait_for(state="attached")
    table = tab.locator("#t-model\\.terms")
    table.evaluate(
        "one => { for (let up = one; up; up = up.parentElement.closest('details')) up.open = true }"
    )
    row = table.get_by_role("row", name="K_OQ")
    assert "Odd quadratic coefficient" in row.inner_text()
    row.get_by_role("checkbox").check()
    text = tab.get_by_label("campaign.toml")
    wait_until(tab, lambda: '"K_OQ"' in text.input_value())
    table.get_by_role("row", name="K_OQ").get_by_role("checkbox").uncheck()
    wait_until(tab, lambda: "K_OQ" not in text.input_value())
    assert "1.002 g/g (Qx)" in table.get_by_role("row", name="K_I Scale factor").inner_text()
    assert table.evaluate("one => one.querySelector('.ticks').scrollWidth <= one.clientWidth")


def test_problems_are_announced_at_fields_with_space_in_name(open_window, folder):
    file = folder / "three" / "campaign.toml"
    text = file.read_text()
    file.write_text(f'{text}\n[accelerometers."Q x"]\nbias = "1 kg"\nscale_factor = "2"\n')
    tab = open_window("/description/three")
    tab.locator("[aria-invalid]").first.wait_for()
    read = tab.locator("[aria-invalid]").evaluate_all(
        """(all) => all.flatMap((one) => one.getAttribute("aria-describedby").split(" ")
          .filter((id) => id.startsWith("wrong"))
          .map((id) => document.getElementById(id)?.textContent))"""
    )
    listed = tab.locator(".editor .warning li").all_inner_texts()
    assert len(listed) > 1
    assert len(read) == len(listed)
    assert all(any(line.endswith(words) for line in listed) for words in read)


def test_scroll_hint_is_not_shown_outside_tables(open_window):
    tab = open_window("/description/three")
    tab.set_viewport_size(PHONE)
    tab.locator(".fields").wait_for()
    hints = """[...document.querySelectorAll("*")]
      .filter((one) => getComputedStyle(one, "::after").content.includes("More columns")).length"""
    assert tab.evaluate(hints) == 0


def test_edits_in_two_windows_are_preserved(open_window, folder):
    file = folder / "three" / "campaign.toml"
    tabs = [open_window("/description/three"), open_window("/description/three")]
    for tab, radius in zip(tabs, ("3 m", "4 m"), strict=True):
        tab.get_by_label("Radius", exact=True).fill(radius)
        tab.get_by_label("Radius", exact=True).press("Tab")
        tab.locator(".editor button.main:enabled").wait_for()
    first, second = tabs
    first.get_by_role("button", name="Save").click()
    first.get_by_text("Saved").wait_for()
    second.get_by_role("button", name="Save").click()
    second.get_by_text("Another window or program has changed").wait_for()
    assert 'radius = "3 m"' in second.get_by_label("Current file").input_value()
    assert 'radius = "3 m"' in file.read_text()
    second.get_by_role("button", name="Overwrite current file").click()
    second.get_by_text("Saved").wait_for()
    assert 'radius = "4 m"' in file.read_text()


#: A small screen.
SMALL_SCREEN = {"width": 1024, "height": 600}

#: Type and accessible name of all controls on the page.
UNNAMED = """[..."input select textarea button".split(" ")]
  .flatMap((name) => [...document.querySelectorAll(`main ${name}`)])
  .filter((one) => !(one.getAttribute("aria-label") || one.textContent.trim()
    || [...one.labels ?? []].some((label) =>
      label.textContent.replace(one.textContent, "").trim())))
  .map((one) => one.outerHTML)"""


def test_pages_fit_small_screen_and_controls_are_named(open_window, app):
    """`open_window` also requires that no page has an error."""
    # A complete campaign needs no live process.
    app.live.poll = lambda *_: {"html": "<p>Live</p>", "events": ["A run"], "complete": True}
    tab = open_window("/")
    tab.set_viewport_size(SMALL_SCREEN)
    tab.emulate_media(color_scheme="dark")
    for place in PLACES:
        tab.evaluate(f"location.hash = {place!r}")
        tab.locator("main:not([aria-busy]) h1").wait_for()
        tab.wait_for_function("document.querySelector('main').ariaBusy === null")
        assert tab.evaluate("document.documentElement.scrollWidth") <= SMALL_SCREEN["width"], place
        assert tab.evaluate(UNNAMED) == [], place


@pytest.mark.usefixtures("inline_jobs")
def test_calibration_to_chosen_file_opens_result(open_window):
    tab = open_window("/campaign/three")
    tab.get_by_text("Method, result file and command").click()
    tab.get_by_label("Method").select_option("two-stage")
    tab.get_by_label("Result file").fill("try.json")
    tab.get_by_role("button", name="Calibrate").click()
    tab.wait_for_url("**/#/result/three%2Ftry.json")
    tab.get_by_role("heading", name="Quality checks").wait_for()


def test_print_view_loads_all_plots(open_window):
    tab = open_window("/result/three%2Fresult.json")
    tab.locator("figure").first.wait_for()
    empty = "document.querySelectorAll('.still:empty').length"
    assert tab.evaluate(empty) > 0
    pages = pypdf.PdfReader(io.BytesIO(tab.pdf())).pages
    assert tab.evaluate(empty) == 0
    text = " ".join(page.extract_text() for page in pages)
    first = "(one) => one.querySelector('text').textContent"
    labels = tab.evaluate(f"[...document.querySelectorAll('.still svg')].map({first})")
    assert labels
    assert [label for label in labels if label not in text] == []


def test_results_are_compared_with_selected_reference(open_window, app):
    for name in ("b", "c"):
        shutil.copy(app.folder.root / "three" / "result.json", app.folder.root / f"{name}.json")
    tab = open_window("/compare")
    for name in ("three/result.json", "b.json", "c.json"):
        tab.get_by_role("checkbox", name=name).check()
    tab.get_by_text("Differences are relative to three/result.json").wait_for()
    tab.get_by_label("Reference result").select_option("c.json")
    tab.get_by_text("Differences are relative to c.json").wait_for()
    command = tab.locator("pre.command").first.text_content()
    files = [app.folder.root / name for name in ("c.json", "three/result.json", "b.json")]
    assert command == f"counterspin compare {' '.join(map(str, files))}"


def test_late_response_does_not_replace_newer_comparison(open_window, app):
    for name in ("b", "c"):
        shutil.copy(app.folder.root / "three" / "result.json", app.folder.root / f"{name}.json")
    held = []
    tab = open_window("/compare")
    tab.route(
        re.compile("/api/page.*=three.*c.json"),
        lambda route: route.continue_() if held else held.append(route),
    )
    for name in ("three/result.json", "b.json", "c.json"):
        tab.get_by_role("checkbox", name=name).check()
    tab.get_by_label("Reference result").select_option("c.json")
    tab.get_by_text("Differences are relative to c.json").wait_for()
    with tab.expect_response(held[0].request.url):
        held[0].continue_()
    tab.wait_for_timeout(200)
    assert tab.get_by_text("Differences are relative to c.json").is_visible()


def test_prepared_value_is_selected_for_typing(open_window, folder):
    file = folder / "three" / "campaign.toml"
    file.write_text(file.read_text("utf-8").replace('assume = "all"', ""), encoding="utf-8")
    calibrate(folder / "three").write(folder / "three" / "result.json", overwrite=True)
    tab = open_window("/campaign/three")
    tab.get_by_role("tab", name="Uncertainty budget").click()
    tab.get_by_role("button", name="Prepare a copy with this value").first.click()
    field = tab.locator("input:focus")
    tab.wait_for_url("**#/description/three-K_OO#*")
    field.wait_for()
    assert field.input_value() == "0 ± 2e-07 g/g^2"
    assert field.bounding_box()["y"] < tab.viewport_size["height"]


def test_history_without_serial_numbers_links_to_their_field(open_window, folder):
    file = folder / "three" / "campaign.toml"
    text = file.read_text("utf-8")
    file.write_text(re.sub("serial_number.*\n", "", text), encoding="utf-8")
    calibrate(folder / "three").write(folder / "three" / "result.json", overwrite=True)
    tab = open_window("/history")
    tab.get_by_text(
        "Qx of three/result.json, Qy of three/result.json: the result has no serial number"
    ).wait_for()
    tab.locator("main").get_by_role("link").click()
    section = tab.locator("#s-accelerometers")
    section.wait_for()
    assert section.bounding_box()["y"] < tab.viewport_size["height"]


@pytest.mark.usefixtures("inline_jobs")
def test_limits_and_study_work_by_keyboard(open_window):
    tab = open_window("/description/three")
    tab.locator("#s-specification > summary").press("Enter")
    tab.locator("[id='f-specification.K_II']").fill("abs <= 5e-5 g/g^2")
    tab.keyboard.press("Tab")
    tab.locator(".editor button.main:enabled").wait_for()
    assert "[specification]\nK_II =" in tab.get_by_label("campaign.toml").input_value()
    tab.get_by_role("button", name="Save").press("Enter")
    tab.get_by_text("Saved three/campaign.toml").wait_for()
    tab.get_by_text("More", exact=True).click()
    tab.get_by_role("link", name="Result").press("Enter")
    tab.get_by_role("button", name="Calibrate").press("Enter")
    tab.get_by_role("cell", name="pass").first.wait_for()
    tab.get_by_text("Report", exact=True).click()
    with tab.expect_download() as saved:
        tab.get_by_role("button", name="Report as HTML").press("Enter")
    assert saved.value.suggested_filename == "result.html"
    assert b"K_II" in saved.value.path().read_bytes()
    tab.get_by_text("More", exact=True).click()
    tab.get_by_role("link", name="Try out").press("Enter")
    tab.get_by_role("heading", name="Requirements for the centrifuge").wait_for()
    tab.get_by_label("Number of trials").fill("4")
    tab.keyboard.press("Enter")
    tab.get_by_role("heading", name="Verdict").wait_for()


def test_first_screen_has_result_and_slider_changes_u(open_window, folder):
    file = folder / "three" / "campaign.toml"
    file.write_text(file.read_text("utf-8").replace('assume = "all"', ""), encoding="utf-8")
    calibrate(folder / "three").write(folder / "three" / "result.json", overwrite=True)
    tab = open_window("/campaign/three")
    tab.set_viewport_size({"width": 1400, "height": 900})
    tab.get_by_role("heading", name="Quality checks").wait_for()
    counts = {".head .state": 1, ".instrument .value": 2, ".instrument .parts": 2, ".checks li": 6}
    for selector, count in counts.items():
        locators = tab.locator(selector).all()
        assert len(locators) == count, selector
        for shown in locators:
            box = shown.bounding_box()
            assert box["y"] + box["height"] <= 900.0, selector
    for text in tab.locator(".instrument .value").all_inner_texts():
        assert re.fullmatch("K_II = .?[0-9.]+ ± [0-9.]+.µg/g²", text)
    tab.get_by_role("tab", name="Uncertainty budget").click()
    slider = tab.locator("td.control input").first
    slider.fill("-1")
    tab.get_by_text(re.compile("^u of K.* \\(currently ")).wait_for()
    assert "current value" not in slider.get_attribute("aria-valuetext")


def test_tables_and_figures_can_be_saved(open_window):
    tab = open_window("/result/three%2Fresult.json")
    tab.get_by_role("tab", name="Uncertainty budget").click()
    with tab.expect_download() as saved:
        tab.get_by_role("button", name="CSV: Uncertainty budget of K_II, Qx").click()
    rows = saved.value.path().read_text("utf-8-sig").splitlines()
    assert rows[0].startswith("Source,")
    assert rows[-1].startswith("combined,")
    for kind, beginning in (("SVG", b"<svg"), ("PNG", b"\x89PNG")):
        with tab.expect_download() as saved:
            name = re.compile(f"^{kind}: Uncertainty contributions")
            tab.get_by_role("button", name=name).first.click()
        content = saved.value.path().read_bytes()
        assert content.startswith(beginning)
        assert b"var(--" not in content


def test_sample_campaign_opens_with_result(open_window, folder):
    tab = open_window("/")
    tab.get_by_role("button", name="Open a sample campaign").click()
    tab.wait_for_url("**#/campaign/sample")
    tab.locator(".instrument").first.wait_for()
    # The tour can be closed and started again.
    tour = tab.get_by_role("dialog", name="Campaign tour")
    tour.get_by_role("button", name="Close tour").click()
    assert not tour.is_visible()
    tab.get_by_text("More", exact=True).click()
    tab.get_by_role("button", name="Tour").click()
    for _ in range(4):
        tour.get_by_role("button", name="Next").click()
    assert tab.locator(".toured").count() == 1
    tour.get_by_role("button", name="Done").click()
    assert tab.locator(".toured").count() == 0
    (accelerometer,) = Result.read(folder / "sample" / "result.json").accelerometers.values()
    k_ii = accelerometer.coefficients["K_II"]
    truth = read_campaign(folder / "sample").simulation.truth.coefficients
    assert abs(k_ii.value - next(iter(truth.values()))["K_II"]) < 4.0 * k_ii.u
