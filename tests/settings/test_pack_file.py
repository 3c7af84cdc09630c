"""New settings files: nothing is overwritten, no part of a file remains, and a missing folder is found before the questions."""

import re

import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import create_pack_file, require_new


def test_full_disk_leaves_no_part_of_the_file(full_disk):
    with pytest.raises(UserError, match="No space left on device"):
        create_pack_file(full_disk / "pack.toml")
    assert [path.name for path in full_disk.iterdir()] == ["file"]


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(UserError, match=re.escape(f"there is no folder {tmp_path / 'missing'}; create it")):
        require_new(tmp_path / "missing" / "pack.toml")


def test_link_without_a_target_is_not_replaced(tmp_path):
    (tmp_path / "pack.toml").symlink_to("unplugged")
    with pytest.raises(UserError, match="exists already"):
        require_new(tmp_path / "pack.toml")
