"""The families of statistics of a comparison: one record each, of what all that judge and tell need of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.compare import pieces, words
from cannoise_jax.discovery.compare.moves import JUMPS, LINE_LAGS, SINGLE
from cannoise_jax.discovery.compare.view import RESIDUES
from cannoise_jax.signatures import bank

TEMPORAL, STATIC = words.TEMPORAL, words.STATIC
STRUCTURE, SPARSITY, MOMENTS, TAILS = "structure", "sparsity", "moments", "tails"
NEIGHBOURS, BY_PARITY = "neighbours", "neighbours by parity"
UNSTEADY, IN_ONE_FRAME, STANDING_OUT = "pixels: unsteady", "pixels: one frame only", "pixels: standing out"
LEVELS, NEXT_LINES, LINE_NOISE = "pixels: levels", "next frame: lines", "noise of lines"
NEXT_FRAME, RAILS, CODES, LEVEL = "next frame: products", "rails", "codes", "level"
SMOOTH_MAPS, SHARED = "smooth maps", "shared with another recording"

TAIL_SIGMAS = (-3.5, -2.5, 2.5, 3.5)
"""Standard deviations of the noise beyond which values are counted: of a normal law 0.6 % lie beyond the
nearer limit on each side, where most frames tell, and 0.02 % beyond the farther, where tails are strong."""
UNSTEADY_CHANCES, QUIET_CHANCES = (1e-2, 1e-3, 1e-4, 1e-6), (1e-2, 1e-3)
"""Chances of a pixel's mean square beyond which, above and below, pixels are counted: from those that many
pixels make to those that no pixel of a megapixel makes."""
STANDING_SIGMAS = (-20.0, -10.0, -5.0, 5.0, 10.0, 20.0, 40.0, 80.0)
"""Standard deviations of the mean of the frames beyond which pixels are counted: from where healthy ones end
(6e-7 of a normal law), doubled as the charge of hot pixels spreads over decades."""
NEXT_LAGS = tuple((dy, dx) for dy in (0, 1, 2) for dx in (-2, -1, 0, 1, 2))
"""Rows and columns from a pixel to that of the frame after whose product is taken."""


class Family(NamedTuple):
    """A family of statistics.

    part: TEMPORAL or STATIC for what both the contrasts and the fixed map have, or the map alone; else "".
    name: within that part.
    time: TEMPORAL or STATIC, as the table says it.
    lines: of the table that its statistics speak for.
    falls: powers of the number of frames by which the statistics of their mean are smaller than of each one,
      of independent ones; one power for each of as many equal shares of the statistics.
    """

    part: str
    name: str
    time: str
    lines: pieces.Lines
    falls: tuple[float, ...] = (0.0,)

    @property
    def id(self) -> str:
        """By which the measured statistics are kept."""
        return of(self.part, self.name)


def of(part: str, name: str) -> str:
    """The id of a family."""
    return f"{part}: {name}" if part else name


def _both(name: str, lines: pieces.Lines, falls: tuple[float, ...] = (0.0,)) -> list[Family]:
    """Of what is redrawn and of what stays."""
    return [Family(part, name, part, lines, falls) for part in (TEMPORAL, STATIC)]


def _near(k: int) -> np.ndarray:
    """The lag of a correlation of `bank.product_statistics` that is told by the parity of the pixels."""
    near = bank.near_lags()
    return bank.lags()[near[k % near.size]]


def _tail(k: int) -> tuple[str, str]:
    return words.tail(TAIL_SIGMAS[k])


def _unsteady(k: int) -> tuple[str, str]:
    return words.unsteady((*UNSTEADY_CHANCES, *QUIET_CHANCES)[k], k < len(UNSTEADY_CHANCES))


def _jump(k: int) -> tuple[str, str]:
    side, size = divmod(k, len(JUMPS))
    return words.jump(-JUMPS[size] if side == 0 else JUMPS[size], JUMPS[size] >= SINGLE)


def _of_noise(variance: float) -> float:
    """Percent by which noise differs whose power has this relative variance."""
    return 50 * float(np.sqrt(max(variance, 0.0)))


def _line(k: int) -> tuple[str, str]:
    return words.line_memory(k < len(LINE_LAGS), LINE_LAGS[k % len(LINE_LAGS)])


FAMILIES = {
    family.id: family
    for family in (
        *_both(STRUCTURE, pieces.structure),
        *_both(SPARSITY, pieces.sparsity),
        *_both(NEIGHBOURS, pieces.correlations(lambda k: bank.lags()[k])),
        *_both(BY_PARITY, pieces.correlations(_near, ", unlike between the sites of the mosaic")),
        # Of independent frames, skewness of a mean falls with the root of their number, kurtosis with it.
        *_both(MOMENTS, pieces.moments, (0.0, 0.5, 1.0)),
        Family(TEMPORAL, TAILS, TEMPORAL, pieces.counts(_tail, per_frame=True)),
        Family(STATIC, TAILS, STATIC, pieces.counts(_tail)),
        Family(STATIC, SMOOTH_MAPS, STATIC, pieces.means(lambda k: words.smooth(bank.MOMENTS[k + 1]), "DN")),
        Family("", LEVEL, STATIC, pieces.level),
        Family("", UNSTEADY, TEMPORAL, pieces.counts(_unsteady)),
        Family("", LEVELS, TEMPORAL, pieces.counts(words.levels)),
        Family("", IN_ONE_FRAME, TEMPORAL, pieces.counts(_jump, per_frame=True)),
        Family("", STANDING_OUT, STATIC, pieces.counts(lambda k: words.standing_out(STANDING_SIGMAS[k]))),
        Family("", NEXT_FRAME, TEMPORAL, pieces.means(lambda k: words.memory(*NEXT_LAGS[k]))),
        Family("", NEXT_LINES, TEMPORAL, pieces.means(_line)),
        Family("", LINE_NOISE, TEMPORAL, pieces.means(words.line_noise, "% of the noise, rms", _of_noise)),
        Family("", RAILS, TEMPORAL, pieces.counts(words.rails, per_frame=True)),
        Family("", CODES, TEMPORAL, pieces.counts(lambda k: words.code(k, RESIDUES), per_frame=True)),
        Family("", SHARED, STATIC, pieces.means(words.shared)),
    )
}
"""Every family by its id."""
