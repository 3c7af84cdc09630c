"""Check the packages of requirements.lock for known vulnerabilities. Exit code 0: none; 1: some; 3: data cannot be reached."""

import json
import subprocess
import sys
from pathlib import Path

VULNERABLE, UNREACHABLE = 1, 3


def main() -> int:
    """Run pip-audit of this environment. Its own exit code is 0 for packages without data, and is therefore not used."""
    lock = Path(__file__).parents[1] / "requirements.lock"
    command = [sys.executable, "-m", "pip_audit", "--disable-pip", "--require-hashes", "-f", "json", "-r", str(lock)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - no argument is input
    try:
        packages = json.loads(done.stdout)["dependencies"]
    except ValueError:
        sys.stderr.write(f"not audited: {done.stderr[-500:]}\n")
        return UNREACHABLE
    found = [(package, vulnerability) for package in packages for vulnerability in package.get("vulns", ())]
    for package, vulnerability in found:
        fixed = ", ".join(vulnerability["fix_versions"]) or "no version yet"
        sys.stdout.write(f"{package['name']} {package['version']}: {vulnerability['id']}, fixed in {fixed}\n")
    unknown = [package["name"] for package in packages if "skip_reason" in package]
    sys.stdout.write(
        f"{len(packages) - len(unknown)} of {len(packages)} packages audited, {len(found)} known vulnerabilities\n"
    )
    if unknown:
        sys.stderr.write(f"not audited, the data of these cannot be reached: {', '.join(unknown)}\n")
    return VULNERABLE if found else UNREACHABLE if unknown else 0


if __name__ == "__main__":
    sys.exit(main())
