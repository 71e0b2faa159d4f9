"""What the commands share in reading their flags: refusal in one line, levels per channel, defaults in help,
and how a folder of recordings is read."""

from __future__ import annotations

import argparse
import difflib
import math
import os
import re
import stat
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from cannoise_jax.recordings.recording import (
    CFA_PATTERNS,
    COLDEST_C,
    HOTTEST_C,
    KINDS,
    LEAST,
    LONGEST_S,
    MOST,
    MOST_DB,
    SHORTEST_S,
    printable,
)
from cannoise_jax.recordings.stated_values import LONGEST

if TYPE_CHECKING:
    from cannoise_jax.recordings.folders.store import Options

_HIGHEST_DN = 65535.0


class _Defaults(argparse.HelpFormatter):
    """Ends the help of every flag that has a default with it."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, value = action.help or "", action.default
        nothing = value is None or value is False or value in ((), [], "", argparse.SUPPRESS)
        said = nothing or "default" in text
        if said or action.option_strings == [] or not text and action.nargs == 0:
            return text
        shown = ",".join(map(str, value)) if isinstance(value, (tuple, list)) else str(value)
        return f"{text} (default {shown.replace('%', '%%')})".strip()


class OneLineParser(argparse.ArgumentParser):
    """Refuses flags in one line on stderr, `bin/NAME: message (see --help)`, with exit status 2.

    passes_on: flags that are not known are another program's.
    """

    def __init__(self, *args: Any, passes_on: bool = False, **more: Any) -> None:
        more.setdefault("formatter_class", _Defaults)
        # Module docstrings begin with the command, which the usage has just said.
        words = (more.get("description") or "").partition(f"{more.get('prog')}: ")
        if words[1] and not words[0]:
            more["description"] = words[2][:1].upper() + words[2][1:]
        self._passes_on = passes_on
        self._given: Sequence[str] = ()
        super().__init__(*args, **more)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse, but an unknown flag is named before what is missing, which it may be a slip of."""
        given = self._given = sys.argv[1:] if args is None else list(args)
        if not self._passes_on:
            self._check_names(given)
        self._check_files(given)
        return super().parse_known_args(given, namespace)

    def _check_names(self, given: Sequence[str]) -> None:
        known = self._option_string_actions
        for word in takewhile(lambda w: w != "--", given):
            if word.startswith("--") and word.endswith("=--"):  # argparse takes the value for none at all
                self.error(f"{word[:-3]}: '--' is no value")
            if self._subparsers is not None and not word.startswith("-"):
                return  # what follows is the subcommand's
            name = word.partition("=")[0]
            flag = name.startswith("-") and name.lstrip("-")[:1].isalpha() and " " not in name
            if flag and not any(k.startswith(name) for k in known):
                near = difflib.get_close_matches(name, known, n=1, cutoff=0.75)
                self.error(f"unknown flag {name}" + (f": did you mean {near[0]}?" if near else ""))

    def _check_files(self, given: Sequence[str]) -> None:
        """Whoever reads from a pipe waits until somebody writes into it, perhaps for ever."""
        for word in given:
            for name in {word, word.partition("=")[2]}:
                try:
                    mode = os.stat(name).st_mode if name else 0
                except (OSError, ValueError):
                    continue
                if stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode) or stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
                    self.error(f"{name}: no plain file (a pipe or device): give a file")

    def error(self, message: str) -> NoReturn:
        """Says what is wrong with the flags in one line, and ends."""
        for kind, words in (("int", "a whole number"), ("float", "a number")):
            message = re.sub(rf"invalid {kind} value: (.*)$", rf"\1: give {words}", message)
        if message.startswith("the following arguments are required: ") and "--recordings" in message:
            pairs = pairwise(["", *self._given])
            alone = [w for before, w in pairs if not before.startswith("-") and Path(w).is_dir()]
            message += f"; {alone[0]} stands alone: --recordings {alone[0]}" if alone else ""
        message = re.sub(r"^unrecognized arguments: (.*)$", r"\1: no flag stands before it", message)
        self.exit(2, f"{self.prog}: {printable(message)} (see --help)\n")


def add_recording_flags(parser: argparse.ArgumentParser, *, single: bool = False) -> None:
    """The flags that state what files do not, or state wrongly, and how the files of a folder are sorted.

    single: also those that only make sense for files of one setting.
    """
    add = parser.add_argument
    add_level_flags(parser)
    add("--camera", metavar="NAME", type=name, help="name of the camera, for all files")
    if single:
        add("--kind", choices=KINDS, help="what the frames show")
        add("--iso", type=above_zero, help="of all files")
        add("--exposure", type=seconds, dest="exposure_s", metavar="SECONDS", help="of all files")
        add("--temperature", type=celsius, dest="temperature_c", metavar="C", help="of all files")
    add(
        "--assign",
        type=assignment,
        action="append",
        default=[],
        metavar="NAME*=KIND",
        help=f"in a folder, kind of the files or folders of such names ({', '.join(KINDS)}); may be given "
        "several times",
    )
    add(
        "--leave-out",
        action="append",
        default=[],
        metavar="NAME*",
        help="in a folder, pass over the files or folders of such names; may be given several times",
    )


def add_level_flags(parser: argparse.ArgumentParser) -> None:
    """The flags that state how the codes of a recording are meant."""
    add = parser.add_argument
    add("--cfa", choices=CFA_PATTERNS, help="colour order of the 2x2 cell, where files are wrong or silent")
    add("--black-level", type=numbers, metavar="DN", help="one value, or a,b,c,d in mosaic order")
    add("--white-level", type=level, metavar="DN", help="highest code")


def overrides(arguments: argparse.Namespace) -> dict[str, Any]:
    """The fields of a recording that the flags state."""
    names = ("cfa", "black_level", "white_level", "kind", "camera", "iso", "exposure_s", "temperature_c")
    given = {name: getattr(arguments, name, None) for name in names}
    return {name: value for name, value in given.items() if value is not None}


def options(arguments: argparse.Namespace) -> Options:
    """How the flags have a folder read."""
    from cannoise_jax.recordings.folders.store import Options

    return Options(overrides(arguments), tuple(arguments.assign), tuple(arguments.leave_out))


def numbers(text: str) -> tuple[float, ...]:
    """One value, or four in mosaic order as a,b,c,d. Raises argparse.ArgumentTypeError for anything else."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if not all(math.isfinite(value) for value in values):
        raise argparse.ArgumentTypeError(f"{text!r}: give a value in DN")
    if any(0 < abs(value) < LEAST for value in values):
        raise argparse.ArgumentTypeError(f"{text!r}: too small to be meant: give 0")
    if len(values) not in (1, 4):
        raise argparse.ArgumentTypeError(f"{text!r}: give one value, or four as a,b,c,d in mosaic order")
    return values


def _whole(least: int, most: float, words: str) -> Callable[[str], int]:
    """A whole number from `least`, at most `most`."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text!r}: give a whole number{words}")
        return value

    return parse


count = _whole(1, float("inf"), ", 1 or more")
whole = _whole(0, 2**63 - 1, ", 0 or more")
seed = _whole(0, 2**32 - 1, f" from 0 to {2**32 - 1}")


def _between(
    least: float, most: float, words: str, *, open_: bool = False, smallest: float = LEAST
) -> Callable[[str], float]:
    """A number from `least` to `most`, without `least` where open, and 0 or no smaller than `smallest`."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        inside = least <= value <= most and not (open_ and value == least)
        if not inside or 0 < abs(value) < smallest:
            raise argparse.ArgumentTypeError(f"{text!r}: {words}")
        return value

    return parse


level = _between(0, _HIGHEST_DN, "give a value in DN, above 0 and at most 65535", open_=True)
celsius = _between(COLDEST_C, HOTTEST_C, f"give degrees Celsius, {COLDEST_C:g} to {HOTTEST_C:g}, as 20")
decibels = _between(-MOST_DB, MOST_DB, f"give a gain in dB, at most {MOST_DB:g}")
seconds = _between(
    0, LONGEST_S, f"give a time in seconds, 0 or {SHORTEST_S:g} to {LONGEST_S:g}", smallest=SHORTEST_S
)
above_zero = _between(0, MOST, f"give a number above 0, at most {MOST:g}", open_=True)


def assignment(text: str) -> tuple[str, str]:
    """A pattern of names and the kind of what it fits, NAME*=KIND."""
    pattern, _, kind = text.rpartition("=")
    if not pattern or kind not in KINDS:
        raise argparse.ArgumentTypeError(f"{text!r}: give NAME*=KIND with one of {', '.join(KINDS)}")
    return pattern, kind


def place(text: str) -> Path:
    """The name of a file or folder. Raises argparse.ArgumentTypeError for an empty one."""
    if not text.strip():
        raise argparse.ArgumentTypeError("an empty name: name a file or folder")
    return Path(text)


def name(text: str) -> str:
    """A name of one line of text. Raises argparse.ArgumentTypeError for an empty or another one."""
    if not text.strip() or not text.isprintable() or len(text) > LONGEST:
        raise argparse.ArgumentTypeError(f"{text[:20]!r}: give a name of one line of text")
    return text


def folder(text: str) -> Path:
    """The name of a folder. Raises argparse.ArgumentTypeError for an empty one: that is the current."""
    if not text.strip():
        raise argparse.ArgumentTypeError("an empty name: name a folder")
    return Path(text)


def add_mechanisms_flag(parser: argparse.ArgumentParser, what: str) -> None:
    """`--mechanisms`: modules with the user's own entries, and what they are for."""
    parser.add_argument(
        "--mechanisms",
        metavar="MODULE:NAME",
        action="append",
        default=[],
        help=f"{what} (docs/adding_a_mechanism.md); may be repeated",
    )


def add_table(parser: argparse.ArgumentParser) -> None:
    """The flags of a command that also writes what it measured as a table."""
    parser.add_argument("--out", type=place, metavar="FILE.json", help="also as a table for bin/bench docs")
    parser.add_argument("--force", action="store_true", help="replace a table that exists")
