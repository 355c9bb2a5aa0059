"""Before all else is loaded: checksums begun, whatever the words are, and given up in the end."""

import pytest

from counterspin.campaign.head_start import checksums_of, head_start


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "campaign.toml").write_text('[[runs]]\nrecord = "a.csv"\n', "utf-8")
    (tmp_path / "a.csv").write_bytes(b"1")
    return tmp_path


def test_what_was_begun_is_handed_over_once(folder):
    with head_start(["calibrate", f"{folder}/", "--json", "result.json"]):
        with checksums_of(folder) as first:
            assert set(first._taken) == {folder / "a.csv", folder / "campaign.toml"}
            (folder / "b.csv").write_bytes(b"2")
            assert len(first.of([folder / "a.csv", folder / "b.csv"])) == 2
        with checksums_of(folder) as second:
            assert second is not first
    assert first._given_up.is_set()


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["calibrate"],
        ["calibrate", "--help"],
        ["calibrate", "--json", "{folder}"],
        ["calibrate", "{folder}", "{folder}"],
        ["check", "{folder}"],
    ],
)
def test_other_words_begin_nothing(folder, words):
    with head_start([word.format(folder=folder) for word in words]), checksums_of([]) as checksums:
        assert not checksums._taken
        with checksums_of(folder) as begun:
            assert begun._taken


@pytest.mark.parametrize("named", ["nowhere", "\0", "", "x" * 5000])
def test_what_is_no_campaign_is_for_others_to_say(named):
    with head_start(["calibrate", named]), checksums_of(named) as checksums:
        assert all(not file.exists() for file in checksums._taken if "\0" not in str(file))


def test_files_of_a_campaign_that_failed_are_given_up(folder):
    with (
        pytest.raises(KeyboardInterrupt),
        head_start(["calibrate", str(folder)]),
        checksums_of(folder) as checksums,
    ):
        raise KeyboardInterrupt
    assert checksums._given_up.is_set()
    with checksums_of(folder) as again:
        assert again is not checksums
