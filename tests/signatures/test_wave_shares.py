"""What is about a wave among the frequencies: never the wave itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft

from cannoise_jax.signatures.wave_shares import PAD, around

UPRIGHT = [(1 / 23.7, across / 160) for across in (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 78.0)]


@pytest.mark.parametrize("frequency", [*UPRIGHT, (0.0, 1 / 23.7), (1 / 23.7, 0.1)])
def test_a_wave_stands_out_as_far_whichever_way_it_runs(frequency):
    h, w = 120, 160
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:h, :w]
    power = np.zeros((PAD * h, PAD * w // 2 + 1))
    for _ in range(7):
        phase = 2 * np.pi * (frequency[0] * y + frequency[1] * x + rng.random())
        values = rng.standard_normal((h, w)) + 0.6 * np.sin(phase)
        values -= values.mean()
        power += np.abs(fft.fft(fft.rfft(values, PAD * w, axis=1), PAD * h, axis=0)) ** 2 / (7 * h * w)
    power[0, 0] = 0
    line = np.unravel_index(np.argmax(power), power.shape)
    assert power[line] > 500 and around(power)[line] < 0.01 * power[line]
