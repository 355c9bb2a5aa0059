"""Uncertainty budget of a centrifuge: stated and default sources, levels, command, errors."""

import math

import pytest
from arm_centrifuge import DESCRIPTION, STATED
from raising import raises

import counterspin as cs
from counterspin.acceleration_standard.page import applied_blocks, relative_plot
from counterspin.acceleration_standard.result import AppliedAcceleration
from counterspin.cli import main
from counterspin.errors import CampaignError
from counterspin.physics.terms import TABLE
from counterspin.reports.blocks import Paragraph


@pytest.fixture
def write_campaign(tmp_path):
    """Return a function that writes a description and returns its folder."""

    def write(text=DESCRIPTION):
        (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
        return tmp_path

    return write


def test_unstated_sources_have_default_uncertainty(write_campaign):
    result = cs.applied(write_campaign(), "2g, 5 g")
    by_origin = {source.name: source.origin for source in result.applied_sources}
    defaults = {"elevation", "azimuth", "droop", "clock"}
    assert {name for name, origin in by_origin.items() if origin == "default"} == defaults
    assert result.source("droop").u == TABLE["centrifuge.droop"].typical
    assert result.source("elevation").u == 5e-5
    assert result.source("clock").u == TABLE["centrifuge.clock"].typical
    assert result.source("rate").u == pytest.approx(2e-6 / 9.9)
    assert [level.level for level in result.levels] == pytest.approx([2.0, 5.0])
    assert any(
        "centrifuge.droop" in block.text and block.style == "warning"
        for block in applied_blocks(result)
        if isinstance(block, Paragraph)
    )


def test_stated_alignment_and_sense_of_rotation_are_used(write_campaign):
    result = cs.applied(write_campaign(DESCRIPTION + STATED))
    (level,) = result.levels
    assert (result.mounting, level.rate) == ("in", -9.9)
    assert result.source("elevation").u == pytest.approx(math.radians(2.0 / 3600.0))
    assert (result.source("droop").u, result.source("droop").origin) == (1e-9, "stated")
    # The Earth's rotation slows a clockwise arm: 2 w Omega R sin L.
    earth = -2.0 * 9.9 * 7.292115e-5 * math.sin(math.radians(45.75))
    assert level.acceleration == pytest.approx(9.9**2 + earth, rel=1e-12)
    assert sum(line.share for line in level.budget) == pytest.approx(1.0)


def test_assumed_term_has_zero_uncertainty(write_campaign):
    exact = '[model]\nassume = ["centrifuge.droop", "centrifuge.clock"]\n'
    result = cs.applied(write_campaign(DESCRIPTION + exact), [1.0])
    assert {result.source(name).origin for name in ("droop", "clock")} == {"assumed"}
    assert {result.source(name).u for name in ("droop", "clock")} == {0.0}


def test_command_writes_result_report_and_figure(write_campaign, tmp_path, capsys):
    path = write_campaign(DESCRIPTION + STATED)
    files = [tmp_path / name for name in ("a.json", "a.md", "a.svg")]
    options = ("--json", "--report", "--figure")
    words = [word for pair in zip(options, map(str, files), strict=True) for word in pair]
    assert main(["applied", str(path), "--levels", "1,10,50,100g", "--budget", *words]) == 0
    assert "Combined" in capsys.readouterr().out
    result = AppliedAcceleration.read(files[0])
    assert result.table().height == 4
    assert files[1].read_text("utf-8").count("| Combined") == 4
    combined, _, *sources = relative_plot(result).series
    assert combined.x == tuple(level.level for level in result.levels)
    for index, level in enumerate(result.levels):
        # Sources below 1 % of every variance are not drawn.
        drawn = math.hypot(*(series.y[index] or 0.0 for series in sources))
        assert 0.97 * level.u_relative < drawn <= level.u_relative * (1.0 + 1e-12)
    assert main(["report", str(files[0])]) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"levels": "1,-2g"}, r'`levels`: "-2g" must be an acceleration between 0 and'),
        ({"levels": "1 s"}, r'`levels`: "1 s"'),
        ({"levels": ""}, "`levels`"),
        ({"levels": []}, "give one or more"),
        ({"draws": 10}, "`draws`: must be from 200000"),
        ({"seed": -1}, "`seed`"),
        ({"mounting": "out"}, 'unknown mounting "out"; known: in'),
    ],
)
def test_rejects_invalid_options(write_campaign, options, message):
    with pytest.raises(CampaignError, match=message):
        cs.applied(write_campaign(), **options)


def test_different_alignments_require_mounting(write_campaign):
    second = DESCRIPTION[DESCRIPTION.index("[[runs]]") :].replace('"in"', '"out"', 2)
    priors = STATED + '"fixture.misalignment.out" = "0 ± 5 arcsec"\n'
    path = write_campaign(DESCRIPTION + second + priors)
    with raises("wrong-usage", "in, out", "`mounting`"):
        cs.applied(path)
    result = cs.applied(path, mounting="out")
    assert result.source("azimuth").u == pytest.approx(math.radians(5.0 / 3600.0))


def test_rejects_campaign_without_centrifuge(write_campaign):
    at_rest = DESCRIPTION[: DESCRIPTION.index("[centrifuge]")] + (
        '[[runs]]\nname = "up"\nmotion = "static"\nattitude = "0 deg about north"\n'
        'reading = "1.0 ± 1e-6 g"\n'
    )
    with pytest.raises(CampaignError, match=r"centrifuge\.radius: missing"):
        cs.applied(write_campaign(at_rest), [1.0])
