"""What every command does around its work: closed pipes, warnings of libraries, progress, help in no time."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
import warnings

import pytest

from cannoise_jax.commands import entry, interrupts
from cannoise_jax.commands.pulse import Pulse
from cannoise_jax.physics.core.settings import ExtrapolationWarning

COMMANDS = (
    *("bench", "blind", "calibrate", "compare", "convert", "denoise", "diagnose", "evaluate", "sample"),
    *("fleet", "simulate", "test", "train"),
)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_does_not_wait_for_jax(name):
    """By what is imported, not by the clock, which depends on the machine."""
    script = (
        "import sys, runpy; sys.argv = ['x', '--help']\n"
        f"try:\n    runpy.run_module('cannoise_jax.commands.{name}', run_name='__main__')\n"
        "except SystemExit as end:\n    assert not end.code, end.code\n"
        "print('jax' in sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0 and len(done.stdout) > 200, done.stderr
    assert done.stderr == "False\n", done.stderr


@pytest.mark.parametrize("stream", ["stdout", pytest.param("stderr", marks=pytest.mark.slow)])
def test_the_work_goes_on_without_a_traceback_when_the_reader_of_a_pipe_leaves(stream, tmp_path):
    made = tmp_path / "made"
    script = (
        "import sys\nfrom cannoise_jax.commands.entry import command\n"
        "@command('x')\ndef main():\n    for n in range(200000):\n"
        f"        print('line', n, file=sys.{stream})\n"
        f"    open({str(made)!r}, 'w')\n    return 0\n"
        "sys.exit(main())"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as running:
        assert running.stdout and running.stderr
        read, other = (running.stdout, running.stderr)[:: 1 if stream == "stdout" else -1]
        read.readline()
        read.close()
        assert other.read() == b"" and running.wait() == 0
    assert made.exists()


def test_what_is_still_at_work_does_not_hold_up_an_interrupt():
    script = (
        "import sys, threading, time, types\nfrom cannoise_jax.commands import start\n"
        "def main():\n    threading.Thread(target=time.sleep, args=(120,)).start()\n"
        "    print('said')\n    return 130\n"
        "sys.modules['cannoise_jax.commands.x'] = types.SimpleNamespace(main=main)\nstart.run('x')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (130, "said\n", "")


def test_an_interrupt_that_a_callback_swallows_comes_once_more():
    """JAX hangs a callback on the garbage collector; what is raised in one is only printed."""
    script = (
        "import gc, os, signal, sys, time\nfrom cannoise_jax.commands.entry import command\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in what runs behind
        "def callback(phase, info):\n    gc.callbacks.clear()\n    os.kill(os.getpid(), signal.SIGINT)\n"
        "    sum(range(1000))\n"
        "@command('x')\ndef main():\n    gc.callbacks.append(callback)\n    gc.collect()\n"
        "    time.sleep(20)\n    print('went on')\n    return 0\n"
        "sys.exit(main())"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "bin/x: interrupted\n")


def test_an_interrupt_that_came_through_does_not_come_once_more(capsys):
    """Also where the command has a way of its own to notice it."""

    class Dropped:
        def __del__(self):
            raise KeyboardInterrupt

    @entry.command("x")
    def main():
        Dropped()
        return 5

    assert main() == 5
    time.sleep(4 * entry._SOON_S)
    assert capsys.readouterr().err == ""


def test_warnings_of_libraries_are_dropped_and_own_ones_are_a_line(capsys):
    @entry.command("x")
    def main():
        warnings.warn("of a library", UserWarning, stacklevel=1)
        warnings.warn("ISO 9 lies\noutside", ExtrapolationWarning, stacklevel=1)
        return 3

    assert main() == 3
    assert capsys.readouterr().err == "bin/x: ISO 9 lies outside\n"


def test_a_line_of_the_log_shows_no_orders_to_the_terminal(monkeypatch, capsys):
    monkeypatch.setattr(logging.root, "handlers", [])
    entry.show_warnings("x")
    logging.warning("%s: odd", "a\x1b[2J\nb")
    assert capsys.readouterr().err == "bin/x: a?[2J b: odd\n"


def test_an_interruption_is_one_line(capsys):
    @entry.command("x")
    def main():
        raise KeyboardInterrupt

    assert main() == 130 and capsys.readouterr().err == "bin/x: interrupted\n"


def test_an_interrupt_that_became_another_error_is_one_line(capsys):
    """As in a late import, where Python makes a RuntimeError of it."""

    class Late:
        def __set_name__(self, owner, name):
            raise KeyboardInterrupt

    @entry.command("x")
    def turned():
        type("Owner", (), {"late": Late()})

    @entry.command("x")
    def during():
        try:
            raise KeyboardInterrupt
        finally:
            raise ValueError("of what was cut short")

    @entry.command("x")
    def other():
        raise ValueError("of its own")

    for main in (turned, during):
        assert main() == 130 and capsys.readouterr().err == "bin/x: interrupted\n"
    with pytest.raises(ValueError, match="of its own"):
        other()


@pytest.mark.parametrize(
    "end, status", [("return 7", 7), ("sys.exit(7)", 7), ("raise KeyboardInterrupt", 130)]
)
def test_an_interrupt_after_the_work_is_not_heard(end, status):
    """Python ends with hooks and threads of libraries; the work is done, or has been interrupted already."""
    script = (
        "import atexit, os, signal, sys, types\nfrom cannoise_jax.commands import start\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in what runs behind
        "class Last:\n    def __del__(self, kill=os.kill, own=os.getpid(), number=signal.SIGINT):\n"
        "        kill(own, number)\n"
        "last = Last()\natexit.register(os.kill, os.getpid(), signal.SIGINT)\n"
        f"def main():\n    print('said')\n    {end}\n"
        "sys.modules['cannoise_jax.commands.x'] = types.SimpleNamespace(main=main)\nsys.exit(start.run('x'))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (status, "said\n", "")


@pytest.mark.parametrize("ignored", [False, True])
def test_an_interrupt_while_a_command_is_loaded_is_one_line(ignored):
    """Where a shell ignores it, as for what runs behind, it stays ignored."""
    script = (
        "import importlib.abc, os, signal, sys\nfrom cannoise_jax.commands.start import convert\n"
        "class Late(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name == 'cannoise_jax.commands.convert': os.kill(os.getpid(), signal.SIGINT)\n"
        f"signal.signal(signal.SIGINT, signal.SIG_IGN if {ignored} else signal.default_int_handler)\n"
        "sys.meta_path.insert(0, Late())\nsys.argv[1:] = ['--help']\nsys.exit(convert())"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    if ignored:
        assert done.returncode == 0 and "bin/convert" in done.stdout and done.stderr == ""
    else:
        assert (done.returncode, done.stdout, done.stderr) == (130, "", "bin/convert: interrupted\n")


@pytest.mark.parametrize(("way", "status"), [("", 130), ("signal.SIG_IGN", 0)])
def test_an_interrupt_while_a_command_loads_a_library_waits_for_its_end(way, status, tmp_path):
    """The C++ of a library that is half there ends the process at an exception."""
    (tmp_path / "library.py").write_text(
        "import os, signal\nfor _ in range(3): os.kill(os.getpid(), signal.SIGINT)\nprint('loaded')\n"
    )
    script = (
        "import signal, sys, time, types\nfrom cannoise_jax.commands import start\n"
        f"sys.path.insert(0, {str(tmp_path)!r})\nfrom cannoise_jax.commands.entry import command\n"
        f"signal.signal(signal.SIGINT, {way or 'signal.default_int_handler'})\n"
        "@command('x')\ndef main():\n    try:\n        import library\n    finally:\n        print('on')\n"
        f"    time.sleep({0 if way else 30})\n    return 0\n"
        "sys.modules['cannoise_jax.commands.x'] = types.SimpleNamespace(main=main)\nsys.exit(start.run('x'))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    said = "" if way else "bin/x: interrupted\n"
    assert (done.returncode, done.stdout, done.stderr) == (status, "loaded\non\n", said)


def test_what_never_ends_loading_is_interrupted_all_the_same(monkeypatch):
    monkeypatch.setattr(interrupts, "_PATIENCE_S", 0.2)
    monkeypatch.setattr(interrupts, "_is_loading", lambda frame: True)
    heard: list[int] = []
    handle = interrupts.after_loading(lambda number, frame: heard.append(number))
    before = signal.signal(signal.SIGUSR1, handle)
    try:
        os.kill(os.getpid(), signal.SIGUSR1)
        assert not heard
        time.sleep(0.6)
        assert heard == [signal.SIGUSR1]
    finally:
        signal.signal(signal.SIGUSR1, before)


@pytest.mark.parametrize(
    ("stated", "threads"), [({}, 1), ({"OPENBLAS_NUM_THREADS": "2"}, 2), ({"OMP_NUM_THREADS": "2"}, 2)]
)
def test_the_library_of_matrices_has_one_thread_unless_the_user_states_more(stated, threads):
    script = (
        "import sys, types\nfrom cannoise_jax.commands import start\n"
        "def main():\n    import numpy, scipy.linalg\n    from threadpoolctl import threadpool_info\n"
        "    print({one['num_threads'] for one in threadpool_info() if one['user_api'] == 'blas'})\n"
        "    return 0\n"
        "sys.modules['cannoise_jax.commands.x'] = types.SimpleNamespace(main=main)\nsys.exit(start.run('x'))"
    )
    pytest.importorskip("threadpoolctl", reason="tells how many threads there are")
    own = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=own | stated)
    assert done.stdout == f"{{{min(threads, os.cpu_count() or 1)}}}\n", done.stderr


def test_progress_speaks_when_it_takes_long_and_estimates(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    tell = entry.progress("doing")
    for number in range(1, 11):
        now[0] = number * 6.0
        tell(number, 10)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "doing: 1 of 10, 54 s left" and lines[-1] == "doing: 10 in 60 s"
    quick = entry.progress("doing")
    for number in range(1, 11):
        now[0] += 0.01
        quick(number, 10)
    only = entry.progress("doing")
    now[0] += 60.0
    only(1, 1)  # nothing is left to wait for
    assert capsys.readouterr().err == ""


def test_a_piece_that_takes_longer_than_all_the_others_tells_no_time(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    pulse = Pulse("x")
    monkeypatch.setattr(entry, "current", lambda: pulse)
    tell = entry.progress("doing")
    for number in range(3):
        now[0] = number * 5.0
        tell(number, 4, f"piece {number}")
    said = []
    for seconds in (10.0, 14.0, 19.0, 40.0):
        now[0] = seconds
        said.append(pulse.words())
    assert said == [
        "doing: 2 of 4, 10 s left, now piece 2",
        "doing: 2 of 4, 6 s left, now piece 2",
        "doing: 2 of 4, 1 s left, now piece 2",
        "doing: 2 of 4, now piece 2",
    ]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            OSError(36, "File name too long", "m" * 300),
            f"{'m' * 200}...: cannot be used (File name too long)",
        ),
        (PermissionError(13, "Permission denied", "a\nb"), "a b: cannot be used (Permission denied)"),
        (MemoryError(), "not enough memory"),
    ],
)
def test_what_the_system_refuses_is_one_line(error, said, capsys):
    @entry.command("x")
    def main():
        raise error

    assert main() == 2
    assert (line := capsys.readouterr().err).startswith(f"bin/x: {said}") and line.count("\n") == 1


def test_other_errors_keep_their_traceback():
    @entry.command("x")
    def main():
        raise OSError("of a library, about no file")

    with pytest.raises(OSError):
        main()
