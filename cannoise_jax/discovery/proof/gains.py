"""What a finding gains on frames held back, nats, and how sure that is; the strength that they add to it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import stats

from cannoise_jax.discovery.frames.blocks import bands, frame_blocks, leave_out
from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.discovery.proof.heldout import Scored
from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.fields import Fields, without_pixels
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import Signature

_SURE_NATS = 20.0
"""Nats that a pattern has to gain without any one band of rows to be shown by the others alone."""
_BLOCKS = 6
"""Blocks of a jackknife."""

_LARGE = 5_000_000
"""Values from which a jackknife takes fewer blocks: statistics of large sets take seconds each."""


def strength_beyond(looked: Score, both: Score, held: Score) -> Score:
    """Strength of a frozen pattern from what the frames held back add to those that selected it.

    Log-likelihood of the frames held back given the others, log p(all) - log p(looked), as a function of the
    pattern's variance, each close to quadratic about its own estimate: their difference is again. The frames
    held back by themselves tell the strength too, and better where the others know the pattern already; of
    both, the one with the smaller error. The standard error of an estimate v is s + q v, s: without a
    pattern, q: from the draw of the pattern itself; both follow from each estimate's own errors.
    """

    def law(score: Score) -> tuple[float, float, float]:
        value, least = score.amplitude**2, score.shift**2
        error = 2 * max(score.amplitude, score.shift) * score.error
        return value, least, max(error - least, 0.0) / max(value, least)

    (v_all, s_all, q_all), (v_look, s_look, q_look), (_, s_held, q_held) = map(law, (both, looked, held))
    inverse_all, inverse_look = (s_all + q_all * v_all) ** -2, (s_look + q_look * v_all) ** -2
    left = inverse_all - inverse_look
    if not left > (s_held + q_held * v_all) ** -2:
        return held
    value = max((v_all * inverse_all - v_look * inverse_look) / left, 0.0)
    amplitude, error = float(np.sqrt(value)), float(left**-0.5)
    error /= 2 * max(amplitude, both.shift)
    name, (_, unit, _) = next(iter(held.parameters.items()))
    parameters = {**held.parameters, name: (amplitude, unit, error)}
    return held.replace(amplitude=amplitude, error=error, parameters=parameters)


def frame_interval(with_it: Scored, without: Scored) -> tuple[float, float, float]:
    """Total gain in nats and its 90 % interval: from the scatter of the parts of the frames within each
    recording where they were scored apart, else from that of the frames."""
    gains = with_it.log_prob - without.log_prob
    total = float(gains.sum())
    recordings = np.unique(with_it.recording)
    if with_it.parts is not None and without.parts is not None:
        values = with_it.parts - without.parts
        groups = [values[with_it.recording == r].ravel() for r in recordings]
        # What a part cannot tell of an offset that it shares with another is missing in the sum of the parts.
        scale = np.clip(total / values.sum(), 1.0, 2.0) ** 2 if values.sum() > 0 else 1.0
    elif gains.size > 1:
        several = [g for r in recordings if (g := gains[with_it.recording == r]).size > 1]
        groups = several or [gains]
        # Recordings of one frame scatter like the others.
        scale = gains.size / sum(g.size for g in groups)
    else:
        return total, float("nan"), float("nan")
    variances = np.array([g.size * np.var(g, ddof=1) for g in groups]) * scale
    freedom = variances.sum() ** 2 / max(np.sum(variances**2 / [g.size - 1 for g in groups]), 1e-300)
    half = float(stats.t.isf(0.05, max(freedom, 1.0)) * np.sqrt(variances.sum()))
    return total, total - half, total + half


def at_most_twice(with_it: Scored, without: Scored) -> tuple[Scored, Scored]:
    """Both with no part of a recording's frames, or no frame where they were not cut, counting for more than
    twice the typical one of that recording: a few pixels or frames far out may gain more than all others, and
    their scatter then says nothing. What one loses has a bound, the price of its offset."""
    values = with_it.log_prob - without.log_prob
    if with_it.parts is not None and without.parts is not None:
        values = with_it.parts - without.parts
    for r in np.unique(with_it.recording):
        own = with_it.recording == r
        values[own] = np.minimum(values[own], 2 * max(float(median(values[own])), 0.0))
    none = np.zeros_like(values)
    if values.ndim == 1:
        return with_it._replace(log_prob=values, parts=None), without._replace(log_prob=none, parts=None)
    gained = with_it._replace(log_prob=values.sum(1), parts=values)
    return gained, without._replace(log_prob=none.sum(1), parts=none)


def held_out_gain(found: Score, again: Score) -> float:
    """Log-likelihood gain on the frames held back at the parameters of the others, nats."""
    power = found.power
    a, b = found.amplitude**power, again.amplitude**power
    if not found.same_spot(again):
        return 0.0
    if not again.error > 0:  # a shape without a strength: less what its free parameters gain by chance
        return float(again.gain - again.penalty)
    error = max(power * max(again.amplitude, again.shift) ** (power - 1) * again.error, 1e-30)
    if not np.isfinite(error):
        return float(again.gain)
    return float(again.gain - 0.5 * np.clip((a - b) / error, -50.0, 50.0) ** 2)


def _less_known(whole: Score, part: Score) -> float:
    """What all frames know of the strength over what a part does, as 1 where their scores do not say."""
    shifts = (part.shift, whole.shift)
    if not np.isfinite(shifts).all() or min(shifts) <= 0:
        return 1.0
    return float((part.shift / whole.shift) ** (2 * whole.power))


def jackknife_interval(
    signature: Signature,
    fields: tuple[Fields, ...],
    found: Score,
    again: Score,
    gain: float,
    of: Callable[[tuple[Fields, ...]], Score | None] | None = None,
) -> tuple[float, float]:
    """90 % interval of a held-out gain by leaving out bands of rows, or blocks of frames where a row or frame
    shares what is new in it; nan for fewer than two blocks. again: the score of all frames held back. of: how
    the frames that are left score the finding, as `again` was; None: by `score_again`. What is left without a
    block knows less, by much where that was most of the longest dark: gains are compared as
    they would be of as much. The lower end is no lower than what is gained without any one block, less a
    margin."""
    size = sum(f.contrasts.size for f in fields)
    most = _BLOCKS if size < _LARGE else _BLOCKS // 2 + 1
    banded = signature.axes.in_bands
    blocks: list = bands(fields[0].mean.shape, most) if banded else frame_blocks(fields, most)
    if len(blocks) < 2:
        return float("nan"), float("nan")
    left: Callable[..., tuple[Fields, ...]] = without_pixels if banded else leave_out
    scored = of or (lambda those: signature.score_again(those, found))
    parts = each(lambda block: scored(left(fields, block)), blocks)
    gains = np.array([held_out_gain(found, s) * _less_known(again, s) for s in parts if s is not None])
    if gains.size < 2:
        return float("nan"), float("nan")
    g = gains.size
    half = float(stats.t.isf(0.05, g - 1) * np.sqrt((g - 1) / g * np.sum((gains - gains.mean()) ** 2)))
    low = gain - half
    if g > 2 and (banded or signature.redraws_frames or signature.axes.time == "redrawn"):
        # Of a few frames that lie far apart, or a pattern that most of the frame has little of, the scatter
        # of what each gains says nothing, but that any one can be left out does; and a likelihood ratio
        # exceeds 20 with a chance of 1/20 where there is nothing. A statistic of areas is no such ratio.
        of_frames = signature.redraws_frames and not banded
        least = float(gains.min()) - (float(np.log(20)) if of_frames else _SURE_NATS)
        # Parts that all gain more than the whole, as much as they know, bound nothing.
        low = max(low, least) if least <= gain else low
    return low, gain + half
