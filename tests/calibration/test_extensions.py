"""A calibration without an extra gives the same numbers and states."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from campaigns import SMALL, replace_parts, write_description

import counterspin
from counterspin.simulation.simulate import simulate

PACKAGE = Path(counterspin.__file__).parent

#: Packages that import readings, and triads.
ABOVE_READINGS = {
    *("application", "ingest", "monitoring", "planning", "reproduction", "schemas", "simulation"),
    "studies",
}

#: Extra -> its modules and the packages that import it, directly or indirectly.
EXTRAS = {
    "diagnosis": (("calibration/diagnosis", "inference/joint/mistakes.py"), set()),
    "two-stage": (
        ("calibration/two_stage", "inference/two_stage"),
        {"application", "reproduction", "schemas", "studies", "validation"},
    ),
    "conformity": (
        ("calibration/conformity.py", "campaign/specification.py", "inference/conformity.py"),
        {"acceleration_standard", "application", "certificates", "schemas", "validation"},
    ),
    "notebook": (("calibration/result_conversion.py",), set()),
    "formats": (
        (
            *("records/array_files.py", "records/tdms_file.py", "records/table_files.py"),
            *("records/reader_process.py", "records/reader_limits.py"),
        ),
        set(),
    ),
    "triads": (("triads",), ABOVE_READINGS),
    "readings": (("readings", "triads"), ABOVE_READINGS),
}

#: Fields of an accelerometer that an extra fills; the state follows its findings.
FILLED = {"diagnosis": {"findings", "state", "warnings"}, "two-stage": {"two_stage"}}

#: Statements that the records contradict strongly.
CONTRADICTED = {
    "prior": ('"1.002 g/g"\ndisp', '"1.003 ± 1e-6 g/g"\ndisp'),
    "noise": ('[noise]\ndisplacement = "0.01 m"', '[noise]\ndisplacement = "0.001 m"'),
}

#: Print, for each line with folders, the packages with missing imports and the results
#: of campaigns. Import counterspin again for each line, and its dependencies once.
PROGRAM = """
import importlib, json, pkgutil, sys

def run(folders):
    for name in [name for name in sys.modules if name.partition(".")[0] == "counterspin"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    import counterspin
    from counterspin.calibration.calibrate import calibrate

    lost = set()
    for module in pkgutil.walk_packages(counterspin.__path__, "counterspin.", lost.add):
        if not module.name.endswith("__main__"):
            try:
                importlib.import_module(module.name)
            except ModuleNotFoundError as error:
                assert error.name.startswith("counterspin."), error
                lost.add(module.name)
    return sorted(lost), [json.loads(calibrate(folder).to_json()) for folder in folders]

for line in sys.stdin:
    print(json.dumps(run(json.loads(line))), flush=True)
"""


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return folders of a correct campaign and of two with a contradicted statement."""
    root = tmp_path_factory.mktemp("campaigns")
    campaign_folders = []
    for name, change in {"right": None, **CONTRADICTED}.items():
        (root / name).mkdir()
        simulate(write_description(root / name, SMALL, "plan.toml"), root / name / "records")
        description = root / name / "records" / "campaign.toml"
        if change is not None:
            description.write_text(replace_parts(description.read_text("utf-8"), change), "utf-8")
        campaign_folders.append(description.parent)
    return campaign_folders


@pytest.fixture(scope="module")
def run_without_modules(tmp_path_factory, folders):
    """Yield a function that runs the program with a copy of the package."""
    root = tmp_path_factory.mktemp("package")
    # Copy the bytecode, which the processes would otherwise compile again.
    shutil.copytree(PACKAGE, root / "counterspin")

    @contextmanager
    def remove_modules(modules):
        package, removed = root / "counterspin", root / "removed"
        removed.mkdir()
        try:
            for name in modules:
                (package / name).rename(removed / name.replace("/", "-"))
            yield
        finally:
            for name in modules:
                (removed / name.replace("/", "-")).rename(package / name)
            removed.rmdir()

    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "PYTHONPATH": str(root)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        encoding="utf-8",
    ) as process:

        def run_without(modules=(), campaigns=3):
            with remove_modules(modules):
                chosen = [str(folder) for folder in folders[:campaigns]]
                print(json.dumps(chosen), file=process.stdin)
                process.stdin.flush()
                lost, results = json.loads(process.stdout.readline())
            return lost, results

        yield run_without


@pytest.fixture(scope="module")
def full_results(run_without_modules):
    lost, results = run_without_modules()
    assert lost == []
    assert [result["state"] for result in results[1:]] == ["contradicted"] * len(CONTRADICTED)
    return results


@pytest.mark.slow
@pytest.mark.parametrize("extra", EXTRAS)
def test_calibration_does_not_need_extra(run_without_modules, full_results, extra):
    modules, dependents = EXTRAS[extra]
    # Only the diagnosis uses both contradicted statements.
    campaigns = 3 if extra == "diagnosis" else 2
    lost, results = run_without_modules(modules, campaigns)
    assert {name.split(".")[1] for name in lost} <= dependents
    for result, expected in zip(results, full_results[:campaigns], strict=True):
        assert result["state"] == expected["state"]
        assert result["runs"] == expected["runs"]
        for name, accelerometer in expected["accelerometers"].items():
            filled = FILLED.get(extra, set())
            actual_accelerometer = result["accelerometers"][name]
            different = {
                key for key, value in accelerometer.items() if actual_accelerometer[key] != value
            }
            assert different <= filled
