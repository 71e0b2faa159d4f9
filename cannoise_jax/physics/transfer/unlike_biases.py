"""Whether biases, or the shortest darks, are frames of the same readout as longer darks.

Dark charge grows with the exposure, so what level and noise gain from the shortest darks to the next is what
they gain per second from those to the longest, or what the charge of the level alone explains. Biases that
are averages, or were read out in another mode, or with another offset, lie off by a step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.transfer.black import mean_error
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.quiet import coarse
from cannoise_jax.physics.transfer.views import usual_variance
from cannoise_jax.recordings.recording import DARK

_NOISE = 0.25
"""Of the variance of the shortest darks, the step from which the noise is another: an average of two has half
of it. Of the biases and shortest darks of three real cameras it is 0.04 at most."""
_LEVEL = 2.0
"""Noises of a pixel from which the level is another: black that moves with the exposure does so by less."""
_SIGMAS = 6.0
"""Standard errors by which noise or level must differ: of a normal law once in 500 million."""
_SYSTEMATIC = 0.03
"""Relative error of a variance besides chance: the usual pixel of a skew law moves with it."""


class _Darks(NamedTuple):
    """Darks of one exposure: mean level and temporal variance of a usual pixel, DN and DN^2, with errors."""

    seconds: float
    level: float
    level_error: float
    variance: float
    error: float


def unlike_biases(statistics: Sequence[FrameStatistics], gain: float = 0.0) -> str:
    """What is said of the shortest darks of one setting where they are no repeats of longer ones; empty where
    they are. gain: DN/e-, by which the level tells the shot noise of dark charge; 0: it is not known."""
    series = _series(statistics)
    if len(series) < 2:
        return ""
    short, next_, longest = series[0], series[1], series[-1]
    change, slopes = _change(short, next_), np.zeros(2)
    if len(series) > 2:
        slopes = np.maximum(_change(next_, longest) / (longest.seconds - next_.seconds), 0.0)
    step = change - slopes * (next_.seconds - short.seconds)
    # Noise is explained by what charge brings from there on, or by the charge of the level.
    noise = min(float(step[1]), float(change[1] - max(gain * change[0], 0.0)))
    doubt = np.hypot(*(np.hypot(d.error, _SYSTEMATIC * d.variance) for d in (short, next_)))
    quieter = noise > max(_NOISE * short.variance, _SIGMAS * doubt)
    which = "biases" if short.seconds == 0 else f"darks of {short.seconds:g} s"
    if quieter:
        ratio = np.sqrt(next_.variance / short.variance)
        more = ""
        if len(series) < 3:
            more = ", or the camera subtracts the level of dark charge (darks of a third exposure tell)"
        return (
            f"darks of {next_.seconds:g} s are {ratio:.2g} times as noisy as {which}, which their charge "
            f"does not explain: the {which} are averages, or of another readout, and the read noise with "
            f"them{more}"
        )
    room = max(
        _LEVEL * np.sqrt(short.variance), _SIGMAS * float(np.hypot(short.level_error, next_.level_error))
    )
    shot = gain * abs(float(step[0]))
    if gain and abs(step[0]) > room and step[1] < shot / 2 and len(series) > 2:
        return (
            f"darks of {next_.seconds:g} s lie {abs(step[0]):.3g} DN {'above' if step[0] > 0 else 'below'} "
            f"{which}, which their dark charge does not explain: another offset, or another exposure than is "
            "stated: black level and dark current are wrong with it"
        )
    return ""


def _change(one: _Darks, two: _Darks) -> Float[np.ndarray, "2"]:
    """Growth of level and variance."""
    return np.array([two.level - one.level, two.variance - one.variance])


def _series(statistics: Sequence[FrameStatistics]) -> list[_Darks]:
    """Repeated darks by exposure, a bias that states none as one of none; those of noise that rounding hides
    tell nothing."""
    darks: dict[float, list[FrameStatistics]] = {}
    for s in statistics:
        seconds = s.recording.exposure_s or (0.0 if s.recording.kind == "bias" else None)
        if s.recording.kind in DARK and s.variance is not None and seconds is not None and not coarse(s):
            darks.setdefault(seconds, []).append(s)
    return [_of(seconds, darks[seconds]) for seconds in sorted(darks)]


def _of(seconds: float, darks: Sequence[FrameStatistics]) -> _Darks:
    most = max(darks, key=lambda s: s.recording.count)
    assert most.variance is not None
    variance = float(np.mean([usual_variance(most, c) for c in range(4)]))
    # The median of a mean square is worth 0.6 of the mean.
    error = variance * np.sqrt(2 / (0.6 * most.variance.size * most.dof))
    return _Darks(
        seconds, float(np.mean(most.frame_means)), mean_error(most, range(4)), variance, float(error)
    )
