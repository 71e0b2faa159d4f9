"""Shared by all tests: the slow mark, small thread pools, and the folder of real recordings."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import pytest

# Two workers share two cores: one thread pool each keeps them from fighting. Set before JAX is imported.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
# What one test compiles later ones load, and the commands that they start. A folder for each worker: entries
# are not written in one piece, so another process might read half of one.
_compiled = tempfile.mkdtemp(prefix="cannoise-tests-")
os.environ["JAX_COMPILATION_CACHE_DIR"] = _compiled
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
atexit.register(shutil.rmtree, _compiled, ignore_errors=True)

ROOT = Path(__file__).resolve().parents[1]
REAL_DATA = Path(os.environ.get("CANNOISE_DATA", ROOT.parent / "shared" / "data"))


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="also run the tests that take minutes")


def pytest_collection_modifyitems(config, items):
    if config.getoption("--slow"):
        return
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="slow: run with --slow"))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings; tests that need it skip visibly where it is absent."""
    if not REAL_DATA.is_dir():
        pytest.skip(f"no real recordings at {REAL_DATA}: set CANNOISE_DATA to their folder")
    return REAL_DATA
