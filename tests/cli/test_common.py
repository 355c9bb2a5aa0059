"""Messages with the names of command-line options."""

from pathlib import Path

import pytest

from counterspin import cli
from counterspin.cli.common import quote_path, translate_message


@pytest.mark.parametrize(
    ("words", "raised", "message"),
    [
        (["simulate", "x"], "set `overwrite=True`", "set --overwrite"),
        (["apply", "r", "f"], "name it with `column`", "name it with --input"),
        (["calibrate"], 'give `method="two-stage"`', "give --method two-stage"),
        (["calibrate"], "`weighted=False`, `fit_bias=True`", "--no-weighted, --fit-bias"),
        (["study"], "`keep_trials` needs `output`", "--keep-trials needs --output"),
        (["study"], '`engine="a b"`', "--engine 'a b'"),
        (["--version"], "`overwrite=True`", "`overwrite=True`"),
        ([], "`overwrite=True`", "`overwrite=True`"),
        (["init"], "`overwrite=True`", "`overwrite=True`"),
        (["calibrate"], "`directory` and `simulate`", "`directory` and `simulate`"),
        (["plan"], "`planning.plan.write_example`", "`counterspin plan --init FILE`"),
    ],
)
def test_arguments_in_messages_become_options(words, raised, message):
    assert translate_message(raised, cli.app, words) == message


def test_quoted_path_is_not_an_option():
    assert [quote_path(Path(p)) for p in ("-x", "a b", "./-y/z", "a-b")] == [
        "./-x",
        "'a b'",
        "./-y/z",
        "a-b",
    ]


def test_error_names_options_of_command(tmp_path, capsys):
    description = tmp_path / "campaign.toml"
    assert cli.main(["calibrate", str(tmp_path), "--model", "as-printed"]) == 2
    assert "also give --method two-stage" in capsys.readouterr().err
    assert not description.exists()
    assert cli.main(["history", str(tmp_path), "--term", "K_2"]) == 2
    assert capsys.readouterr().err.startswith("counterspin: --term: unknown term")
