"""Works of several files that were killed: made again by the next, and never taken for finished ones."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cannoise_jax.recordings.atomic import file_in_place, one_work, texts_in_place
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.recordings.unfinished import is_finished

WORK = """
import sys, time
from pathlib import Path
from cannoise_jax.recordings.atomic import file_in_place, one_work
out = Path(sys.argv[1])
with one_work([out / name for name in "abc"]):
    (out / "a").write_text("half")
    with file_in_place(out / "b") as file:
        print("ready", flush=True)
        time.sleep(60)
"""


def begun(folder: Path) -> subprocess.Popen:
    """A process that has made the first of three files, and is at work at the second."""
    started = subprocess.Popen([sys.executable, "-c", WORK, str(folder)], stdout=subprocess.PIPE, text=True)
    assert started.stdout.readline() == "ready\n"
    return started


def killed(folder: Path) -> None:
    process = begun(folder)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_what_a_killed_work_made_is_not_finished_and_the_next_one_clears_it(tmp_path):
    (tmp_path / "c").write_text("there before")
    killed(tmp_path)
    assert {"a", "c"} < names(tmp_path) and not is_finished(tmp_path / "a") and is_finished(tmp_path / "c")
    with one_work([tmp_path / "d"]):
        assert {n for n in names(tmp_path) if not n.startswith(".")} == {"c"}
        (tmp_path / "d").write_text("whole")
    assert names(tmp_path) == {"c", "d"} and is_finished(tmp_path / "d")


def test_a_work_that_goes_on_is_left_alone(tmp_path):
    process = begun(tmp_path)
    try:
        assert is_finished(tmp_path / "a")
        with one_work([tmp_path / "d"]):
            pass
        assert (tmp_path / "a").read_text() == "half"
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_file_that_was_finished_since_stays(tmp_path):
    killed(tmp_path)
    with file_in_place(tmp_path / "a") as file:
        file.write(b"whole")
    assert is_finished(tmp_path / "a")
    with one_work([tmp_path / "b"]):
        pass
    assert names(tmp_path) == {"a"} and (tmp_path / "a").read_text() == "whole"


def test_a_file_that_is_older_than_the_list_stays(tmp_path):
    killed(tmp_path)
    (tmp_path / "c").write_text("moved here")
    os.utime(tmp_path / "c", (0, 0))
    assert is_finished(tmp_path / "c") and not is_finished(tmp_path / "a")


@pytest.mark.parametrize("content", ["", "[", "{}", '[1, "../up", "/etc/none", ""]'])
def test_lists_that_are_damaged_remove_nothing(tmp_path, content):
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / ".unfinished.1.0").write_text(content)
    for path in (tmp_path / "up", folder / "a"):
        path.write_text("kept")
    with one_work([folder / "b"]):
        pass
    assert names(folder) == {"a"} and (tmp_path / "up").exists()


def test_a_work_that_fails_leaves_what_was_there(tmp_path):
    (tmp_path / "a").write_text("before")
    with (
        pytest.raises(BadInput),
        texts_in_place({tmp_path / "a": "x", tmp_path / "b": "y"}, [tmp_path / "c"]),
    ):
        (tmp_path / "c").write_text("z")
        raise BadInput("refused")
    assert names(tmp_path) == {"a"} and (tmp_path / "a").read_text() == "before"
