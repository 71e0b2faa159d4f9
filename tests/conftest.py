"""Shared by all tests: the slow mark, small thread pools, and the folder of real recordings."""

from __future__ import annotations

import atexit
import ctypes
import ctypes.util
import gc
import json
import os
import shutil
import tempfile
from functools import wraps
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import pytest

from cannoise_jax.commands.compiled import caches, processor

ROOT = Path(__file__).resolve().parents[1]

# Two workers share two cores: one thread pool each keeps them from fighting. Set before JAX is imported.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
# Tests run each program a few times only: compiled without optimisation, half of the time and a fifth of the
# memory. XLA's emitters of fusions cost most of both, and its flags come and go: only where they are known.
# In one piece, for the other core has a process of its own.
_XLA = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
_XLA += " --xla_cpu_parallel_codegen_split_count=1"
if version("jaxlib").startswith("0.10."):
    os.environ.setdefault("XLA_FLAGS", _XLA)


def _kept_folder() -> Path | None:
    """For compiled programs, beside that of the commands; None where none can be written."""
    try:
        folder = caches() / "compiled-in-tests" / processor()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: no home folder
        return None
    return folder if os.access(folder, os.W_OK) else None


# What one test compiles later ones load: on both processes, in the commands that they start, and in the next
# run of this or another checkout, which compiles only programs that have changed since: the name of each is a
# hash of all that it is made from. With a limit on the folder's size JAX locks it while it reads or writes.
_locks = find_spec("filelock") is not None  # without: a folder for each process, kept no longer than it
if "PYTEST_XDIST_WORKER" not in os.environ or not _locks:
    _folder = _kept_folder() if _locks else None
    if _folder is not None:
        from filelock import FileLock

        with FileLock(_folder / ".lockfile"):
            # A process that was killed while it wrote left a part, or no time: JAX mends neither.
            for _part in _folder.glob("*-cache"):
                if not _part.with_name(_part.name.removesuffix("cache") + "atime").exists():
                    _part.unlink()
        _compiled = str(_folder)
    else:
        _compiled = tempfile.mkdtemp(prefix="cannoise-tests-")
        atexit.register(shutil.rmtree, _compiled, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _compiled
    if _locks:
        os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(1 << 29)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

# Tracing makes many objects that stay: to look through them as often as Python does took a tenth of the time.
gc.set_threshold(20_000, 20, 50)


def _drawing_quickly():
    """Sensor models draw often: their program alone is optimised, which costs nothing and draws five times as
    fast, the same codes."""
    import jax

    from cannoise_jax.physics.core import sensor, sensor_draws

    def quick(name):
        plain = getattr(sensor_draws, name)
        level = {"xla_backend_optimization_level": 1}
        program = jax.jit(plain.__wrapped__, static_argnames="frames", compiler_options=level)

        @wraps(plain)
        def drawn(*given):  # within another program its options hold
            return (plain if isinstance(jax.numpy.zeros(()), jax.core.Tracer) else program)(*given)

        return drawn

    for name in ("sample_codes", "sample_analogue"):
        setattr(sensor, name, quick(name))


_drawing_quickly()

REAL_DATA = Path(os.environ.get("CANNOISE_DATA", ROOT.parent / "shared" / "data"))


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="also run long proofs and further variants")
    parser.addoption("--cases", type=int, default=10_000, help="of the long run of the fuzzer")
    parser.addoption("--first-seed", type=int, default=1_000, help="of that run")
    parser.addoption("--minutes", type=float, default=1e6, help="after which no more trainings are killed")
    parser.addoption("--results", metavar="DIR", help="where tests write what they measured, NAME.json each")


FIRST = (
    "blind/test_development",
    "training/test_loop",
    "discovery/test_own_mechanism",
    "commands/test_train",
    "discovery/test_report",
    "training/test_level",
    "discovery/test_diagnose",
    "commands/test_fleet",
    "evaluation/test_model_suites",
    "commands/test_denoise",
    "test_sampling",
    "training/test_step",
    "commands/test_diagnose",
    "fuzz/test_fuzz",
    "discovery/test_model",
    "discovery/test_signature_laws",
    "physics/test_mechanisms",
    "physics/test_closed_forms",
    "commands/test_sample",
    "training/test_devices",
)
"""Files that take minutes: begun first, so that no process is left alone with one of them at the end."""


def pytest_collection_modifyitems(config, items):
    order = {f"{ROOT / 'tests' / name}.py": n for n, name in enumerate(FIRST)}
    items.sort(key=lambda item: order.get(str(item.path), len(order)))
    if config.getoption("--slow"):
        return
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="slow: run with --slow"))


_GENERATORS: dict[str, dict] = {}


@pytest.fixture(autouse=True)
def own_draws(request):
    """Each test draws from its module's generator as it was after import, whatever ran before it."""
    rng = getattr(request.module, "RNG", None)
    if rng is not None:
        start = _GENERATORS.setdefault(request.module.__name__, rng.bit_generator.state)
        rng.bit_generator.state = start


_MOST_MEMORY = 1.5 * 2**30
"""Resident memory of a process from which on what it compiled is forgotten: it is on disk."""


@pytest.fixture(autouse=True)
def no_signs_of_life(request, monkeypatch):
    """What commands say when they were silent depends on how busy the machine is: not where messages are
    compared."""
    if request.path.name != "test_pulse.py":
        monkeypatch.setattr("cannoise_jax.commands.pulse.QUIET_S", float("inf"))


@pytest.fixture(scope="session", autouse=True)
def a_lighter_search(request):
    """Two threads of each of two processes take turns on two cores: a quarter more work, no sooner done. The
    composite score learns from a quarter of its draws, but in long proofs and for published tables: no other
    test asks it for the last thousandth of a nat."""
    from cannoise_jax.discovery.frames import threads
    from cannoise_jax.discovery.proof import quality

    threads.WORKERS = 1
    if not request.config.getoption("--slow") and not request.config.getoption("--results"):
        quality._LEARNED = 100_000


@pytest.fixture(scope="module", autouse=True)
def memory_given_back():
    """After each file: what compiling left behind goes back to the system."""
    yield
    statm = Path("/proc/self/statm")
    if not statm.exists():
        return
    if int(statm.read_text().split()[1]) * os.sysconf("SC_PAGESIZE") > _MOST_MEMORY:
        import jax

        jax.clear_caches()
        gc.collect()
    trim = getattr(ctypes.CDLL(ctypes.util.find_library("c")), "malloc_trim", None)  # glibc alone has it
    if trim is not None:
        trim(0)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings; tests that need it skip visibly where it is absent."""
    if not REAL_DATA.is_dir():
        pytest.skip(f"no real recordings at {REAL_DATA}: set CANNOISE_DATA to their folder")
    return REAL_DATA


SIMULATION = ("cannoise_jax/recordings", "cannoise_jax/physics", "cannoise_jax/mechanisms")
SEARCH = (*SIMULATION, "cannoise_jax/vocabulary.py", "cannoise_jax/signatures", "cannoise_jax/discovery")
"""What the numbers of a table depend on."""


class Tables:
    """Tables of what tests measured, by name, as `bin/bench docs --take` reads them."""

    def __init__(self):
        self.content: dict[str, dict] = {}

    def add(self, name: str, columns: tuple[str, ...], rows, code: tuple[str, ...], **values: str) -> None:
        """Adds rows, tuples of text, to a table; code: the paths that they depend on."""
        table = self.content.setdefault(name, {"columns": columns, "rows": [], "values": {}, "code": code})
        assert all(len(row) == len(columns) for row in rows)
        table["rows"] += [list(row) for row in rows]
        table["values"] |= values


@pytest.fixture(scope="session")
def tables(request):
    """Written at the end of the run, where --results names a folder; with it, run on one process."""
    kept = Tables()
    yield kept
    folder = request.config.getoption("--results")
    if folder:
        Path(folder).mkdir(parents=True, exist_ok=True)
        for name, content in kept.content.items():
            (Path(folder) / f"{name}.json").write_text(json.dumps(content, indent=1, ensure_ascii=False))
