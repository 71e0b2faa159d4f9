"""Memory that is taken over and over comes from what the process has, not page by page from the system."""

from __future__ import annotations

import subprocess
import sys

import pytest

_PROGRAM = """
import resource
import sys

import numpy as np

from cannoise_jax.commands.freed_memory import keep_freed

if sys.argv[1] == "kept":
    keep_freed()

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

np.ones(16 << 20)
before = faults()
for _ in range(4):
    np.ones(16 << 20)
print(faults() - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's malloc is Linux's")
def test_freed_memory_is_taken_again_without_the_system():
    """Arrays of 128 MiB; a page holds 4 KiB, or 2 MiB where the system makes them large."""

    def faults(way):
        run = [sys.executable, "-c", _PROGRAM, way]
        return int(subprocess.run(run, capture_output=True, text=True, check=True).stdout)

    assert faults("kept") < 16
    assert faults("given back") >= 4 * 64
