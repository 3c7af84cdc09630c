"""Budget of statements: exit with 1 if package or tests have more. A commit that raises a limit states the reason."""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMITS = {"bms_estimator": 45_538, "tests": 49_647}


def is_text(node: ast.stmt) -> bool:
    """Return True for a docstring and other strings without effect."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def count(folder: Path) -> int:
    """Return the number of statements of all modules of a folder, without strings."""
    modules = (ast.parse(path.read_text(encoding="utf-8")) for path in folder.rglob("*.py"))
    return sum(isinstance(node, ast.stmt) and not is_text(node) for module in modules for node in ast.walk(module))


counts = {name: count(ROOT / name) for name in LIMITS}
for name, limit in LIMITS.items():
    if counts[name] > limit:
        sys.stdout.write(f"{name}: {counts[name]} statements, {counts[name] - limit} above the limit in {__file__}\n")
sys.exit(any(counts[name] > limit for name, limit in LIMITS.items()))
