"""Checkpoints damaged on disk: what was not hurt is restored bit for bit, all else is refused in one line."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training.checkpoint import Checkpoints
from tests.fuzz.damage import damaged_bytes
from tests.fuzz.killed import small_state


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A workdir with two checkpoints, the newest not the best; and its newest state."""
    draw = jax.random.normal(jax.random.key(0), (64, 64))
    state = small_state()._replace(generator={"params": {"w": draw, "b": draw[0]}, "spectral": {}})
    folder = tmp_path_factory.mktemp("saved")
    checkpoints = Checkpoints(folder)
    for step, score in [(1, 0.1), (4, 0.3)]:
        state = state._replace(step=jnp.asarray(step))
        checkpoints.save(state, {"next_index": step}, score)
    checkpoints.close()
    return folder, state


def leaves(state):
    for leaf in jax.tree.leaves(state._asdict()):
        is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        yield leaf.dtype, np.asarray(jax.random.key_data(leaf) if is_key else leaf)


def outcome(folder: Path, like, state) -> str:
    """What comes of the newest checkpoint: refused, passed over, restored. A wrong state fails the test."""
    checkpoints = None
    try:
        checkpoints = Checkpoints(folder)
        newest, best = checkpoints.newest(), checkpoints.best()
        if newest != 4:
            return "passed over"
        restored, iterator = checkpoints.restore(like, newest)
    except BadInput as error:
        assert "\n" not in str(error) and len(str(error)) < 500
        assert "damaged" in str(error) and str(folder) in str(error)
        return "refused"
    finally:
        if checkpoints is not None:
            checkpoints.close()
    assert iterator == {"next_index": 4} and best == 1
    for (kind, new), (wanted, old) in zip(leaves(restored), leaves(state), strict=True):
        assert kind == wanted
        np.testing.assert_array_equal(new, old)
    return "restored"


def damage_and_restore(saved, seed: int, folder: Path) -> str:
    rng = random.Random(seed)
    workdir, state = saved
    shutil.copytree(workdir, folder)
    files = sorted(p for p in (folder / "checkpoints" / "4").rglob("*") if p.is_file() and p.stat().st_size)
    # The numbers lie in few of the files.
    large = [p for p in files if p.stat().st_size > 2000]
    victim = rng.choice(large if rng.random() < 0.5 else files)
    if rng.random() < 0.1:
        victim.unlink()
    else:
        victim.write_bytes(damaged_bytes(rng, victim.read_bytes())[0])
    try:
        return outcome(folder, jax.eval_shape(lambda: state), state)
    finally:
        shutil.rmtree(folder)


def test_damaged_checkpoints_are_refused_or_whole(saved, tmp_path, capfd):
    outcomes = [damage_and_restore(saved, seed, tmp_path / "w") for seed in range(8)]
    assert "refused" in outcomes
    printed = capfd.readouterr()
    assert "Traceback" not in printed.out + printed.err


@pytest.mark.slow
def test_many_damaged_checkpoints_are_refused_or_whole(saved, tmp_path):
    outcomes = [damage_and_restore(saved, 100 + seed, tmp_path / "w") for seed in range(300)]
    print({name: outcomes.count(name) for name in sorted(set(outcomes))})
    assert outcomes.count("refused") > 100 and "restored" in outcomes


def test_five_flipped_bytes_in_the_numbers_are_seen(saved, tmp_path):
    workdir, state = saved
    folder = tmp_path / "w"
    shutil.copytree(workdir, folder)
    files = (folder / "checkpoints" / "4" / "state").rglob("d/*")
    victim = max(files, key=lambda p: p.stat().st_size)
    content, rng = bytearray(victim.read_bytes()), random.Random(0)
    for _ in range(5):
        content[rng.randrange(len(content) // 4, 3 * len(content) // 4)] ^= 0x10
    victim.write_bytes(bytes(content))
    assert outcome(folder, jax.eval_shape(lambda: state), state) == "refused"


def test_a_changed_score_is_seen(saved, tmp_path):
    folder = tmp_path / "w"
    shutil.copytree(saved[0], folder)
    record = folder / "checkpoints" / "1" / "iterator" / "metadata"
    text = record.read_text()
    assert '"score": 0.1' in text
    record.write_text(text.replace('"score": 0.1', '"score": 0.9'))
    checkpoints = Checkpoints(folder)
    with pytest.raises(BadInput, match="record does not match its checksum"):
        checkpoints.best()
    checkpoints.close()
