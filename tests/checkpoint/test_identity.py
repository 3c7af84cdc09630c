"""Identities of saved files. A change of the code that changes an identity would discard every pack's state."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bms_estimator.checkpoint.identity import observer_identity, pack_identity
from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.fleet.packs.pack_type import config_digest
from bms_estimator.kernels.records import ESTIMATOR_STATE
from bms_estimator.model.arrays import fields
from bms_estimator.model.cell import load_cell
from bms_estimator.model.pack_model import PackModel, load_model
from bms_estimator.process.boot_timestamp import BootTimestamp
from bms_estimator.settings.pack import Settings

CHECKPOINT_FILE = Path(__file__).with_name("checkpoint_format_7.npz")
"""State after 30 min of a simulated ``chen_mora`` cell under current steps; SOC 0.3710."""
WITH_IDENTIFIER = {"pack": {"initial_soc": 0.5}, "publish": {"rate_hz": 10.0}}


@pytest.mark.parametrize(
    ("settings", "cell", "pack_id", "observer_id", "fleet_digest"),
    [
        (WITH_IDENTIFIER, load_model("chen_mora"), "5613cbc091ec7ec4", "77ac24e88a0d1f8b", 15431052729970494762),
        (
            {"sensor": {"current_sign": "charge_positive"}, "identifier": {"enabled": False}},
            load_cell("leaf").pack(2, 3),
            "1f291d5895e57362",
            "06eca6aa573c6d46",
            12826646859050909060,
        ),
        ({}, load_model("pem_30w"), "c5d3c64ecb5da3be", "443c82b27a91fe8c", 7172455394262107276),
    ],
    ids=["chen_mora", "leaf", "pem_30w"],
)
def test_identities_and_digest_are_those_of_released_versions(
    settings: dict[str, Any], cell: PackModel, pack_id: str, observer_id: str, fleet_digest: int
) -> None:
    validated = Settings.model_validate(settings)
    assert pack_identity(validated, cell).startswith(pack_id)
    assert observer_identity(validated, cell).startswith(observer_id)
    assert config_digest(validated, cell)[0] == fleet_digest


def test_the_state_has_the_fields_of_checkpoint_format_7() -> None:
    """Additional fields are allowed, because they get their values from a first sample."""
    present = dict(fields(np.zeros(1, ESTIMATOR_STATE)))
    with np.load(CHECKPOINT_FILE) as file:
        for name, field in fields(file["state"]):
            assert (name, present[name].dtype, present[name].shape) == (name, field.dtype, field.shape)


def test_a_checkpoint_of_format_7_is_restored(tmp_path: Path) -> None:
    settings, cell = Settings.model_validate(WITH_IDENTIFIER), load_model("chen_mora")
    with np.load(CHECKPOINT_FILE) as file:
        minute_later = BootTimestamp(float(file["wall_s"]) + 60.0, True, 0.0, "another boot")
    files = StateFiles(tmp_path, settings, cell, lambda: minute_later)
    files.checkpoint.path.write_bytes(CHECKPOINT_FILE.read_bytes())
    restored = files.read()
    assert not restored.reasons
    saved = files.run_file.load()
    assert (saved.counters.restarts, saved.lost_reason, saved.is_damaged) == (4, "", False)
    assert restored.record["observer.soc"][0] == 0.3709922542638329
