"""Version of a build: it has the commit, or the written version without Git's history."""

import re

import pytest

from tests.deploy.built_version import link_project, versions
from tests.deploy.core_environment import PROJECT

WRITTEN = re.search(r'(?m)^fallback-version = "(.*)\.dev0"', (PROJECT / "pyproject.toml").read_text())[1]
"""Next release."""


def test_each_commit_has_a_version_and_that_of_a_release_is_its_tag(tmp_path):
    script = "commit; version; git tag stage-68; commit; version; git tag v7.1.0; version; commit; version"
    built = versions(link_project(tmp_path / "project"), script)
    assert [each.partition("+g")[0] for each in built] == [f"{WRITTEN}.dev1", f"{WRITTEN}.dev2", "7.1.0", "7.1.1.dev1"]
    assert len({each.partition("+g")[2] for each in built}) == 4


def test_shallow_clone_and_source_archive_have_the_commit(tmp_path):
    script = """
        commit; commit; version
        git clone --quiet --depth=1 "file://$PWD" ../shallow; cd ../shallow; version
        version=$(version); hatchling build --target=sdist --directory=.. > ../built
        cd ..; tar --extract --file="bms_estimator-$version.tar.gz"; cd "bms_estimator-$version"; version
    """
    whole, shallow, archive = versions(link_project(tmp_path / "project"), script)
    assert shallow == archive
    assert whole.partition("+g")[2] == shallow.partition("+g")[2] != ""


@pytest.mark.parametrize("script", ["version", "cd ..; commit; git tag v7.1.0; cd project; version"])
def test_copy_without_history_has_the_written_version_also_within_another_project(tmp_path, script):
    assert versions(link_project(tmp_path / "project"), script) == [f"{WRITTEN}.dev0"]
