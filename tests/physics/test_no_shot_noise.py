"""The photon transfer line of a sensor whose noise does not grow with the light, as of a bolometer."""

import numpy as np

from cannoise_jax.physics.transfer.fit import ChannelMaps, fit_line

SIZE, FRAMES, READ = (64, 80), 16, 3.0


def levels(rng: np.random.Generator) -> list[ChannelMaps]:
    """Three levels of light far above the black level, with the same white noise in each."""
    out = []
    for light in (6200.0, 6900.0, 7700.0):
        frames = light + rng.normal(0, READ, (FRAMES, *SIZE))
        usable = np.ones(SIZE, bool)
        out.append(ChannelMaps(frames.mean(0), frames.var(0, ddof=1), usable, FRAMES, FRAMES - 1, False))
    return out


def test_a_line_that_would_fall_is_level_at_the_noise_that_there_is():
    fallen = 0
    for seed in range(12):
        recorded = levels(np.random.default_rng(seed))
        line = fit_line(recorded, 0.0)
        assert line is not None and not line.sure
        measured = np.mean([level.variance for level in recorded])
        if line.slope.value < 1e-8:
            fallen += 1
            np.testing.assert_allclose(line.offset.value, measured, rtol=0.01)
        # Wherever the line meets zero, it goes through the noise that was seen.
        np.testing.assert_allclose(line.offset.value + line.slope.value * 6900, measured, rtol=0.01)
    assert 3 <= fallen <= 9
