"""bin/test: linter, type checker and tests. `--slow` adds the long tests; other arguments go to pytest."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def main(argv: list[str] | None = None) -> int:
    """Runs the checks of this checkout; returns the first failing exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    root = Path(__file__).resolve().parents[2]
    if not (root / "tests").is_dir():
        print(f"test: {root} holds no tests: run bin/test in a checkout of the project", file=sys.stderr)
        return 2
    selected = any(not a.startswith("-") for a in arguments)  # paths were named: only those tests, no linting
    steps = [] if selected else [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"]]
    steps.append(["pytest", "-n", "2", *arguments])
    for step in steps:
        print("$", " ".join(step), flush=True)
        status = subprocess.run([sys.executable, "-m", *step], cwd=root).returncode
        if status:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
