"""Tests of the page scripts without a browser: requests, the key, elements, jobs."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

ASSETS = Path(__file__).parents[2] / "src" / "counterspin" / "application" / "assets"
SCRIPTS = Path(__file__).parent / "scripts"


def test_page_scripts_pass_their_tests(tmp_path):
    node = shutil.which("node")
    if node is None:
        pytest.skip("the page's scripts: there is no node (apt install nodejs)")
    for script in (*ASSETS.glob("*.js"), *SCRIPTS.glob("*.js")):
        shutil.copy(script, tmp_path)
    (tmp_path / "package.json").write_text('{"type": "module"}', encoding="utf-8")
    process = subprocess.run(
        [node, "--test", "--test-reporter=tap"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    text = (SCRIPTS / "page.test.js").read_text(encoding="utf-8")
    passed = re.search(r"^# pass (\d+)$", process.stdout, re.MULTILINE)
    assert int(passed[1]) >= len(re.findall(r"^test\(", text, re.MULTILINE)) >= 18
