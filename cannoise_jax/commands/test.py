"""bin/test: linter, type checker and tests. `--slow` adds the long tests; other arguments go to pytest."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from cannoise_jax.commands.parser import OneLineParser


def main(argv: list[str] | None = None) -> int:
    """Runs the checks of this checkout; returns the first failing exit status."""
    parser = OneLineParser(
        prog="bin/test",
        usage="bin/test [--slow] [PATH ...] [pytest's own flags]",
        description="Runs ruff check, ruff format --check, mypy and all tests on two processes. With paths "
        "it runs only the tests there, and no linter.",
        epilog="Everything else goes to pytest, as -k NAME, -x or --durations=50.",
        passes_on=True,
    )
    parser.add_argument("--slow", action="store_true", help="also the tests that take minutes (hours in all)")
    known, rest = parser.parse_known_args(sys.argv[1:] if argv is None else argv)
    arguments = [*(["--slow"] if known.slow else []), *rest]
    root = Path(__file__).resolve().parents[2]
    if not (root / "tests").is_dir():
        print(f"bin/test: {root} holds no tests: run it in a checkout of the project", file=sys.stderr)
        return 2
    # Paths that were named: only those tests, no linting.
    selected = any(not a.startswith("-") and Path(a.partition("::")[0]).exists() for a in rest)
    steps = [] if selected else [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"]]
    # A file's tests on one process: they share what is costly to make.
    shared = ["-n", "2", "--dist", "loadfile", "--no-loadscope-reorder", "--durations=20"]
    steps.append(["pytest", *shared, *arguments])
    for step in steps:
        print("$", " ".join(step), flush=True)
        try:
            status = subprocess.run([sys.executable, "-m", *step], cwd=root).returncode
        except KeyboardInterrupt:
            return 130
        if status:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
