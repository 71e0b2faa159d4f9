"""By how many kelvin the dark current doubles, from darks of two temperatures or more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.transfer.black import mean_error, mean_level
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable, Outcome, normal_estimate
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.join import ALIKE_KELVIN
from cannoise_jax.recordings.recording import DARK

NAME = "dark current, kelvin to double"
_CLEAR = 5.0
"""Standard errors by which means of darks have to rise with their exposure."""
_READING = 0.3
"""Standard error of a stated temperature, kelvin."""
_RECORD = NotMeasurable(
    "a camera model takes a usual value, which is not of this camera: record darks of two exposures or more "
    "at another temperature, some ten kelvin away"
)


def kelvin_to_double(statistics: Sequence[FrameStatistics]) -> Outcome | None:
    """From the growth of the means of darks at each temperature: ln(2) over the slope of its logarithm. None
    where darks show no dark current at any."""
    groups: list[list[FrameStatistics]] = []
    last: float | None = None
    darks = [s for s in statistics if s.recording.kind in DARK]
    known = [s for s in darks if s.recording.temperature_c is not None]
    for s in sorted(known, key=_celsius):
        if last is None or _celsius(s) - last > ALIKE_KELVIN:
            groups.append([])
        groups[-1].append(s)
        last = _celsius(s)
    rates = [(float(np.mean([_celsius(s) for s in g])), *r) for g in groups if (r := _rate(g)) is not None]
    if len(rates) < 2:
        return _RECORD if rates or _rate(darks) is not None else None
    celsius, rate, error = np.array(rates).T
    slope, spread, _ = _line(celsius, np.log(rate), (error / rate) ** -2.0)
    if slope <= 0:
        return _RECORD
    value = float(np.log(2)) / slope
    by_reading = np.sqrt(2) * _READING / float(np.ptp(celsius))
    return normal_estimate(value, value * float(np.hypot(spread**-0.5 / slope, by_reading)))


def _celsius(s: FrameStatistics) -> float:
    assert s.recording.temperature_c is not None
    return s.recording.temperature_c


def _rate(darks: Sequence[FrameStatistics]) -> tuple[float, float] | None:
    """Growth of the means of darks with their exposure, and its error, DN/s; None where it is not clear."""
    timed = [(s.recording.exposure_s, s) for s in darks if s.recording.exposure_s is not None]
    timed += [(0.0, s) for s in darks if s.recording.exposure_s is None and s.recording.kind == "bias"]
    if len({seconds for seconds, _ in timed}) < 2:
        return None
    seconds = np.array([t for t, _ in timed])
    levels = np.array([float(np.mean(mean_level(s))) for _, s in timed])
    errors = np.array([max(mean_error(s, range(4)), 1e-3) for _, s in timed])
    weight = errors**-2.0
    rate, spread, rest = _line(seconds, levels, weight)
    # Charge that grows otherwise, or a level that wanders, shows about the line.
    larger = float(np.sum(weight * rest**2)) / max(len(timed) - 2, 1)
    error = float(np.sqrt(max(larger, 1.0) / spread))
    return (rate, error) if rate > _CLEAR * error else None


def _line(
    at: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"], weight: Float[np.ndarray, "n"]
) -> tuple[float, float, Float[np.ndarray, "n"]]:
    """Slope of a line by weighted least squares, the information on it, and what it leaves."""
    away = at - np.average(at, weights=weight)
    spread = float(np.sum(weight * away**2))
    slope = float(np.sum(weight * away * values)) / spread
    return slope, spread, values - np.average(values, weights=weight) - slope * away


def doubling_of(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """What a law of thermal charge takes of it: nothing where it was not measured."""
    found = [o for o in outcomes if isinstance(o, Estimate)]
    return {"doubling_c": found[0].value} if found else {}
