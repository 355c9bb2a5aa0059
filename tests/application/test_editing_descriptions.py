"""Descriptions as form and text: problems at their keys, and no lost edit."""

FILE = "three/campaign.toml"


def list_problems(response):
    return [(problem["key"], problem["words"]) for problem in response["problems"]]


def test_description_is_returned_with_form_and_version(page, folder):
    body = page.get("/api/description", params={"name": "three"}).json()
    assert body["text"] == (folder / FILE).read_text()
    assert body["document"]["runs"][0]["name"] == "slow"
    assert body["problems"] == []
    assert any("without an uncertainty" in words for words in body["questions"])
    assert body["form"][0]["key"] == "campaign"


def test_all_problems_are_reported_at_their_keys(page, folder):
    text = (folder / FILE).read_text()
    wrong = text.replace('"2.5 m"', '"2.5 kg"').replace("latitude", "latitud")
    wrong = wrong.replace('rate = "1 rev/s"', 'rate = "1 Hz"')
    body = page.post("/api/check", json={"file": FILE, "text": wrong}).json()
    assert {key for key, _ in list_problems(body)} == {
        "site.latitude",
        "site.latitud",
        "centrifuge.radius",
        "runs[2].rate",
    }
    assert (folder / FILE).read_text() == text
    body = page.post("/api/check", json={"file": FILE, "text": "a = 1 2"}).json()
    ((key, words),) = list_problems(body)
    assert (key, body["document"]) == ("", {})
    assert words.startswith("line 1")


def test_missing_file_is_named_relative_to_served_folder(page):
    text = '[readings]\nfile = "gone.csv"\ncolumns = { reading = "mA" }\n'
    body = page.post("/api/check", json={"file": FILE, "text": text}).json()
    assert ("readings.file", "three/gone.csv: file not found") in list_problems(body)


def test_field_changes_text_and_file_changes_on_save(page, folder):
    seen = page.get("/api/description", params={"name": "three"}).json()
    change = {"path": ["centrifuge", "radius"], "value": "3 m"}
    body = page.post("/api/change", json={"file": FILE, "text": seen["text"]} | change).json()
    assert body["text"] == seen["text"].replace('"2.5 m"', '"3 m"')
    assert (folder / FILE).read_text() == seen["text"]
    save = {"file": FILE, "text": body["text"], "version": seen["version"]}
    saved = page.put("/api/text", json=save).json()
    assert (folder / FILE).read_text() == body["text"]
    # Another window still has the first version.
    late = page.put("/api/text", json=save | {"text": "mine"})
    assert late.status_code == 409
    assert late.json()["text"] == body["text"]
    assert late.json()["version"] == saved["version"]
    assert (folder / FILE).read_text() == body["text"]


def test_only_descriptions_and_laboratory_data_are_written(page, folder):
    for file, status in (
        ("three/slow.csv", 403),
        ("three/other.toml", 403),
        ("../x.toml", 403),
        ("new/campaign.toml", 200),
    ):
        request = {"file": file, "text": "schema = 1\n", "version": ""}
        assert page.put("/api/text", json=request).status_code == status
    assert (folder / "new" / "campaign.toml").read_text() == "schema = 1\n"


def test_file_outside_folder_named_in_text_is_not_read(page, folder):
    (folder.parent / "outside.csv").write_text("name,g\n1,2\n")
    text = (folder / FILE).read_text() + '\n[readings]\nfile = "../../outside.csv"\n'
    body = page.post("/api/check", json={"file": FILE, "text": text}).json()
    ((key, words),) = list_problems(body)
    assert key == "readings.file"
    assert "outside the served folder" in words


def test_new_laboratory_data_start_from_example(page, folder):
    query = {"file": "LAB.toml", "result": "three/result.json"}
    body = page.get("/api/lab", params=query).json()
    assert (body["version"], body["problems"]) == ("", [])
    change = {"text": body["text"], "path": ["certificate", "end"], "value": "1999-01-01"}
    wrong = page.post("/api/change", json=query | change | {"kind": "date"}).json()
    assert list_problems(wrong) == [("certificate.end", "lies before certificate.begin")]
    assert page.put("/api/text", json=query | {"text": body["text"], "version": ""}).is_success
    assert (folder / "LAB.toml").read_text() == body["text"]
