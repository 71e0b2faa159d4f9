"""Compiled programs kept from one call of a command to the next, so that the second starts at once.

JAX writes and reads them (its persistent compilation cache) by a hash of the program, the compiler's options
and versions; what cannot be read is compiled again. Code for one processor may not run on another that shares
the home folder, so each kind of processor has its own folder.
"""

from __future__ import annotations

import hashlib
import os
import platform
import pwd
from pathlib import Path

MOST_BYTES = 1 << 30
"""Beyond it the oldest go, down to half of it."""
_WORTH_S = "0.3"
"""Programs that compile faster than this are not kept."""


def caches() -> Path:
    """Folder of all that can be made again: below XDG_CACHE_HOME, or ~/.cache. Neither may depend on where a
    command is called: where HOME is no absolute path, the home that the system has for the user is it.

    Raises RuntimeError where there is none.
    """
    base = os.environ.get("XDG_CACHE_HOME") or ""
    return (Path(base) if Path(base).is_absolute() else _home() / ".cache") / "cannoise_jax"


def _home() -> Path:
    stated = Path(os.environ.get("HOME") or "")
    if stated.is_absolute():
        return stated
    try:
        return Path(pwd.getpwuid(os.getuid()).pw_dir)
    except KeyError as error:
        raise RuntimeError("no home folder") from error


def keep_compiled() -> None:
    """Has JAX keep what it compiles, before it is imported; JAX_COMPILATION_CACHE_DIR says where, and empty
    that nothing is kept. Where the folder cannot be written nothing is kept either."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        folder = caches() / "compiled" / processor()
        folder.mkdir(parents=True, exist_ok=True)
        _trim(folder)
    except (OSError, RuntimeError):  # RuntimeError: no home folder
        return
    if os.access(folder, os.W_OK):
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", _WORTH_S)


def processor() -> str:
    """Short hash of the processor's kind and instructions."""
    known = platform.machine() + platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        known += "".join(sorted({s for s in lines if s.startswith(("flags", "Features", "model name"))}))
    except OSError:
        pass  # not Linux
    return hashlib.sha256(known.encode()).hexdigest()[:12]


def _trim(folder: Path) -> None:
    files = [(s.st_mtime, s.st_size, Path(e.path)) for e in os.scandir(folder) if (s := e.stat())]
    left = sum(size for _, size, _ in files)
    most = MOST_BYTES // 2 if left > MOST_BYTES else MOST_BYTES
    for _, size, path in sorted(files):
        if left <= most:
            return
        path.unlink(missing_ok=True)
        left -= size
