"""Whether the levels of darks rise and fall smoothly over the frame, with the exposure, as light does.

Glow need not fall off from a corner or an edge: a ring about a heated part, a spot of the package or two
amplifiers at once leave levels that no sum of such falls describes. What they have in common is that few
waves across the frame hold nearly all of it, unlike lines, tiles and a step between two halves.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Float
from scipy import fft

from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.falls import sums_of
from cannoise_jax.signatures.fields import Fields

_WAVES = 6
"""Half-periods along each side that hold the levels of a glow, less one. Of levels that are white along rows
or columns they hold a tenth to two fifths, of a step between halves 0.95, of tiles of a quarter of a side
0.8."""
_MOSTLY = 0.85
"""Share of how levels differ that these must hold."""
_STEP = 0.85
"""And the share of that which a step between two parts may explain at most: of a slope three quarters."""
_TILES, _TILED = 4, 0.75
"""Most tiles along a side, as of amplifiers, and the share of that from which on they describe the levels."""


def smooth(levels: Float[np.ndarray, "h w"]) -> bool:
    """Whether few waves across the frame hold what levels differ by, and neither a step between two parts nor
    even tiles describe it as well as as many waves do."""
    apart = levels - levels.mean()
    power = fft.dctn(apart, norm="ortho") ** 2
    whole = float(power.sum())
    if not whole > 0:
        return False
    held = float(power[:_WAVES, :_WAVES].sum()) / whole
    if held <= _MOSTLY or _of_a_step(apart) >= _STEP * held:
        return False
    for rows, columns in product(range(1, _TILES + 1), repeat=2):
        tiled = _of_tiles(apart, rows, columns)
        if tiled > _TILED * held and tiled > float(power[:rows, :columns].sum()) / whole:
            return False
    return True


def _of_a_step(apart: Float[np.ndarray, "h w"]) -> float:
    """Share of the squares of levels about their mean that two on either side of one line explain."""
    best = 0.0
    for axis in (0, 1):
        lines = apart.mean(1 - axis)
        before, n = np.cumsum(lines)[:-1], np.arange(1, lines.size)
        best = max(best, float(np.max(before**2 * (1 / n + 1 / (lines.size - n)))) / lines.size)
    return best / float(np.mean(apart**2))


def _of_tiles(apart: Float[np.ndarray, "h w"], rows: int, columns: int) -> float:
    """The same of the means of so many even tiles."""
    parts = (np.array_split(band, columns, 1) for band in np.array_split(apart, rows, 0))
    squares = sum(part.size * float(part.mean()) ** 2 for band in parts for part in band)
    return squares / float(np.sum(apart**2))


def grows(fields: tuple[Fields, ...], form: Float[np.ndarray, "h w"]) -> bool:
    """Whether this form is in darks of several exposures in proportion to these, rather than in all alike."""
    dark = [f for f in fields if f.kind in DARK and f.static is not None and f.exposure_s is not None]
    if len({f.exposure_s for f in dark}) < 2:
        return False
    row = form.reshape(1, -1).astype(np.float32)
    told = [sums_of((f._replace(exposure_s=None),), row) for f in dark]
    u, i = (np.array([float(sums[k][0]) for sums in told]) for k in (0, 1))

    def unexplained(shape: np.ndarray) -> float:
        return -(float(u @ shape) ** 2) / float(i @ shape**2)

    exposures = np.array([f.exposure_s for f in dark])
    return unexplained(exposures) < unexplained(np.ones(len(dark)))
