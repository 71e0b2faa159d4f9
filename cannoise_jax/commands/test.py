"""bin/test: linter, type checker and tests. `--slow` adds the long tests; other arguments go to pytest."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
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
    steps = [] if selected else [["ruff", "check", "."], ["ruff", "format", "--check", "."]]
    # A file's tests on one process: they share what is costly to make.
    shared = ["-n", "2", "--dist", "loadfile", "--no-loadscope-reorder", "--durations=20"]
    steps.append(["pytest", *shared, *arguments])
    try:
        with nullcontext() if selected else _beside(root, "mypy") as types:
            for step in steps:
                print("$", " ".join(step), flush=True)
                if status := subprocess.run([sys.executable, "-m", *step], cwd=root).returncode:
                    return status
            return types() if types else 0
    except KeyboardInterrupt:
        return 130


@contextmanager
def _beside(root: Path, tool: str) -> Iterator[Callable[[], int]]:
    """Within it the tool works on one core while the tests begin; the yielded function waits for it, prints
    what it said and returns its status."""
    command = [sys.executable, "-m", tool]
    with subprocess.Popen(
        command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:

        def end() -> int:
            said = process.communicate()[0]
            print(f"$ {tool}\n{said}", end="", flush=True)
            return process.returncode

        try:
            yield end
        finally:
            process.kill()


if __name__ == "__main__":
    sys.exit(main())
