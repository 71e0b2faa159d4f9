"""Black levels of the mosaic sites: found beside patterns of lines, and not made up by them."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.proof.judged import CALIBRATED, opened, searched
from cannoise_jax.mechanisms import ENTRIES
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, BLACK, READ = (64, 80), 100.0, 2.0
LINES = {
    "nothing": {},
    "rows": {"row": 0.8},
    "fixed rows and columns": {"rows_fixed": 0.4, "columns_fixed": 0.5},
    "rows of even and odd columns": {"turned": 0.8},
}


def camera(seed, parted=0.0, row=0.0, rows_fixed=0.0, columns_fixed=0.0, turned=0.0):
    """Darks of two exposures and a flat of a monochrome camera in plain NumPy, DN. parted: offset of odd
    columns, of the other sign that of even ones."""
    rng = np.random.default_rng(seed)
    h, w = SIZE
    odd = np.where(np.arange(w) % 2, 1.0, -1.0)
    fixed = rows_fixed * rng.standard_normal((h, 1)) + columns_fixed * rng.standard_normal(w) + parted * odd
    out = []
    for n, (kind, seconds, light) in enumerate((("dark", 0.01, 0), ("dark", 1.0, 0), ("flat", 0.01, 2000))):
        frames = 0.5 * rng.poisson(light, (8, h, w)) + READ * rng.standard_normal((8, h, w)) + fixed
        frames += row * rng.standard_normal((8, h, 1)) + turned * rng.standard_normal((8, h, 1)) * odd
        codes = np.clip(np.round(BLACK + frames), 0, 4095).astype(np.uint16)
        out.append(
            Recording(codes, "MONO", (BLACK,) * 4, 4095.0, kind=kind, exposure_s=seconds, path=f"{n}.h5")
        )
    return CaptureSet("camera", tuple(out))


def score(capture):
    judged = opened(capture, CALIBRATED, jax.random.key(0), lambda text: None, [])
    looking = splits_of(judged.capture, judged.stated, judged.drawn, searched(ENTRIES)).looking
    return {s.name: s for s in looking.signatures}["black_channels"].score(looking.fields)


@pytest.mark.parametrize("lines", LINES)
def test_lines_make_no_levels_of_sites_and_hide_none(lines):
    """The chance that four of them lie so low by chance is 5e-4."""
    chances = [np.exp(score(camera(seed, **LINES[lines])).log_p) for seed in range(4)]
    assert np.exp(np.mean(np.log(chances))) > 0.05
    found = score(camera(9, parted=0.4, **LINES[lines]))
    assert found.log_p < -15
    assert found.amplitude == pytest.approx(0.4, abs=3 * found.error + 0.02)
    assert np.sign(found.payload).tolist() == [-1, 1, -1, 1]
