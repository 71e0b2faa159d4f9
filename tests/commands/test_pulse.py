"""Signs of life: said after some seconds of silence, in words of what is being done, and written over."""

from __future__ import annotations

import io
import os
import pty
import subprocess
import sys
import time

import pytest

from cannoise_jax.commands import pulse as pulses
from cannoise_jax.commands.drawing import Drawing
from cannoise_jax.commands.pulse import Pulse, Stream

CLEAR = "\r\x1b[K"


class Screen(io.StringIO):
    def __init__(self, terminal: bool) -> None:
        super().__init__()
        self._terminal = terminal

    def isatty(self) -> bool:
        return self._terminal


def made(terminal: bool):
    now, screen = [0.0], Screen(terminal)
    pulse = Pulse("x", lambda: now[0])
    return now, screen, pulse, Stream(screen, pulse)


def test_nothing_is_said_while_something_else_is():
    now, screen, pulse, stream = made(False)
    for _ in range(10):
        now[0] += pulses.QUIET_S - 0.1
        pulse.beat(stream)
        print("said", file=stream)
    assert screen.getvalue() == "said\n" * 10


def test_what_is_being_done_is_said_at_the_end_of_every_silence():
    now, screen, pulse, stream = made(False)
    pulse.at(lambda: "at the first")
    with pulse.doing(lambda: f"at {now[0]:g}"):
        for _ in range(20):
            now[0] += 1.0
            pulse.beat(stream)
    now[0] += 5.0
    pulse.beat(stream)
    said = screen.getvalue().splitlines()
    assert said == [*(f"[{t:6.1f} s] at {t}" for t in (5, 10, 15, 20)), "[  25.0 s] at the first"]


def test_stages_of_a_part_are_over_with_it():
    _, _, pulse, _ = made(False)
    before = pulse.words()
    with pulse.stages():
        pulse.at(lambda: "photon transfer")
        pulse.at(lambda: "mechanisms")
        assert pulse.words() == "mechanisms"
    assert pulse.words() == before


def test_a_line_that_was_begun_is_not_run_into():
    now, screen, pulse, stream = made(False)
    print("begun", end="", file=stream)
    now[0] += 5.0
    pulse.beat(stream)
    assert screen.getvalue() == "begun\n[   5.0 s] bin/x is at work\n"


def test_on_a_terminal_it_is_written_over():
    now, screen, pulse, stream = made(True)
    out = Stream(screen, pulse)
    for _ in range(2):
        now[0] += 5.0
        pulse.beat(stream)
    print("result", file=out)
    lines = screen.getvalue().split(CLEAR)
    assert lines == ["", "[   5.0 s] bin/x is at work", "[  10.0 s] bin/x is at work", "result\n"]


@pytest.mark.parametrize("terminal", [False, True])
def test_a_command_that_is_silent_speaks_and_leaves_the_screen_clean(terminal):
    script = (
        "import sys, time\nfrom cannoise_jax.commands import pulse\npulse.QUIET_S = 0.4\n"
        "from cannoise_jax.commands.entry import command, progress\n"
        "@command('x')\ndef main():\n    tell = progress('files')\n    tell(0, 3)\n    time.sleep(1)\n"
        "    print('said', file=sys.stderr)\n    return 0\n"
        "sys.exit(main())"
    )
    ours, theirs = pty.openpty() if terminal else os.pipe()
    with subprocess.Popen([sys.executable, "-c", script], stderr=theirs) as running:
        os.close(theirs)
        text = b""
        try:
            while part := os.read(ours, 4096):
                text += part
        except OSError:  # a terminal that nobody writes to any more
            pass
        assert running.wait() == 0
    os.close(ours)
    lines = text.decode().replace("\r\n", "\n").split(CLEAR if terminal else "\n")
    assert lines[1 if terminal else 0].endswith("s] files: 0 of 3")
    assert text.decode().replace("\r\n", "\n").endswith(f"{CLEAR if terminal else chr(10)}said\n")


def test_what_a_command_is_at_is_said_where_nothing_else_is(monkeypatch):
    monkeypatch.setattr(pulses, "QUIET_S", 0.3)
    screen = Screen(False)
    pulse = Pulse("x")
    with pulses.beating(pulse, Stream(screen, pulse)):
        pulses.now_at("loading")
        with pulse.doing(lambda: "counting"):
            time.sleep(0.8)
        time.sleep(0.8)
    said = [line.split("] ")[1] for line in screen.getvalue().splitlines()]
    assert said[0] == "counting" and said[-1] == "loading" and set(said) == {"counting", "loading"}


def test_one_command_inside_another_beats_once(monkeypatch):
    monkeypatch.setattr(pulses, "QUIET_S", 0.3)
    screen = Screen(False)
    outer, inner = Pulse("outer"), Pulse("inner")
    with pulses.beating(outer, Stream(screen, outer)), pulses.beating(inner, Stream(screen, inner)):
        assert pulses.current() is outer
        time.sleep(1.2)
    said = screen.getvalue().splitlines()
    assert said and all(line.endswith("bin/outer is at work") for line in said)
    assert pulses.current() is not outer


@pytest.mark.parametrize("closed", ["", "2>/dev/full", "2>&-"])
def test_a_refusal_that_nobody_hears_has_its_status(closed, tmp_path):
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full")
    run = (
        sys.executable,
        "-m",
        "cannoise_jax.commands.start",
        "convert",
        tmp_path / "none",
        tmp_path / "out",
    )
    assert subprocess.run(["sh", "-c", f"{' '.join(map(str, run))} {closed}"], timeout=60).returncode == 2


@pytest.mark.parametrize(
    "closed",
    [
        ">/dev/full",
        pytest.param(">&-", marks=pytest.mark.slow),
        pytest.param("2>/dev/full", marks=pytest.mark.slow),
        pytest.param("2>&-", marks=pytest.mark.slow),
    ],
)
def test_a_command_ends_its_work_where_what_it_prints_cannot_be_kept(closed, tmp_path):
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full")
    made = tmp_path / "out"
    run = [sys.executable, "-m", "cannoise_jax.commands.start", "simulate", "--sensor", "preset:sony_a7s2"]
    words = " ".join((*run, "--clean", "flat:0.1", "--frames", "2", "--size", "32x32", "--out", str(made)))
    done = subprocess.run(["sh", "-c", f"{words} {closed}"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert list(made.iterdir()) and "Traceback" not in done.stderr
    assert ("what it prints is lost: No space left" in done.stderr) == (closed == ">/dev/full")


def test_a_long_drawing_says_how_long_it_takes_from_two_frames_and_then_from_the_last(monkeypatch):
    now, asked, pulse = [0.0], [], Pulse("x")
    monkeypatch.setattr(pulses, "_CURRENT", [pulse])
    drawing = Drawing(lambda: now[0])

    def draw(frames):
        asked.append(frames)
        now[0] += frames * 0.5

    with drawing.told("a.h5", 100, 10**6, draw):
        assert pulse.words() == "drawing 100 frames of a.h5, about 50 s left"
        now[0] += 30.0
        assert pulse.words() == "drawing 100 frames of a.h5, about 20 s left"
        now[0] += 20.0
        assert pulse.words().endswith("nearly done")
        now[0] += 50.0
    with drawing.told("b.h5", 60, 10**6, draw):
        assert pulse.words() == "drawing 60 frames of b.h5, about 60 s left"
    with drawing.told("c.h5", 1, 10**6, draw):
        assert pulse.words() == "drawing 1 frame of c.h5"
    assert asked == [2, 2] and pulse.words() == "bin/x is at work"
