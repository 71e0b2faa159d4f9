"""Frames that one particle hit: what is left of a pixel without its one far frame."""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.compare.strays import without_strays
from cannoise_jax.discovery.compare.view import reduce


def frames(seed: int, *, hits: int = 0, noisy: np.ndarray | None = None, count: int = 8) -> np.ndarray:
    """Codes of a dark of 5 DN of noise, `hits` pixels of it far off in one frame each."""
    rng = np.random.default_rng(seed)
    out = 500 + 5 * rng.standard_normal((count, 64, 96))
    if noisy is not None:
        out += 40 * noisy * rng.standard_normal(out.shape)
    for place in rng.choice(out[0].size, hits, replace=False):
        out[rng.integers(count)].flat[place] += 400
    return np.round(out).astype(np.uint16)


def reduced(stack: np.ndarray):
    return reduce(stack, 65535.0, True, 1.0)


def test_hits_at_other_places_leave_mean_and_noise():
    raw, drawn = reduced(frames(1, hits=30)), reduced(frames(2, hits=60, count=16))
    calm, less = without_strays(raw, drawn)
    assert np.abs(raw.mean - 500).max() > 40 and np.abs(calm.mean - 500).max() < 12
    for before, after in ((raw, calm), (drawn, less)):
        assert np.mean(before.contrasts**2, 0).max() > 5000 > 300 > np.mean(after.contrasts**2, 0).max()
    hit = np.mean(raw.contrasts**2, 0) > 2000
    assert hit.sum() == 30 and np.array_equal(calm.contrasts[:, ~hit], raw.contrasts[:, ~hit])
    # What is left of a hit pixel is as if the frame had the mean of the others.
    far = np.unravel_index(np.argmax(raw.mean), raw.mean.shape)
    values = frames(1, hits=30)[(slice(None), *far)].astype(float)
    rest = np.delete(values, np.argmax(values))
    assert np.isclose(calm.mean[far], rest.mean(), atol=1e-2)
    assert np.isclose(
        np.sum(calm.contrasts[(slice(None), *far)] ** 2), np.sum((rest - rest.mean()) ** 2), rtol=1e-3
    )


def test_pixels_of_the_camera_stay():
    rng = np.random.default_rng(4)
    noisy = rng.random((64, 96)) < 0.01
    raw, drawn = reduced(frames(5, noisy=noisy)), reduced(frames(6, noisy=noisy, count=16))
    calm, less = without_strays(raw, drawn)
    assert calm is raw and less is drawn
    # A simulator without such events leaves them to the remainder.
    raw, quiet = reduced(frames(7, hits=30)), reduced(frames(8, count=16))
    assert without_strays(raw, quiet)[0] is raw
