"""bin/bench docs: fills the tables and numbers of README.md and docs/ from docs/results/*.json.

A page holds markers, and what stands between them is rendered:

    <!-- results: NAME -->          (a name in small letters) table, figures, notes and origin of a result
    <!-- results: NAME.VALUE -->    one value of it, within a sentence or a cell
    <!-- results: NAME.code -->     the code it was measured on, and whether that is this code

each closed by an `end` comment.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from cannoise_jax.commands.parser import place
from cannoise_jax.commands.published import FOLDER, Result, is_older, read_results, write_result
from cannoise_jax.recordings.recording import BadInput

_MARK = re.compile(r"<!-- results: ([a-z]\w*)(?:\.(\w+))? -->(.*?)<!-- end -->", re.DOTALL)
_OPEN = re.compile(r"<!-- results: [a-z]")


def pages(root: Path) -> list[Path]:
    """README.md and every page of docs/."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def render(text: str, root: Path, page: Path, results: dict[str, Result]) -> str:
    """The page's text with every marked place filled anew. Raises BadInput for a name that is not there."""

    def fill(match: re.Match[str]) -> str:
        name, value, _ = match.groups()
        if name not in results:
            raise BadInput(f"{page}: no result {name!r} in {root / FOLDER}: name one that is there")
        result = results[name]
        older = is_older(root, result)
        if value is None:
            shown = f"\n\n{block(result, older, root, page)}\n\n"
        elif value == "code":
            shown = code_cell(result, older)
        elif value in result.values:
            shown = result.values[value]
        else:
            known = ", ".join(result.values) or "none"
            raise BadInput(f"{page}: result {name!r} holds no value {value!r}: it holds {known}")
        mark = name if value is None else f"{name}.{value}"
        return f"<!-- results: {mark} -->{shown}<!-- end -->"

    opened, closed = len(_OPEN.findall(text)), len(_MARK.findall(text))
    if opened != closed:
        raise BadInput(f"{page}: {opened} places are marked and {closed} closed with <!-- end -->")
    return _MARK.sub(fill, text)


def block(result: Result, older: bool, root: Path, page: Path) -> str:
    """Table, figures, notes and origin of a result as Markdown."""
    parts = []
    if result.columns:
        parts.append(table(result.columns, result.rows))
    for figure in result.figures:
        path = Path(*[".."] * (len(page.relative_to(root).parts) - 1), "docs", figure["file"])
        if page.is_relative_to(root / "docs"):  # the site's pages see docs/ as their root
            path = Path(*[".."] * (len(page.relative_to(root / "docs").parts) - 1), figure["file"])
        link = path.as_posix()
        parts.append(f"[![{figure['caption']}]({link})]({link})\n\n*{figure['caption']}*")
    parts += result.notes
    parts.append(origin(result, older))
    return "\n\n".join(parts)


def table(columns: tuple[str, ...], rows: tuple[tuple[str, ...], ...]) -> str:
    """A Markdown table."""
    lines = [columns, ("---",) * len(columns), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines)


def origin(result: Result, older: bool) -> str:
    """How, on which code, where and when a result was measured."""
    commands = "; ".join(f"`{line}`" for line in result.command)
    text = f"<small>{commands}. Code {code_cell(result, False)}, {result.date}, {result.machine}."
    if older:
        changed = ", ".join(f"`{path}`" for path in result.code["paths"])
        text += f" **Measured on older code**: there were changes since in {changed}."
    return text + "</small>"


def code_cell(result: Result, older: bool) -> str:
    """The code a result was measured on: commits where known, else the hash of its sources."""
    commits = result.code["commits"]
    ends = dict.fromkeys((*commits[:1], *commits[-1:]))  # the oldest and the newest, which may be one
    named = " to ".join(f"`{c}`" for c in ends) or f"with sources `{result.code['sha256'][:12]}`"
    return named + (" (older code)" if older else "")


def run(root: Path, check: bool = False) -> list[Path]:
    """Renders every page; returns those that changed, which `check` leaves as they are."""
    if not (root / FOLDER).is_dir():
        raise BadInput(f"{root}: holds no {FOLDER}: run bin/bench docs in a checkout of the project")
    results = read_results(root)
    changed = []
    for page in pages(root):
        before = page.read_text(encoding="utf-8")
        after = render(before, root, page, results)
        if after != before:
            changed.append(page)
            if not check:
                page.write_text(after, encoding="utf-8")
    return changed


def add_docs(commands: Any) -> None:
    """The flags of `bin/bench docs`, to the parser's commands."""
    docs = commands.add_parser("docs", help="renders README.md and docs/ from docs/results")
    docs.add_argument("--check", action="store_true", help="write nothing; status 2 where a page differs")
    docs.add_argument("--take", type=place, metavar="FILE", help="a file that a command wrote, as a result")
    docs.add_argument("--name", metavar="NAME", help="of the result that --take makes or replaces")
    docs.add_argument("--title", metavar="TEXT", help="its title (default: that of the one before, or NAME)")
    docs.add_argument("--figure", type=place, metavar="PNG", help="that a command wrote, beside --take")
    docs.add_argument("--caption", metavar="TEXT", help="of --figure (default: that of the one before)")
    docs.add_argument(
        "--command", action="append", default=[], metavar="LINE", help="that wrote FILE; repeat"
    )
    docs.set_defaults(run=_run)


def _check_flags(arguments: argparse.Namespace) -> None:
    """Raises BadInput for flags that would be passed over."""
    about = [n for n in ("name", "title", "figure", "caption", "command") if getattr(arguments, n)]
    if arguments.take is None and about:
        raise BadInput(f"docs: --{about[0]} is of a result that --take makes: give --take, or leave it out")
    if arguments.take is not None and arguments.check:
        raise BadInput("docs: --check writes nothing and --take does: give one of them")
    if arguments.caption and arguments.figure is None:
        raise BadInput("docs: --caption is that of --figure: give both, or leave it out")


def _run(arguments: argparse.Namespace) -> None:
    root = Path(__file__).resolve().parents[2]
    _check_flags(arguments)
    if arguments.take is not None:
        from cannoise_jax.commands.bench_take import figure, take

        if not arguments.name or not arguments.command:
            raise BadInput("docs: --take needs --name and --command")
        before = read_results(root).get(arguments.name)
        title = arguments.title or (before.title if before else None)
        taken = take(root, arguments.take, arguments.name, title, arguments.command)
        if arguments.figure is not None:
            captions = [f["caption"] for f in (before.figures if before else ())]
            caption = arguments.caption or (captions[0] if captions else None)
            if not caption:
                raise BadInput("docs: --figure needs --caption")
            taken = taken._replace(figures=(figure(root, arguments.figure, caption),))
        print(write_result(root, taken))
    changed = run(root, arguments.check)
    for page in changed:
        print(page)
    results = read_results(root)
    older = [name for name, result in results.items() if is_older(root, result)]
    print(f"{len(results)} results, {len(older)} measured on older code: {', '.join(older) or 'none'}")
    if changed and arguments.check:
        raise BadInput(f"docs: {len(changed)} pages differ from their results: run bin/bench docs")
