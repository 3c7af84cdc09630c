"""SBOM in the wheel: it lists the dependencies with the versions and hashes of requirements.lock."""

import importlib.metadata
import json
import re
import zipfile

from tests.deploy.core_environment import PROJECT, build_wheel


def runtime_dependencies(requirements: list[str], found: set[str]) -> set[str]:
    """Add the packages of ``requirements`` and their installed dependencies, without extras, to ``found``; return it."""
    for line in requirements:
        other = re.split(r"[^\w.-]", line)[0].lower().replace("_", "-")
        if ";" not in line and other not in found:
            found.add(other)
            runtime_dependencies(importlib.metadata.requires(other) or [], found)
    return found


def test_wheel_lists_its_dependencies_as_locked(tmp_path):
    with zipfile.ZipFile(build_wheel(tmp_path)) as archive:
        (name,) = (name for name in archive.namelist() if ".dist-info/sboms/" in name)
        bom = json.loads(archive.read(name))
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        requirements = re.findall(r"(?m)^Requires-Dist: (.*)$", archive.read(metadata).decode())
    assert bom["metadata"]["component"]["version"] == importlib.metadata.version("bms_estimator")
    listed = {component["name"] for component in bom["components"]}
    assert runtime_dependencies(requirements, set()) <= listed
    assert not listed & {"pytest", "ruff", "pybamm"}
    lock = (PROJECT / "requirements.lock").read_text()
    for component in bom["components"]:
        pattern = rf"(?m)^{re.escape(component['name'])}=={re.escape(component['version'])}[ \\].*\n(?:    .*\n)+"
        hashes = {digest["content"] for digest in component["externalReferences"][0]["hashes"]}
        assert hashes == set(re.findall("sha256:([0-9a-f]+)", re.search(pattern, lock)[0]))
