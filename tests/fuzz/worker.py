"""Runs cases one by one, each in a fork with limits on time and memory: python -m tests.fuzz.worker

Reads one JSON job a line, {"target", "argv", "cwd", "seconds", "cpu", "gigabytes", "ready"}, and answers
with one, {"status": exit status, or minus the signal, "out", "err", "seconds", "megabytes"}. The modules are
loaded once, before any fork, and JAX computes nothing here.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import logging
import math
import os
import pkgutil
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
import warnings

import cannoise_jax

READERS = ("h5py", "astropy.io.fits", "tifffile", "rawpy", "PIL.Image", "jax.numpy")
"""What modules import only when they need it."""
PEERS = "cannoise_jax.bench.torch_"
"""Modules that need an optional extra, for `bin/bench` alone."""


def main() -> int:
    warnings.filterwarnings("ignore", category=RuntimeWarning, message=r".*fork.*")
    inside = (module.name for module in pkgutil.walk_packages(cannoise_jax.__path__, "cannoise_jax."))
    for name in (*READERS, *(name for name in inside if not name.startswith(PEERS))):
        importlib.import_module(name)
    logging.getLogger().handlers.clear()  # a library's own would keep a command from setting up its lines
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a module prints is no answer
    for line in sys.stdin:
        answers.write(json.dumps(run(json.loads(line))) + "\n")
        answers.flush()
    return 0


def run(job: dict) -> dict:
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        started = time.monotonic()
        pid = os.fork()
        if pid == 0:
            child(job, out.fileno(), err.fileno())
        began = time.monotonic()
        while job.get("ready") and not os.path.exists(job["ready"]) and time.monotonic() - began < 60:
            if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                break
            time.sleep(0.002)
        status, used, hung = wait(pid, job["seconds"])
        texts = []
        for stream in (out, err):
            stream.seek(0)
            texts.append(stream.read(100_000).decode(errors="replace"))
    return {
        "status": "hung" if hung else os.waitstatus_to_exitcode(status),
        "out": texts[0],
        "err": texts[1],
        "seconds": time.monotonic() - started,
        "megabytes": used.ru_maxrss / 1024,
    }


def wait(pid: int, seconds: float):
    """Status and use of the child, killed where it takes longer."""
    watched = os.pidfd_open(pid)
    try:
        hung = not select.select([watched], [], [], seconds)[0]
        if hung:
            os.kill(pid, signal.SIGKILL)
        _, status, used = os.wait4(pid, 0)
        return status, used, hung
    finally:
        os.close(watched)


def child(job: dict, out: int, err: int) -> None:
    status = 70
    try:
        os.dup2(out, 1)
        os.dup2(err, 2)
        devnull = os.open(os.devnull, os.O_RDONLY)
        os.dup2(devnull, 0)
        with open("/proc/self/statm") as statm:
            now = int(statm.read().split()[0]) * resource.getpagesize()
        most = now + int(job["gigabytes"] * 2**30)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        spent = math.ceil(time.process_time() + job["cpu"])
        resource.setrlimit(resource.RLIMIT_CPU, (spent, spent))
        os.chdir(job["cwd"])
        status = call(job["target"], job["argv"])
    except BaseException:
        traceback.print_exc()
        status = 70
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def call(target: str, argv: list[str]) -> int:
    """A command's status; of a reader 0, or 2 and its one line."""
    from cannoise_jax.recordings.recording import BadInput

    if not target.startswith("read:"):
        module = importlib.import_module(f"cannoise_jax.commands.{target}")
        try:
            return int(module.main(argv) or 0)
        except SystemExit as ended:
            return int(ended.code or 0)
    try:
        pkgutil.resolve_name(target.removeprefix("read:"))(*argv)
    except BadInput as error:
        print(f"read: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
