"""The wheel, really built, lists its dependencies: versions and digests of requirements.lock."""

import importlib.metadata
import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def bom(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder]
    subprocess.run(command, cwd=PROJECT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if ".dist-info/sboms/" in name)
        return json.loads(archive.read(name))


def needed(name: str, found: set[str]) -> set[str]:
    """Return the installed dependencies of a package, without its extras."""
    for line in importlib.metadata.requires(name) or ():
        other = re.split(r"[^\w.-]", line)[0].lower().replace("_", "-")
        if ";" not in line and other not in found:
            found.add(other)
            needed(other, found)
    return found


def test_every_package_of_the_service_is_named_and_none_of_the_tests_alone(bom):
    named = {one["name"] for one in bom["components"]}
    assert needed("bms_estimator", set()) <= named
    assert not named & {"pytest", "ruff", "pybamm"}


def test_versions_and_digests_are_those_of_the_lock(bom):
    lock = (PROJECT / "requirements.lock").read_text()
    for one in bom["components"]:
        entry = re.search(rf"(?m)^{re.escape(one['name'])}=={re.escape(one['version'])}[ \\].*\n(?:    .*\n)+", lock)
        assert entry, one["name"]
        digests = [digest["content"] for digest in one["hashes"]]
        assert digests == re.findall("sha256:([0-9a-f]+)", entry[0])
        assert digests


def test_it_is_cyclonedx_whose_references_meet(bom):
    assert (bom["bomFormat"], bom["specVersion"]) == ("CycloneDX", "1.6")
    refs = {one["bom-ref"] for one in bom["components"]} | {bom["metadata"]["component"]["bom-ref"]}
    assert len(refs) == len(bom["components"]) + 1
    assert {one["ref"] for one in bom["dependencies"]} == refs
    assert {other for one in bom["dependencies"] for other in one["dependsOn"]} < refs
