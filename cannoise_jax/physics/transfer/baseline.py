"""The Poisson-Gaussian baseline as it is measured, and as estimators and signatures assume it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False, kw_only=True)
class Baseline:
    """Poisson-Gaussian noise per channel, mosaic order: var = K (signal above black) + (read noise)^2, DN.

    gain: DN/e-. read_noise: DN. black_level: DN. gain_stderr, read_stderr: standard errors, 0 where nothing
    tells them. code_step: 0 where there is no lattice.
    """

    gain: Float[np.ndarray, "4"]
    read_noise: Float[np.ndarray, "4"]
    black_level: Float[np.ndarray, "4"]
    gain_stderr: Float[np.ndarray, "4"]
    read_stderr: Float[np.ndarray, "4"]
    white_level: float
    code_step: float

    @property
    def read_noise_e(self) -> Float[np.ndarray, "4"]:
        """Read noise in electrons."""
        return self.read_noise / self.gain

    @property
    def gain_error(self) -> float:
        """Relative standard error of the mean gain."""
        return float(np.linalg.norm(np.divide(self.gain_stderr, self.gain)) / 4)
