"""Known vulnerabilities of all that requirements.lock names. Exit code 0: none; 1: some; 3: the data cannot be reached."""

import json
import subprocess
import sys
from pathlib import Path

SOME, UNREACHED = 1, 3


def main() -> int:
    """Run pip-audit of this environment, whose own exit code is 0 where it was told nothing."""
    lock = Path(__file__).parents[1] / "requirements.lock"
    command = [sys.executable, "-m", "pip_audit", "--disable-pip", "--require-hashes", "-f", "json", "-r", str(lock)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - nothing of it is input
    try:
        packages = json.loads(done.stdout)["dependencies"]
    except ValueError:
        sys.stderr.write(f"not audited: {done.stderr[-500:]}\n")
        return UNREACHED
    found = [(one, known) for one in packages for known in one.get("vulns", ())]
    for one, known in found:
        mended = ", ".join(known["fix_versions"]) or "no version yet"
        sys.stdout.write(f"{one['name']} {one['version']}: {known['id']}, mended in {mended}\n")
    unknown = [one["name"] for one in packages if "skip_reason" in one]
    sys.stdout.write(
        f"{len(packages) - len(unknown)} of {len(packages)} packages audited, {len(found)} known vulnerabilities\n"
    )
    if unknown:
        sys.stderr.write(f"not audited, the data of these cannot be reached: {', '.join(unknown)}\n")
    return SOME if found else UNREACHED if unknown else 0


if __name__ == "__main__":
    sys.exit(main())
