"""Whether the signal of flats grows as their exposure, as that of one light and a straight response does."""

from __future__ import annotations

from collections.abc import Sequence

from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.recording import PerChannel

NOT_LINEAR = (
    "values are not linear, as those of pictures with a gamma are not, or the light changed: the gain is not "
    "to be trusted, record raw frames under one light"
)
_BENDS = 0.03
"""Change of the signal per second from the shortest flat to the longest: lamps and shutters are good to a few
per cent, and a gain by photon transfer is off by about as much."""
_SIGMAS = 2.0
"""Standard errors of the black level that the dimmest flat may be off by."""
_FEWEST, _SPAN, _TOP = 3, 4.0, 0.9
"""Exposures, ratio of the longest to the shortest, and share of the white level up to which flats count."""


_NOT_LINEAR = 0.3
"""Change from which on the values are none of a linear sensor, or the light not one."""


def bends(flats: Sequence[FrameStatistics], black: PerChannel, c: int, error: float = 0.0) -> str:
    """How the signal per second of one channel changes as flats grow longer and brighter, where it does so
    steadily; empty else, and where too few exposures are known. error: of the black level, DN."""
    seen: dict[float, list[float]] = {}
    for s in flats:
        seconds, signal = s.recording.exposure_s, float(s.frame_means[:, c].mean()) - black[c]
        if s.recording.kind == "flat" and seconds and signal < _TOP * (s.recording.white_level - black[c]):
            seen.setdefault(seconds, []).append(signal)
    signals = [sum(v) / len(v) for _, v in sorted(seen.items())]
    times = sorted(seen)
    if len(times) < _FEWEST or times[-1] < _SPAN * times[0] or min(signals) <= 0:
        return ""
    rates = [v / t for v, t in zip(signals, times, strict=True)]
    steps = [b - a for a, b in zip(rates, rates[1:], strict=False)]
    growing = all(a < b for a, b in zip(signals, signals[1:], strict=False))
    change = rates[-1] / rates[0] - 1
    least = _BENDS + _SIGMAS * error / signals[0]
    if not growing or abs(change) < least or not (max(steps) <= 0 or min(steps) >= 0):
        return ""
    said = f"the signal per second changes by {100 * change:+.1f} % from {times[0]:g} to {times[-1]:g} s: "
    if abs(change) > _NOT_LINEAR:
        return said + NOT_LINEAR
    return f"{said}the response bends, or the light changed, and the gain of dim light is another"
