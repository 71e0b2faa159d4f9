"""Compiled programs are kept for the next call, where that can be done, and not without end."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cannoise_jax.commands import compiled

ASKED = """
import os
from cannoise_jax.commands.compiled import keep_compiled
keep_compiled()
import jax, jax.numpy as jnp
from jax._src import monitoring
hits = []
monitoring.register_event_listener(lambda event, **_: hits.append(event.endswith("cache_hits")))
@jax.jit
def program(x):
    for _ in range(40):
        x = jnp.sort(jnp.linalg.cholesky(jnp.eye(8) * (2 + jnp.sum(x**2))) @ x)
    return x
print(sum(hits) if program(jnp.ones(8)).sum() > 0 else 0, sum(hits))
"""


def call(home: Path, **more: str) -> int:
    env = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_COMPILATION", "XDG_CACHE"))}
    env |= {"XDG_CACHE_HOME": str(home), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"} | more
    done = subprocess.run([sys.executable, "-c", ASKED], env=env, capture_output=True, text=True, check=True)
    return int(done.stdout.split()[-1])


def test_a_second_process_loads_what_the_first_compiled_and_damage_is_compiled_anew(tmp_path):
    assert call(tmp_path) == 0
    kept = sorted((tmp_path / "cannoise_jax" / "compiled").rglob("*-cache"))
    assert kept
    assert call(tmp_path) > 0
    for file in kept:
        file.write_bytes(file.read_bytes()[:40])
    assert call(tmp_path) == 0


def test_nothing_is_kept_where_the_user_says_so_or_it_cannot_be(tmp_path, monkeypatch):
    assert call(tmp_path, JAX_COMPILATION_CACHE_DIR="") == 0
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    compiled.keep_compiled()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_no_cache_depends_on_where_a_command_is_called(tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.chdir(tmp_path)
    for home in ("relative", "", "."):
        monkeypatch.setenv("HOME", home)
        assert compiled.caches().is_absolute() and tmp_path not in compiled.caches().parents
    monkeypatch.setenv("HOME", str(tmp_path))
    assert compiled.caches() == tmp_path / ".cache" / "cannoise_jax"


@pytest.mark.parametrize("most, left", [(400, 5), (399, 2)])
def test_the_oldest_go_where_it_grows_too_large(tmp_path, monkeypatch, most, left):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setattr(compiled, "MOST_BYTES", most)
    folder = tmp_path / "cannoise_jax" / "compiled" / compiled.processor()
    folder.mkdir(parents=True)
    for n in range(5):
        (folder / f"{n}-cache").write_bytes(bytes(80))
        os.utime(folder / f"{n}-cache", (n, n))
    compiled.keep_compiled()
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    assert sorted(f.name for f in folder.iterdir()) == [f"{n}-cache" for n in range(5 - left, 5)]
