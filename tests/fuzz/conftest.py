"""The process that runs the cases is one for all tests: it loads the package once."""

from __future__ import annotations

import pytest

from tests.fuzz.test_fuzz import Worker


@pytest.fixture(scope="session")
def worker():
    started = Worker()
    yield started
    started.close()
