"""The wheels for a machine without a network are those that fit its platform."""

import re
import tomllib

import pytest
from requirements import wheelhouse

TEXT = """\
# a comment
alpha==1.0 \\
    --hash=sha256:aa \\
    --hash=sha256:ab
    # via beta
beta==2.0 ; sys_platform == 'win32' \\
    --hash=sha256:bb
gamma==3.0 ; sys_platform != 'win32' and python_full_version < '3.12' \\
    --hash=sha256:cc
delta==4.0 ; platform_machine == 'arm64' \\
    --hash=sha256:dd
"""
ALPHA = "alpha==1.0 --hash=sha256:aa --hash=sha256:ab"


@pytest.mark.parametrize(
    ("platform", "python", "more"),
    [
        ("win_amd64", "3.11", ["beta==2.0 --hash=sha256:bb"]),
        ("win_arm64", "3.11", ["beta==2.0 --hash=sha256:bb", "delta==4.0 --hash=sha256:dd"]),
        ("macosx_14_0_arm64", "3.12", ["delta==4.0 --hash=sha256:dd"]),
        ("manylinux_2_28_x86_64", "3.11", ["gamma==3.0 --hash=sha256:cc"]),
        ("manylinux_2_28_x86_64", "3.12", []),
    ],
)
def test_markers_are_evaluated_for_target_machine(platform, python, more):
    environment = wheelhouse.marker_environment(platform, python)
    assert list(wheelhouse.selected_pins(TEXT, environment)) == [ALPHA, *more]


def test_invalid_platform_tag_raises():
    with pytest.raises(SystemExit, match="windows: give a tag that begins with win_, macosx_"):
        wheelhouse.marker_environment("windows", "3.12")


def test_linux_accepts_older_manylinux_tags():
    tags = wheelhouse.pip_platforms("manylinux_2_18_aarch64")
    assert tags[:3] == [
        "manylinux_2_18_aarch64",
        "manylinux_2_17_aarch64",
        "manylinux2014_aarch64",
    ]
    assert tags[-1] == "manylinux1_aarch64"
    assert wheelhouse.pip_platforms("win_amd64") == ["win_amd64"]


def test_every_pin_is_selected_for_a_platform():
    text = wheelhouse.PINS.read_text("utf-8")
    names = set(re.findall(r"^([a-z0-9.-]+==[^ ]+)", text, re.MULTILINE))
    selected = {
        pin.partition(" ")[0]
        for platform in ("win_amd64", "macosx_14_0_arm64", "manylinux_2_28_x86_64")
        for python in ("3.11", "3.12", "3.14", "3.15")
        for pin in wheelhouse.selected_pins(text, wheelhouse.marker_environment(platform, python))
    }
    assert selected == names


def test_instructions_name_all_extras_and_no_index():
    project = tomllib.loads((wheelhouse.ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = set(project["optional-dependencies"]) - {"bench", "dev", "docs"}
    assert set(wheelhouse.EXTRAS.split(",")) == extras
    lines = [line for line in wheelhouse.INSTRUCTIONS.splitlines() if "pip install" in line]
    assert len(lines) == 2
    assert all("--no-index --find-links . " in line for line in lines)
