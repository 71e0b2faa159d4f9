"""Black levels of the mosaic sites against those that are stated."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Scaling
from cannoise_jax.physics.robust import robust_std
from cannoise_jax.recordings.recording import DARK, mosaic_map
from cannoise_jax.signatures.added import as_map, placed
from cannoise_jax.signatures.fields import Fields, native
from cannoise_jax.signatures.handed import Addition, Found, Many
from cannoise_jax.signatures.least import Law, Seen, template
from cannoise_jax.signatures.levels import READS, STANDS_OUT, dark_levels, off_stated
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import BY_SHIFT, NO_LAW, Axes, Signature, unchanged

_FOUR_LEVELS = 7.0
"""Nats of the offsets of four channels against their mean: 2.3 for each of three, 0.5 log(n) of n = 106
values; `ONE_OF_SEVERAL` for each would be 7.5."""

CONTRASTS = np.array([[1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]])
"""Of the four sites: even rows against odd ones, even columns against odd ones, one diagonal against the
other."""


def shortest_dark(darks: Sequence[Fields]) -> Fields:
    """The one that black levels are told by: of several the one of most frames."""
    return min(darks, key=lambda f: (f.exposure_s or 0.0, -f.frames))


def parted_errors(dark: Fields) -> Float[np.ndarray, "3"]:
    """Standard errors of a quarter of each contrast between the sites of a dark, DN, by what its rows, its
    columns and the halves of either scatter by: patterns of lines part sites by more than pixels do."""
    static = np.asarray(dark.static, np.float64)
    limit = STANDS_OUT * max(robust_std(static[dark.usable], 0.0), 1.0)
    values = np.clip(static, -limit, limit) * dark.usable * dark.sigma / np.sqrt(dark.frames)
    h, w = (n // 2 for n in values.shape)
    cells = values[: 2 * h, : 2 * w].reshape(h, 2, w, 2)
    rows, columns = cells.mean(2), cells.mean(0).transpose(1, 0, 2)  # [line, parity of row, of column]

    def scatter(lines: np.ndarray) -> float:
        return float(np.mean(np.var(lines, axis=0, ddof=1))) / (2 * len(lines))

    whole_rows, turned_rows = rows.mean(2), np.diff(rows, axis=2) / 2
    whole_columns, turned_columns = columns.mean(1), np.diff(columns, axis=1) / 2
    pixel = float(np.var(values)) / values.size
    squares = np.array([
        scatter(whole_rows) + scatter(turned_columns), scatter(whole_columns) + scatter(turned_rows),
        scatter(turned_rows) + scatter(turned_columns),
    ])  # fmt: skip
    # The noise of pixels is in either.
    return np.sqrt(np.maximum(squares - pixel, pixel))


def _contrast_errors(
    fields: tuple[Fields, ...], recorded: Recorded, least: float
) -> tuple[Float[np.ndarray, "3"], float]:
    """The errors of the contrasts of the shortest dark as it was recorded, with all that is taken out of it
    later, and the number of lines that tell them. least: by the noise of the pixels alone."""
    darks = [f for f in recorded.unlit or fields if f.kind in DARK and f.static is not None]
    if not darks:
        return np.full(3, least), 1e9
    shortest = shortest_dark(darks)
    drawn_too = np.sqrt(2.0) if recorded.fitted_too else 1.0
    return np.maximum(drawn_too * parted_errors(native(shortest)), least), min(shortest.mean.shape) - 2.0


def channel_score(fields: tuple[Fields, ...], *, recorded: Recorded) -> Score | None:
    """Black levels against the stated ones: what channels differ in."""
    levels = dark_levels(tuple(native(f) for f in fields))
    if not levels:
        return None
    difference, error, _ = off_stated(levels, recorded)
    contrast = difference - difference.mean()
    slack = recorded.tolerance if np.any(np.ptp(recorded.black, axis=1) > 0) else 0.0
    reduced = np.sign(contrast) * np.maximum(np.abs(contrast) - slack, 0)
    errors, freedom = _contrast_errors(fields, recorded, error / 2)
    chi2 = float(np.sum((CONTRASTS @ reduced / 4 / errors) ** 2))
    rms = float(np.sqrt(np.mean(contrast**2)))
    spread = float(np.sqrt(np.mean(errors**2)))
    return Score(
        log_p=float(stats.f.logsf(chi2 / 3, 3, freedom)),
        gain=chi2 / 2,
        penalty=_FOUR_LEVELS,
        amplitude=float(np.sqrt(max(rms**2 - np.sum(errors**2), 0))),
        error=spread,
        shift=spread,
        power=1,
        parameters={f"offset_{c}": (float(contrast[c]), "DN", error) for c in range(4)},
        where={"axis": "channel", "channel": int(np.argmax(np.abs(contrast)))},
        payload=contrast,
    )


def black_of_channels(recorded: Recorded, *, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """Black levels that differ between the channels."""

    def pattern(fields: Many, score: Score[np.ndarray], rng: np.random.Generator) -> np.ndarray:
        return mosaic_map(np.asarray(score.payload, np.float64), fields[0].mean.shape)

    def simulate(found: Found) -> Addition | None:
        if found.pattern is None:
            return None
        rms = float(np.sqrt(np.mean(found.pattern**2)))
        maps = {"field": as_map(found.pattern / (rms or 1.0))}
        shift = np.asarray(found.score.payload)
        # Of codes, whatever the gain: as the black level itself.
        return Addition({parameter: rms}, maps, scaling=Scaling(), black_shift=shift)

    def least(sets: tuple[Seen, ...]) -> Law:
        y, x = np.mgrid[: sets[0].weight.shape[0], : sets[0].weight.shape[1]]
        return template(sets, lambda s: 1.0 - 2 * (y % 2 != x % 2), common=True)

    return Signature(
        name=name,
        axes=Axes("readout", "channel", "frozen", "additive", "contrast"),
        reads=READS,
        score=partial(channel_score, recorded=recorded),
        absorb=unchanged,
        covers=covers,
        predict=NO_LAW,
        pattern=pattern,
        simulate=simulate,
        place=placed(Point("readout", "signal", "channel", "frozen")),
        detectable=BY_SHIFT,
        least=least,
    )
