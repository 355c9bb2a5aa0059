"""One way of writing and reading for every result."""

import json
import math
import pickle
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import ClassVar

import pytest
from raising import raises

import counterspin
from counterspin.certificates.lab import read_lab
from counterspin.comparisons.result import Intercomparison
from counterspin.errors import CounterspinError, RecordError
from counterspin.results import (
    NamedParts,
    ReportableResult,
    ResultFile,
    ResultPart,
    UnknownNameError,
)


class Temperature(ResultPart):
    value: float | None
    unit: str = "K"


class Log(ResultFile):
    KIND: ClassVar[str] = "log"

    rooms: dict[str, Temperature]
    series: list[float | None]

    def validation_errors(self):
        if not self.rooms:
            yield "it has no rooms"


LOG = Log(rooms={"cellar": Temperature(value=281.5)}, series=[1.0, math.inf, 3.0])


def test_write_read_round_trip(tmp_path):
    LOG.write(tmp_path / "log.json")
    text = (tmp_path / "log.json").read_text(encoding="utf-8")
    assert text == LOG.to_json()
    document = json.loads(text)
    assert document.pop("seal").startswith("sha256:")
    assert document == {
        "schema": 1,
        "rooms": {"cellar": {"value": 281.5, "unit": "K"}},
        "series": [1.0, None, 3.0],
    }
    assert '"series": [ 1.0, null, 3.0 ]' in text  # one line, however long
    assert Log.read(tmp_path / "log.json").to_json() == text
    (tmp_path / "log.json").write_text(text, encoding="utf-8-sig")
    assert Log.read(tmp_path / "log.json").to_json() == text


def test_json_schema_matches_written_keys():
    schema = Log.json_schema()
    assert set(schema["properties"]) == set(json.loads(LOG.to_json()))
    assert schema["properties"]["schema"]["default"] == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "not a log file: must be an object"),
        ("{", "not a log file, or damaged (the end of the file is missing: it ends at line 1, c"),
        ('{"rooms": {"attic": {"value": NaN}}}', "NaN is not a valid number in JSON"),
        ('{"rooms": {"attic": {"valve": 1}}}', "not a log file: rooms: attic: value: is missing"),
        ('{"rooms": {"attic": {"value": 1, "u": 2}}}', "attic: u: unknown key"),
        ('{"rooms": {}, "series": []}', "a damaged log: it has no rooms"),
        (
            '{"schema": 2}',
            "was written by a newer version of counterspin (schema 2; this version reads schemas "
            "up to 1)",
        ),
    ],
)
def test_invalid_file_raises(tmp_path, text, words):
    path = tmp_path / "log.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(RecordError) as caught:
        Log.read(path)
    assert str(caught.value).startswith(f"{path}")
    assert words in str(caught.value)


def test_kind_has_indefinite_article(tmp_path):
    with pytest.raises(RecordError, match="give the JSON file of an intercomparison"):
        Intercomparison.read(tmp_path / "none.json")


def test_existing_result_requires_overwrite(tmp_path):
    path, campaign = tmp_path / "log.json", tmp_path / "campaign.toml"
    LOG.write(path)
    before = path.read_bytes()
    other = LOG.model_copy(update={"schema_version": 1, "rooms": {}})
    with raises("file-exists", "`overwrite"):
        other.write(path)
    assert path.read_bytes() == before
    other.write(path, overwrite=True)
    assert path.read_bytes() != before
    campaign.write_text("schema = 1", encoding="utf-8")
    with raises("file-exists", "file of a log"):
        LOG.write(campaign, overwrite=True)
    assert campaign.read_text(encoding="utf-8") == "schema = 1"


def test_missing_file_or_folder_raises(tmp_path):
    with pytest.raises(RecordError, match="file not found"):
        Log.read(tmp_path / "none.json")
    with pytest.raises(CounterspinError, match="cannot be written"):
        LOG.write(tmp_path / "none" / "log.json")


def test_all_result_classes_share_file_methods():
    for module in walk_packages(counterspin.__path__, "counterspin."):
        if module.name.rpartition(".")[2].startswith("result"):
            import_module(module.name)
    for name in ("calibration.batch", "reproduction.plan", "validation.page"):
        import_module(f"counterspin.{name}")
    files = {
        cls.__name__: cls
        for cls in ReportableResult.__subclasses__()
        if cls.__module__.startswith("counterspin.")
    }
    assert set(files) == {
        "AppliedAcceleration",
        "OperatingTests",
        "BatchResult",
        "CheckedRun",
        "ResultComparison",
        "Dossier",
        "History",
        "Intercomparison",
        "NoiseResult",
        "PlanResult",
        "RepeatedCalibration",
        "Reproduction",
        "Result",
        "StudyResult",
        "WatchState",
    }
    for cls in files.values():
        assert not {"to_json", "write", "read", "json_schema"} & set(vars(cls))
        assert "schema" in cls.json_schema()["properties"]


def test_edited_file_raises_and_reformatted_file_is_read(tmp_path):
    path = tmp_path / "log.json"
    LOG.write(path)
    document = json.loads(path.read_text(encoding="utf-8"))
    document["series"][0] = 1  # the same number
    path.write_text(json.dumps(document, indent=4, sort_keys=True), encoding="utf-8")
    read = Log.read(path)
    assert (read == Log.read(path), read.sealed, read.seal) == (True, True, None)
    for key, value in (("series", [1.0, None, 3.5]), ("rooms", {"attic": {"value": 281.5}})):
        path.write_text(json.dumps(document | {key: value}), encoding="utf-8")
        with raises("result-altered"):
            Log.read(path)


def test_file_without_seal_is_read_and_written_without_seal(tmp_path):
    path = tmp_path / "log.json"
    path.write_text('{"schema": 1, "rooms": {"cellar": {"value": 1}}, "series": []}', "utf-8")
    read = Log.read(path)
    assert not read.sealed
    changed = read.model_copy(update={"series": [1.0]})
    for kept in (read, changed):
        kept.write(tmp_path / "again.json", overwrite=True)
        assert json.loads((tmp_path / "again.json").read_text("utf-8"))["seal"] is None
        assert not Log.read(tmp_path / "again.json").sealed


@pytest.mark.parametrize("more", ['"series": [9.0]', '"rooms": {}', r'"ser\u0069es": [9.0]'])
def test_duplicate_key_raises(tmp_path, more):
    # Programs differ in which of two they read; the seal is that of one of them.
    path = tmp_path / "log.json"
    LOG.write(path)
    whole = path.read_text(encoding="utf-8")
    for text in (
        f"{{{more}, {whole.lstrip()[1:]}",
        whole.replace('"value"', '"value": 1, "value"', 1),
    ):
        path.write_text(text, encoding="utf-8")
        with raises("file-damaged", "the key '"):
            Log.read(path)


def test_content_is_bytes_of_file(tmp_path):
    path = tmp_path / "log.json"
    LOG.write(path)
    assert LOG.content == path.read_bytes()
    path.write_bytes(b" \n" + path.read_bytes())
    read = Log.read(path)
    assert read.content == path.read_bytes() != LOG.content
    assert read.model_copy().content == read.content
    assert (
        read.model_copy(update={"series": []}).content
        == Log(rooms=LOG.rooms, series=[]).to_json().encode()
    )


def test_dir_lists_no_pydantic_names():
    names = dir(LOG)
    assert {"rooms", "series", "to_json", "write", "read", "content"} <= set(names)
    assert [name for name in names if "model" in name or name == "copy"] == []
    assert "value" in dir(LOG.rooms["cellar"])
    assert [name for name in names if name.isupper()] == []


def test_unknown_name_suggests_closest_name():
    parts = NamedParts(K_II=1, K_III=2)
    assert (parts["K_II"], parts.get("k"), "k" in parts) == (1, None, False)
    with pytest.raises(KeyError) as caught:
        parts["k_ii"]
    assert str(caught.value) == "'k_ii' is not in this result; did you mean \"K_II\"?"
    with pytest.raises(UnknownNameError, match="known: K_II, K_III"):
        parts["nothing"]
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


@pytest.mark.parametrize(
    "call",
    [
        *(counterspin.calibrate, counterspin.read_campaign, counterspin.study, counterspin.init),
        *(counterspin.plan, Log.read, lambda value: counterspin.history([value])),
    ],
)
def test_argument_of_wrong_type_raises_clear_error(call):
    with pytest.raises(TypeError, match=r"give .*, as text or a path, not 123 \(int\)"):
        call(123)
    with pytest.raises(TypeError, match="as text or a path, not an object of type list"):
        call([0.0] * 1000)


@pytest.mark.parametrize("paths", [5, "results", Path("results")])
def test_history_requires_list(paths):
    with pytest.raises(TypeError, match="give a list of results, their files or folders, not"):
        counterspin.history(paths)


def test_report_requires_result(tmp_path):
    for make in (
        lambda: counterspin.report(3, "html"),
        lambda: counterspin.write_report(3, tmp_path / "r.html"),
    ):
        with pytest.raises(TypeError, match=r"give a counterspin result, not 3 \(int\)"):
            make()
    assert list(tmp_path.iterdir()) == []


def test_laboratory_data_of_wrong_type_raise():
    with pytest.raises(TypeError, match=r"give a mapping with the laboratory data, .* not 5"):
        read_lab(5, None)
