"""Collect counterspin and all its pinned dependencies as wheels in one folder.

A machine without a network installs counterspin from that folder. The machine that collects the
wheels needs a network, and may be of another platform.

pip reads the condition of a requirement, such as ``sys_platform == 'win32'``, for the machine that
it runs on. This program reads it for the machine that counterspin is installed on.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
PINS = ROOT / "requirements" / "package.txt"

#: Beginning of a platform's tag -> what markers of requirements call that platform.
SYSTEMS = {
    "win_": {"sys_platform": "win32", "os_name": "nt", "platform_system": "Windows"},
    "macosx_": {"sys_platform": "darwin", "os_name": "posix", "platform_system": "Darwin"},
    "manylinux_2_": {"sys_platform": "linux", "os_name": "posix", "platform_system": "Linux"},
}
#: Names of the older tags of manylinux: minor version of glibc -> name.
MANYLINUX = {17: "manylinux2014", 12: "manylinux2010", 5: "manylinux1"}

INSTRUCTIONS = """\
counterspin {version} and its dependencies for {platform}, Python {python}.

Installation without a network. Run these lines in the folder that contains this file.

Windows (PowerShell):
  py -{python} -m venv venv
  .\\venv\\Scripts\\python -m pip install --no-index --find-links . "counterspin[{extras}]"
  .\\venv\\Scripts\\counterspin demo

macOS and Linux:
  python{python} -m venv venv
  venv/bin/python -m pip install --no-index --find-links . "counterspin[{extras}]"
  venv/bin/counterspin demo

Upgrade: run the second line of a newer folder, with --upgrade after "install".
"""
EXTRAS = "application,cluster,excel,signature,tdms"


def pip_platforms(platform: str) -> list[str]:
    """Return the tags of the wheels that a platform accepts: on Linux also those of older glibc."""
    newest = re.fullmatch(r"manylinux_2_(\d+)_(\w+)", platform)
    if newest is None:
        return [platform]
    tags = []
    for minor in range(int(newest[1]), 4, -1):
        tags.append(f"manylinux_2_{minor}_{newest[2]}")
        if minor in MANYLINUX:
            tags.append(f"{MANYLINUX[minor]}_{newest[2]}")
    return tags


def marker_environment(platform: str | None, python: str) -> dict[str, str]:
    """Return what markers of requirements are compared with on the machine that installs."""
    environment = {"python_version": python, "python_full_version": f"{python}.0", "extra": ""}
    if platform is not None:
        system = next((words for tag, words in SYSTEMS.items() if platform.startswith(tag)), None)
        if system is None:
            raise SystemExit(f"{platform}: give a tag that begins with {', '.join(SYSTEMS)}")
        machine = re.sub(r"win_|macosx_\d+_\d+_|manylinux_2_\d+_", "", platform)
        environment |= {**system, "platform_machine": machine.replace("amd64", "AMD64")}
    return environment


def selected_pins(text: str, environment: dict[str, str]) -> Iterator[str]:
    """Yield the pins of a requirements file that apply, each with its hashes and without marker."""
    for block in re.split(r"\n(?=\S)", re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE)):
        words = block.replace("\\\n", " ").split(" --hash=")
        requirement = Requirement(words[0].strip())
        if requirement.marker is None or requirement.marker.evaluate(environment):
            hashes = " ".join(f"--hash={word.strip()}" for word in words[1:])
            yield f"{requirement.name}{requirement.specifier} {hashes}"


def collect(folder: Path, platform: str | None, python: str) -> None:
    """Fill a folder with the wheels, and a file of instructions."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "--no-input"]
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run([*pip, *build], check=True)
    pins = selected_pins(PINS.read_text("utf-8"), marker_environment(platform, python))
    (folder / "pins.txt").write_text("\n".join(pins) + "\n", "utf-8")
    words = ["download", "--no-deps", "--only-binary", ":all:", "--require-hashes"]
    words += ["--requirement", str(folder / "pins.txt"), "--dest", str(folder)]
    words += ["--python-version", python]
    for tag in [] if platform is None else pip_platforms(platform):
        words += ["--platform", tag]
    subprocess.run([*pip, *words], check=True)
    (wheel,) = folder.glob("counterspin-*.whl")
    text = INSTRUCTIONS.format(
        version=wheel.name.split("-")[1],
        platform=platform or "the platform of this machine",
        python=python,
        extras=EXTRAS,
    )
    (folder / "INSTALL.txt").write_text(text, "utf-8")
    print(text)
    wheels = list(folder.glob("*.whl"))
    size = sum(wheel.stat().st_size for wheel in wheels) / 1e6
    print(f"Wrote {len(wheels)} wheels, {size:.0f} MB, to {folder}.")


def main() -> None:
    """Read the command line and collect the wheels."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--platform", help="win_amd64, macosx_14_0_arm64, manylinux_2_28_x86_64")
    parser.add_argument("--python", default=".".join(map(str, sys.version_info[:2])))
    parser.add_argument("--folder", type=Path, default=Path("build/wheelhouse"))
    given = parser.parse_args()
    collect(given.folder, given.platform or None, given.python)


if __name__ == "__main__":
    main()
