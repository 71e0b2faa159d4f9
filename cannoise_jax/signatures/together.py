"""Rows that share one number because they are read together: so many at a time, from a first one on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.signatures.answers import less_shared
from cannoise_jax.signatures.fields import Answers, Fields
from cannoise_jax.signatures.group_sums import LineSums

_MOST = 4
"""Rows read together at most: two where neighbours share an amplifier, four where those of both greens do."""
LEAST_GAIN = 10.0
"""Nats by which rows read together must explain the rows better than each by itself does. Of the arrangements
of white rows the best gains more than 10 by chance in one of some 2,000 sets."""


class Together(NamedTuple):
    """So many rows share a number; `phase` of the first group's lie before the frame."""

    rows: int = 1
    phase: int = 0

    def of(self, height: int) -> np.ndarray:
        """Group of every row, from 0."""
        return (np.arange(height) + self.phase) // self.rows

    def describes(self) -> dict[str, int]:
        """What a finding says of it; nothing where every row is by itself."""
        return {} if self.rows == 1 else {"rows_together": self.rows, "first_row": -self.phase}


ALONE = Together()
ARRANGEMENTS = tuple(Together(rows, phase) for rows in range(2, _MOST + 1) for phase in range(rows))


def summed(sums: LineSums, together: Together) -> LineSums:
    """Scores and information of groups of rows."""
    if together == ALONE:
        return sums
    group = together.of(sums.information.size)
    size = int(group[-1]) + 1
    score = np.stack([np.bincount(group, s, size) for s in sums.score]) if len(sums.score) else sums.score
    return LineSums(score.reshape(len(sums.score), size), np.bincount(group, sums.information, size))


def folded(field: Fields, together: Together) -> Fields:
    """The field with the rows of a group laid end to end as one row; pixels beyond the frame are none."""
    if together == ALONE:
        return field
    count, (rows, columns) = together.rows, field.mean.shape
    after = -(rows + together.phase) % count

    def fold(x: Float[np.ndarray, "*n h w"]) -> np.ndarray:
        wide = [(0, 0)] * (x.ndim - 2) + [(together.phase, after), (0, 0)]
        return np.pad(x, wide, mode="edge").reshape(*x.shape[:-2], -1, count * columns)

    inside = np.pad(np.ones((rows, columns), bool), [(together.phase, after), (0, 0)])
    return field._replace(
        mean=fold(field.mean),
        signal=fold(field.signal),
        sigma=fold(field.sigma),
        shot=fold(field.shot),
        usable=fold(field.usable) & inside.reshape(-1, count * columns),
        contrasts=fold(field.contrasts),
        static=None if field.static is None else fold(field.static),
        answers=Answers(),
    )


def unfolded(field: Fields, together: Together, like: Fields) -> Fields:
    """`like` with the noise of a field that was `folded`, as rows again."""
    if together == ALONE:
        return field
    rows, columns = like.mean.shape
    kept = slice(together.phase, together.phase + rows)

    def unfold(x: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(x.reshape(*x.shape[:-2], -1, columns)[..., kept, :])

    out = like._replace(
        sigma=unfold(field.sigma),
        shot=unfold(field.shot),
        contrasts=unfold(field.contrasts),
        static=None if field.static is None else unfold(field.static),
    )
    if "row" not in field.answers.kept:
        return out
    # What a row of its own has in common with its group is gone as well, no more.
    left = field.answers.kept["row"][together.of(rows)]
    return less_shared(out, "row", np.sqrt(1 - (1 - left**2) / together.rows).astype(np.float32))
