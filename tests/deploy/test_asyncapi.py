"""AsyncAPI document, checked by AsyncAPI's parser (installed by ``make integrations``)."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from bms_estimator.cli.settings.asyncapi import document
from tests.patience import LONG_S

NODE = shutil.which("node")
FOLDER = Path(__file__).parents[2] / ".node"
PARSE = """
const { Parser } = require('@asyncapi/parser');
const fs = require('fs');
new Parser().parse(fs.readFileSync(0, 'utf8')).then(({ document, diagnostics }) => {
    // severity 0: error, 1: warning
    const faults = diagnostics.filter((d) => d.severity < 2).map((d) => `${d.path.join('.')}: ${d.message}`);
    console.log(JSON.stringify({ faults, channels: document ? document.channels().all().length : 0 }));
});
"""


def test_asyncapi_parser_finds_no_fault_in_the_document() -> None:
    if NODE is None or not (FOLDER / "node_modules/@asyncapi/parser").is_dir():
        pytest.skip("@asyncapi/parser is not installed (make integrations)")
    asyncapi = document("bms")
    parsed = subprocess.run(
        [NODE, "-e", PARSE],
        input=json.dumps(asyncapi),
        cwd=FOLDER,
        capture_output=True,
        text=True,
        timeout=LONG_S,
        check=True,
    )
    assert json.loads(parsed.stdout) == {"faults": [], "channels": len(asyncapi["channels"])}
