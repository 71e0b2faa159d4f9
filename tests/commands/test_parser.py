"""Flags that cannot be read: one line and exit status 2, the same for every command."""

import argparse
import os
from pathlib import Path

import pytest

from cannoise_jax.commands import (
    bench,
    calibrate,
    compare,
    convert,
    denoise,
    diagnose,
    evaluate,
    outputs,
    sample,
    simulate,
)
from cannoise_jax.commands.parser import OneLineParser, above_zero, celsius, count, level, numbers, seconds
from cannoise_jax.recordings.recording import BadInput


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        (bench, [], "required"),
        (bench, ["coverage", "--simulations", "many"], "--simulations"),
        (calibrate, ["--out", "a.json"], "--recordings"),
        (convert, [__file__], "OUT.h5"),
        (simulate, ["--out", "x", "a.json"], "a.json: no flag stands before it"),
        (sample, ["--frames", "0"], "--frames: '0': give a whole number"),
        (sample, ["--frames", "two"], "--frames: 'two': give a whole number"),
        (sample, ["--black-level", "abc"], "--black-level: 'abc': give one value"),
        (simulate, ["--out", "x", "--size", "5"], "--size"),
        (simulate, ["--out", "x", "--frames", "two"], "--frames: 'two': give a whole number"),
        (compare, ["--recordings", "a", "b", "--key", "-1"], "--key: '-1': give a whole number from 0"),
        (diagnose, ["--recordings", "a", "--key", "9999999999"], "--key: '9999999999': give a whole"),
        (simulate, ["--out", "x", "--iso", "high"], "--iso: 'high': give a number"),
        (simulate, ["--out", "x", "--nonsense"], "unknown flag --nonsense"),
        (simulate, ["--outt", "x"], "unknown flag --outt: did you mean --out?"),
        (calibrate, ["-out=x"], "unknown flag -out: did you mean --out?"),
        (convert, ["a", "b", "--dryrun"], "unknown flag --dryrun: did you mean --dry-run?"),
        (bench, ["docs", "--ou"], "unknown flag --ou"),
        (bench, ["--outt", "x"], "unknown flag --outt"),
    ],
)
def test_one_line_and_status_2(command, arguments, message, capsys):
    with pytest.raises(SystemExit) as caught:
        command.main(arguments)
    error = capsys.readouterr().err
    assert caught.value.code == 2 and error.count("\n") == 1
    assert error.startswith(f"bin/{command.__name__.split('.')[-1]}") and message in error
    assert error.endswith("(see --help)\n")


@pytest.mark.parametrize(
    "command", [bench, calibrate, compare, convert, denoise, diagnose, evaluate, sample, simulate]
)
def test_help_shows_a_per_cent_sign_once(command, capsys):
    with pytest.raises(SystemExit) as caught:
        command.main(["--help"])
    assert caught.value.code == 0 and "%%" not in capsys.readouterr().out


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc")
def test_a_folder_that_takes_no_files_is_refused_before_the_work(tmp_path):
    outputs.check_folder(tmp_path / "new", ("a",), force=False)
    outputs.check_file(tmp_path / "a.json", ".json", force=False)
    assert not list(tmp_path.iterdir())
    with pytest.raises(BadInput, match="/proc/new: cannot be written"):
        outputs.check_folder(Path("/proc/new"), ("a",), force=False)
    with pytest.raises(BadInput, match="/proc/a.json: cannot be written"):
        outputs.check_file(Path("/proc/a.json"), ".json", force=False)


def test_a_message_of_several_lines_becomes_one(capsys):
    with pytest.raises(SystemExit):
        OneLineParser(prog="bin/x").error("one\n  two")
    assert capsys.readouterr().err == "bin/x: one two (see --help)\n"


def test_values():
    assert numbers("64") == (64.0,) and numbers("1,2,3,4.5") == (1, 2, 3, 4.5) and count("3") == 3
    assert (seconds("0"), seconds("1e-9"), seconds("1e6"), celsius("0")) == (0, 1e-9, 1e6, 0)
    wrong = [(numbers, "1,2"), (numbers, ""), (numbers, "1e-320"), (count, "-1"), (count, "1.5")]
    wrong += [(seconds, text) for text in ("1e-320", "1e-12", "1e9", "-1", "nan")]
    wrong += [(level, "1e-320"), (above_zero, "1e-320"), (celsius, "1e-320")]
    for read, text in wrong:
        with pytest.raises(argparse.ArgumentTypeError, match=repr(text)):
            read(text)


@pytest.mark.parametrize("flag", [("--sensor",), ("--clean",)])
def test_pipes_are_refused_before_anybody_waits_for_them(flag, tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe")
    for given in ([*flag, str(tmp_path / "pipe")], [f"{flag[0]}={tmp_path / 'pipe'}"]):
        with pytest.raises(SystemExit) as caught:
            simulate.main([*given, "--out", str(tmp_path / "x")])
        error = capsys.readouterr().err
        assert caught.value.code == 2 and "pipe: no plain file" in error and error.count("\n") == 1
