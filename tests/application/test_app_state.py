"""Documents of the served folder may name only files in the folder."""

import pytest
from served import ANSWERS

from counterspin.certificates.lab import write_example as write_lab
from counterspin.errors import CampaignError
from counterspin.planning.plan import write_example as write_plan

RESULT = "three/result.json"


@pytest.fixture
def outside_folder(folder):
    """Return a folder outside the served folder that symlinks in it point to."""
    place = folder.parent / "outside"
    place.mkdir()
    for inner in (folder, folder / "three"):
        (inner / "sub").symlink_to(place)
    return place


def _issue_certificate(page, output):
    request = {"result": RESULT, "lab": "LAB.toml", "output": output}
    return page.post("/api/certificate", json=request)


def test_ledger_outside_folder_is_rejected(page, folder, outside_folder):
    lab = write_lab(folder / "LAB.toml")
    text = lab.read_text() + '\n[evidence]\nall = "Type test 4714."\n'
    head = "[certificate]\n"
    assert head in text
    lab.write_text(text.replace(head, head + 'ledger = "sub/led.jsonl"\n'))
    response = _issue_certificate(page, "new.xml")
    assert response.status_code == 422
    assert response.json()["codes"] == ["path-outside-folder"]
    assert response.json()["problems"][0].startswith("certificate.ledger: 'sub/led.jsonl' ")
    assert list(outside_folder.iterdir()) == []
    assert not (folder / "new.xml").exists()
    lab.write_text(text.replace(head, head + 'ledger = "led.jsonl"\n'))
    assert _issue_certificate(page, "new.xml").status_code == 200


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ('continued_in = ["more.csv", "sub/more.csv"]', "continued_in[1]"),
        ('pulses = "sub/pulses.csv"', "pulses"),
        ('truth = {whatever = {comes = "/etc/hostname"}}', "truth.whatever.comes"),
        ('temperature = "sub/../../secret"', "temperature"),
    ],
)
def test_record_path_outside_folder_is_rejected(app, folder, outside_folder, line, key):
    file = folder / "three" / "campaign.toml"
    assert app.campaign("three").runs
    file.write_text(file.read_text().replace("[[runs]]\n", f"[[runs]]\n{line}\n", 1))
    with pytest.raises(CampaignError, match="outside the served folder") as refused:
        app.campaign("three")
    assert [problem.partition(":")[0] for problem in refused.value.problems] == [f"runs[0].{key}"]


def test_title_is_not_checked_as_path(app, folder):
    file = folder / "three" / "campaign.toml"
    title = "Qx / Qy .. at 1 g/g^2, https://example.org: \u00b1 \U0001f600" + "x" * 5000
    text = file.read_text().replace("[campaign]\n", f'[campaign]\ntitle = "{title}"\n')
    file.write_text(text)
    assert app.campaign("three").title == title


def test_rejects_writing_through_symlink(page, folder, outside_folder):
    (folder / "new").mkdir()
    (folder / "new" / "campaign.toml").symlink_to(outside_folder / "campaign.toml")
    write_plan(folder / "PLAN.toml")
    files = {"folder": "new", "names": ["three/slow.csv", "three/fast.csv"], "answers": ANSWERS}
    request = {
        "campaign": {"name": "new"},
        "simulation": {"name": "three", "folder": "new"},
        "drafted": files,
        "planned": {"name": "PLAN.toml", "folder": "new"},
    }
    for name, body in request.items():
        response = page.post(f"/api/{name}", json=body)
        assert response.json()["error"].startswith("new/campaign.toml ")
        assert (response.status_code, response.json()["code"]) == (
            403,
            "path-forbidden",
        )
    assert list(outside_folder.iterdir()) == []
