"""The Poisson-Gaussian baseline as photon transfer measures it, and as estimators assume it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cannoise_jax.recordings.recording import PerChannel, per_channel


@dataclass(frozen=True)
class Baseline:
    """Poisson-Gaussian noise per channel, mosaic order: var = K (signal above black) + (read noise)^2, DN.

    gain: DN/e-. read_noise: DN, rows not included. black_level: DN. code_step: 0 where there is no lattice.
    gain_stderr: standard error of the gain, DN/e-.
    """

    gain: PerChannel
    read_noise: PerChannel
    black_level: PerChannel
    white_level: float
    code_step: float
    gain_stderr: PerChannel = (0.0, 0.0, 0.0, 0.0)

    @property
    def read_noise_e(self) -> PerChannel:
        """Read noise in electrons."""
        return per_channel(np.array(self.read_noise) / np.array(self.gain))
