"""Colour orders and exposures that are stated of recordings and that their levels contradict, and codes of
two scales."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy import stats

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.black import black_level
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.folders.sites import other_colours, two_gains
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import DARK, PerChannel, per_channel

_LONGER = 1.5
"""Times another exposure, from which light and dark charge have to tell both apart."""
_ALIKE = 0.02
"""Share by which flats of one level differ: of two exposures they do so where the lamp was changed."""
_GROWS = 0.1
"""Of what dark charge should grow by, that which it grows by at most where an exposure is wrong."""
_KELVIN = 1.0
"""By which two darks may differ to be compared: their charge does so by a tenth then, where it doubles
every 7 K."""
_ABOVE = 5.0
"""Times what the pixels of a flat differ by, which a dark is brighter: an offset that drifts is less."""
_SURE, _FEWEST = 10.0, 20
"""Standard errors that the charge of a hot pixel lies above none, and how many have to."""
_CLIPPED = 0.01
"""Share of its pixels at a rail from which on a flat is none that tells its light."""
_BY_CHANCE, _FRAMES, _OF_FLATS = 1e-5, 4, 0.005
"""Chance of a slope of the levels of a dark over its frames, how many it takes, and the share of the signal
of the dimmest flat by which they have to move: the gain may be off by as much."""
_PAIR, _TWICE, _NOISES = 2, 10.0, 2.0
"""Frames of a level, times their own spread, and noises of a pixel that two levels of one dark lie apart."""


def colours_line(statistics: Sequence[FrameStatistics]) -> str:
    """That the greens of the stated colour order are none, or that a sensor without colours has two gains, by
    the brightest flat that does not clip; empty where nothing speaks of either."""
    black = black_level(statistics).level
    flats = [s for s in statistics if s.recording.kind == "flat" and s.clipped.mean() < _CLIPPED]
    if not flats:
        return ""
    brightest = max(flats, key=lambda s: min(_light(s, black)))
    light = _light(brightest, black)
    cfa = brightest.recording.cfa
    said = (other_colours(light, cfa) or two_gains(light, cfa)) if min(light) > 0 else None
    return f"{_name(brightest)}: {said}" if said else ""


def codes_line(statistics: Sequence[FrameStatistics]) -> str:
    """That the codes of all flats lie further apart than those of all darks, or the other way round, as where
    one kind was stored shifted; empty where both have one lattice, or one has none."""
    known = [s for s in statistics if s.code_step > 0]
    flats, darks = ([s for s in known if (s.recording.kind in DARK) == of_dark] for of_dark in (False, True))
    for wide, fine in ((flats, darks), (darks, flats)):
        if not (wide and fine) or _of_a_table(wide):
            return ""
        one, two = min(wide, key=lambda s: s.code_step), max(fine, key=lambda s: s.code_step)
        if one.code_step >= 2 * two.code_step:
            return (
                f"codes of {_name(one)} lie {one.code_step:g} DN apart, those of {_name(two)} "
                f"{two.code_step:g}: one of them was shifted or scaled: give both as the camera wrote them, "
                "gain and read noise are wrong with it"
            )
    return ""


def _of_a_table(statistics: Sequence[FrameStatistics]) -> bool:
    """Whether codes lie the further apart the more light there is, as those of a lossy format do."""
    steps = [s.code_step for s in sorted(statistics, key=lambda s: float(np.mean(s.level)))]
    return steps[0] < steps[-1] and steps == sorted(steps)


def levels_line(statistics: Sequence[FrameStatistics]) -> str:
    """That the frames of a dark lie at two levels, neither of which is the rule; empty where they do not."""
    for s in statistics:
        levels = np.sort(s.frame_means.mean(1))
        if s.recording.kind not in DARK or s.variance is None or len(levels) < 2 * _PAIR:
            continue
        at = int(np.argmax(np.diff(levels))) + 1
        apart, within = (
            levels[at] - levels[at - 1],
            max(np.ptp(levels[:at]), np.ptp(levels[at:]), s.code_step),
        )
        room = max(_TWICE * within, _NOISES * float(np.sqrt(median(s.variance))))
        if min(at, len(levels) - at) >= _PAIR and apart > room:
            return (
                f"{_name(s)}: {len(levels) - at} of its {len(levels)} frames lie {apart:.3g} DN above the "
                f"others, and each agree to {within:.2g} DN: two exposures, temperatures or offsets in one "
                "set, so that what it tells is that of neither: part them"
            )
    return _creeping(statistics)


def _creeping(statistics: Sequence[FrameStatistics]) -> str:
    """That the level of a dark moves steadily over its frames, by what matters beside the dimmest flat."""
    flats = [s for s in statistics if s.recording.kind == "flat"]
    least = min((float(np.mean(s.level)) for s in flats), default=np.inf)
    for s in statistics:
        levels = s.frame_means.mean(1)
        if s.recording.kind not in DARK or len(levels) < _FRAMES:
            continue
        trend = stats.linregress(np.arange(len(levels)), levels)
        moves = float(trend.slope) * (len(levels) - 1)
        if trend.pvalue < _BY_CHANCE and abs(moves) > max(_OF_FLATS * least, s.code_step):
            return (
                f"{_name(s)}: its level moves by {moves:+.3g} DN from the first frame to the last, "
                f"{100 * abs(moves) / least:.2g} % of the signal of the dimmest flat: unless it warms or "
                "cools the black level creeps, and flats of another time stand on another one: the gain may "
                "be off by more than that"
            )
    return ""


def exposures_lines(statistics: Sequence[FrameStatistics]) -> tuple[str, str]:
    """Flats of one level, or darker than darks, and darks of one charge, of exposures that say otherwise: a
    line of each, empty where there are none."""
    return _exchanged(statistics) or _flats(statistics), _darks(statistics)


def _exchanged(statistics: Sequence[FrameStatistics]) -> str:
    """A dark that lies far above a flat that was exposed for as long."""
    darks = [s for s in statistics if s.recording.kind in DARK and s.recording.exposure_s is not None]
    for flat in statistics:
        seconds = flat.recording.exposure_s
        if flat.recording.kind != "flat" or seconds is None:
            continue
        for dark in darks:
            above = float(median(dark.mean)) - float(median(flat.mean))
            as_long = (dark.recording.exposure_s or 0.0) <= _LONGER * seconds
            if as_long and above > _ABOVE * max(float(np.std(flat.frame_means)), robust_std(flat.mean), 1.0):
                return (
                    f"{_name(dark)} is a dark and {above:.0f} DN brighter than {_name(flat)}, a flat exposed "
                    "for as long: light reached the one or none the other, or they are exchanged: mend what "
                    "is stated, all that darks or flats tell is wrong with it"
                )
    return ""


def _flats(statistics: Sequence[FrameStatistics]) -> str:
    black = black_level(statistics).level
    flats = [s for s in statistics if s.recording.kind == "flat" and s.clipped.mean() < _CLIPPED]
    for short, long in _pairs(flats):
        one, two = (float(np.mean(_light(s, black))) for s in (short, long))
        if min(one, two) > 0 and abs(one - two) < _ALIKE * max(one, two):
            return (
                f"{_both(short, long)} are of one level, within {100 * abs(one / two - 1):.1f} %: unless the "
                "light was changed between them one exposure is wrong: mend it, what is measured over the "
                "exposure is wrong with it"
            )
    return ""


def _darks(statistics: Sequence[FrameStatistics]) -> str:
    darks = [s for s in statistics if s.recording.kind in DARK and s.recording.exposure_s is not None]
    if len(darks) < 3:
        return ""
    zero = min(darks, key=lambda s: (s.recording.exposure_s or 0.0, -s.recording.count))
    for short, long in _pairs([s for s in darks if s is not zero]):
        own, celsius = short.recording.exposure_s or 0.0, [s.recording.temperature_c for s in (short, long)]
        apart = abs((celsius[0] or 0.0) - (celsius[1] or 0.0)) if None not in celsius else 0.0
        if own < 3 * (zero.recording.exposure_s or 0.0) or apart > _KELVIN:
            continue
        share = _charge(short, long, zero)
        if share is not None and share < 1 + _GROWS * ((long.recording.exposure_s or 0.0) / own - 1):
            return (
                f"{_both(short, long)}: in the longer hot pixels hold {share:.2f} times the charge that they "
                "hold in the other: unless it was colder one exposure is wrong: mend it, the dark current is "
                "wrong with it"
            )
    return ""


def _charge(short: FrameStatistics, long: FrameStatistics, zero: FrameStatistics) -> float | None:
    """Charge of the hot pixels of the longer dark over that of the shorter; None where few are hot. They are
    hot in the mean of both, so that chance in one of them chooses none."""
    if not short.mean.shape == long.mean.shape == zero.mean.shape:
        return None
    used = ~(short.clipped | long.clipped | zero.clipped)
    one, two = (s.mean - zero.mean for s in (short, long))
    one, two = (v - float(median(v[used])) for v in (one, two)) if used.any() else (one, two)
    both = (one + two) / 2
    noise = robust_std(both[used], 0.0) if used.any() else 0.0
    hot = used & (both > _SURE * max(noise, 0.1))
    if hot.sum() < _FEWEST or median(one[hot]) <= 0:
        return None
    return float(median(two[hot] / np.maximum(one[hot], 1e-9)))


def _pairs(statistics: Sequence[FrameStatistics]) -> list[tuple[FrameStatistics, FrameStatistics]]:
    """The shorter and the longer of every two whose exposures are far apart."""
    stated = (s for s in statistics if s.recording.exposure_s)
    known = sorted(stated, key=lambda s: s.recording.exposure_s or 0.0)
    return [
        (a, b)
        for a, b in combinations(known, 2)
        if (b.recording.exposure_s or 0.0) > _LONGER * (a.recording.exposure_s or 0.0)
    ]


def _light(s: FrameStatistics, black: PerChannel) -> PerChannel:
    return per_channel(np.array([float(median(site(s.mean, c))) - black[c] for c in range(4)]))


def _name(s: FrameStatistics) -> str:
    return s.recording.path or s.recording.camera


def _both(short: FrameStatistics, long: FrameStatistics) -> str:
    return " and ".join(f"{_name(s)} ({s.recording.exposure_s:g} s)" for s in (short, long))
