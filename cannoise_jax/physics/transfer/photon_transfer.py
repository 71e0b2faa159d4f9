"""Photon transfer: the Poisson-Gaussian baseline of a camera, from its recordings alone.

Quantities and symbols follow EMVA 1288 release 4.0 (linear camera model): system gain K, temporal dark noise
sigma_d, DSNU1288, PRNU1288, dark current mu_I, saturation; in DN as stored and in electrons. Temporal noise
comes from changes between frames (see `transfer.frames`), the slope from `transfer.fit` with its rule for
outliers, fixed patterns from `transfer.spatial`. What the recordings cannot give is `NotMeasurable` and says
what to record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.black import Black, black_level, mean_level, of_one_dark, reference_dark
from cannoise_jax.physics.transfer.doubling import NAME, kelvin_to_double
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable, Outcome, normal_estimate
from cannoise_jax.physics.transfer.estimator import Each
from cannoise_jax.physics.transfer.fit import ChannelMaps, Line, fit_line
from cannoise_jax.physics.transfer.frames import FrameStatistics, frame_statistics, of_variance
from cannoise_jax.physics.transfer.full_well import below_full, full_signal
from cannoise_jax.physics.transfer.one_temperature import of_one_temperature
from cannoise_jax.physics.transfer.patterns import pattern_quantities
from cannoise_jax.physics.transfer.quantities import (
    DIMMER,
    RECORD_DARKS,
    RECORD_FLATS,
    SET_ASIDE,
    UNSURE,
    Quantity,
    dark_current_quantities,
    line_noise_quantity,
    noise_quantities,
    saturation_quantities,
    series_of,
)
from cannoise_jax.physics.transfer.quiet import (
    BELOW_A_CODE,
    hidden_in_a_code,
    loses_noise,
    noise_below_a_code,
    unchanging,
    with_rounding_told,
)
from cannoise_jax.physics.transfer.rails import (
    LINEAR,
    STILL,
    below_rail,
    lit_of,
    moved,
    with_measured_black,
)
from cannoise_jax.physics.transfer.ranges import finest
from cannoise_jax.physics.transfer.shape import shape_quantities
from cannoise_jax.physics.transfer.spacing import own_step, rounding_beyond
from cannoise_jax.physics.transfer.unlit import without_unlit
from cannoise_jax.physics.transfer.views import (
    dark_shot,
    pixel_variance,
    quiet_pixels,
    unlike_sites,
    usual_variance,
    with_all_sites,
)
from cannoise_jax.recordings.packing import ALL, PACKED_CHANNELS, site, to_mosaic_order
from cannoise_jax.recordings.recording import BadInput, CaptureSet, PerChannel, Recording, name_of

_ENOUGH = 0.05
"""Share of the pixels of a channel that have to be left of a recording."""
_MANY = 256
"""Pixels that have to be left of a flat without those that are noisy in the dark: a line through fewer is
better with them."""
_TELLS = 0.02
"""Relative error of a slope through flats alone up to which darks need not tell it."""
_DARKER = 8.0
"""Standard deviations of the dark below it from which on what a flat has is no pixel: a counter, or other
data that a camera writes into its frames."""
_TOLD = 4
"""Frames of a dark from which a pixel of three times the noise of the others is told, mostly."""


@dataclass(frozen=True)
class PhotonTransfer:
    """All that photon transfer finds at one ISO setting."""

    camera: str
    iso: float | None
    cfa: str
    baseline: Baseline | NotMeasurable
    quantities: tuple[Quantity, ...]
    statistics: tuple[FrameStatistics, ...]

    def outcomes(self, name: str, unit: str | None = None) -> list[Outcome]:
        """The outcomes of a quantity (in one of its units), in the order of the channels."""
        return [q.outcome for q in self.quantities if q.name == name and unit in (None, q.unit)]


def photon_transfer(captures: CaptureSet) -> tuple[PhotonTransfer, ...]:
    """Photon transfer of a capture set, one result per ISO setting (recordings without ISO are one setting).

    Raises BadInput when recordings of one setting differ in size, colour order or white level.
    """
    settings = sorted({r.iso for r in captures.recordings}, key=lambda iso: (iso is not None, iso))
    return tuple(
        transfer_at([frame_statistics(r) for r in captures.recordings if r.iso == iso]) for iso in settings
    )


def channel_names(cfa: str) -> tuple[str, str, str, str]:
    """Names of the mosaic sites in mosaic order: R, Gr, Gb, B; positions for a monochrome sensor."""
    if cfa == "MONO":
        return "00", "01", "10", "11"
    a, b, c, d = to_mosaic_order(np.array(PACKED_CHANNELS), cfa)
    return str(a), str(b), str(c), str(d)


def channels_of(t: PhotonTransfer) -> tuple[str, ...]:
    """The channels that a result tells apart: those of the mosaic, or `all` alone (`of_all_pixels`)."""
    apart = any(q.channel != "all" for q in t.quantities)
    return channel_names(t.cfa) if apart else ("all",)


def transfer_at(statistics: Sequence[FrameStatistics], each: Each = iter) -> PhotonTransfer:
    """Photon transfer of recordings made at one ISO setting. each: goes through the channels, one by one as
    they are measured. Raises BadInput as `photon_transfer`."""
    _check_alike([s.recording for s in statistics])
    doubling = kelvin_to_double(statistics)
    statistics = list(map(with_rounding_told, of_one_temperature(statistics)[0]))
    statistics = of_one_dark(without_unlit(with_measured_black(statistics)))
    first = statistics[0].recording
    step = _code_step(statistics)
    dark = reference_dark(statistics)
    black = black_level(statistics)
    lines = channel_lines(statistics)
    names = channel_names(first.cfa)
    quantities = [
        q
        for c, n in enumerate(each(names))
        for q in _channel_quantities(n, c, lines[c], statistics, dark, black)
    ]
    quantities.append(line_noise_quantity("row noise", dark, 0))
    quantities.append(line_noise_quantity("column noise", dark, 1))
    quantities += shape_quantities(dark) if dark is not None and not unchanging(dark) else []
    quantities += [] if doubling is None else [Quantity(NAME, "K", "all", doubling)]
    unknown = "needs a known photon flux: record flats under a calibrated light"
    quantities.append(Quantity("quantum efficiency", "e-/photon", "all", NotMeasurable(unknown)))
    return PhotonTransfer(
        first.camera, first.iso, first.cfa, _baseline(lines, black.level, first, step, quantities),
        tuple(sorted(quantities, key=_table_order(quantities))), tuple(statistics),
    )  # fmt: skip


def of_all_pixels(t: PhotonTransfer) -> PhotonTransfer:
    """The same of a sensor without colours with all pixels as one channel, `all`; of any other as it is.

    The baseline has the values of that channel for every site.
    """
    if t.cfa != "MONO" or channels_of(t) == ("all",):
        return t
    statistics = [with_all_sites(s) for s in t.statistics]
    dark, step = reference_dark(statistics), _code_step(statistics)
    black = _of_all(black_level(t.statistics), reference_dark(t.statistics))
    lit = lit_of(statistics)
    line = _line(lit, dark, black.level, step, ALL)
    own = _channel_quantities("all", ALL, line, statistics, dark, black)
    shared = [q for q in t.quantities if q.channel == "all"]
    base = _baseline([line] * 4, (black.level[ALL],) * 4, statistics[0].recording, step, own * 4)
    quantities = sorted((*own, *shared), key=_table_order(list(t.quantities)))
    return replace(t, baseline=base, quantities=tuple(quantities))


def _of_all(black: Black, dark: FrameStatistics | None) -> Black:
    """With the level of all sites together after those of each."""
    error = float(np.sqrt(np.mean(np.square(black.error)) / 4))
    if dark is not None and dark.rounded is not None:  # of which all sites know as little
        error = float(np.hypot(error, np.mean(dark.rounded[1])))
    return black._replace(level=(*black.level, float(np.mean(black.level))), error=(*black.error, error))  # type: ignore[arg-type]


def _channel_quantities(
    name: str, c: int, line: Line | NotMeasurable, statistics: Sequence[FrameStatistics],
    dark: FrameStatistics | None, black: Black,
) -> list[Quantity]:  # fmt: skip
    series, step = series_of(c, line, statistics), _code_step(statistics)
    return [
        *noise_quantities(name, c, line, statistics, dark, step=step, black=black, series=series),
        *pattern_quantities(name, c, line, statistics, dark, black.level),
        *dark_current_quantities(name, c, line, statistics, series),
        *saturation_quantities(name, c, line, statistics, black.level),
    ]


def channel_lines(statistics: Sequence[FrameStatistics]) -> list[Line | NotMeasurable]:
    """The photon transfer line of every channel, mosaic order."""
    lit, dark = lit_of(statistics), reference_dark(statistics)
    black, step = black_level(statistics).level, _code_step(statistics)
    return [_line(lit, dark, black, step, c) for c in range(4)]


def _code_step(statistics: Sequence[FrameStatistics]) -> float:
    return min((s.code_step for s in statistics if s.code_step > 0), default=0.0)


def _check_alike(recordings: Sequence[Recording]) -> None:
    first = recordings[0]
    for number, other in enumerate(recordings[1:], start=1):
        for field, what in (("size", "size"), ("cfa", "colour order"), ("white_level", "white level")):
            if getattr(other, field) != getattr(first, field):
                raise BadInput(
                    f"{name_of(other, number)}: {what} {getattr(other, field)} differs from "
                    f"{getattr(first, field)} of {name_of(first, 0)}: calibrate recordings "
                    "of one sensor mode together"
                )


def _table_order(quantities: list[Quantity]):
    order = {(q.name, q.unit): at for at, q in reversed(list(enumerate(quantities)))}
    return lambda q: order[q.name, q.unit]


def _levels(
    lit: list[FrameStatistics], dark: FrameStatistics | None, black: PerChannel, step: float, c: int
) -> list[ChannelMaps]:
    levels = []
    full = full_signal(lit, c)
    # The line goes from the noise of the quiet pixels of the dark through that of the same pixels in light.
    quiet = (
        quiet_pixels(dark, c, step**2 / 12)
        if dark is not None and dark.recording.count >= _TOLD
        else np.True_
    )
    within = [
        s for s in finest(lit, step)
        if s.variance is not None and s.level[c] < LINEAR * (s.recording.white_level - black[c])
        and below_full(s, full, black[c], c)
    ]  # fmt: skip
    for s in within or [s for s in finest(lit, step) if s.variance is not None]:
        signal = (site(s.mean, c) - black[c]) * site(of_variance(s), c)
        variance = pixel_variance(s, c) - dark_shot(s, c) - rounding_beyond(s, site(s.mean, c), step)
        usable = below_rail(s, c)
        if dark is not None and dark.variance is not None:  # no light makes a pixel darker than the dark
            usable &= signal > -_DARKER * np.sqrt(usual_variance(dark, c) + step**2)
        if usable.mean() > _ENOUGH:
            if (usable & quiet).sum() >= _MANY:
                usable = usable & quiet
            levels.append(ChannelMaps(signal, variance, usable, s.recording.count, s.dof, False))
    if dark is not None and dark.variance is not None:
        # Charge that a longer dark holds beyond black has shot noise like any other.
        charge = max(float(mean_level(dark)[c]) - black[c], 0.0)
        zero = np.full(site(dark.mean, c).shape, charge)
        usable, variance = ~site(dark.clipped, c), pixel_variance(dark, c)
        own_codes = own_step(dark, step)
        if not (below := noise_below_a_code(dark, own_codes, c)):
            variance = variance - rounding_beyond(dark, site(dark.mean, c), step)
        else:
            # Rounding adds step^2 / 12 to flats, and something else to noise of less than a code.
            own = below.read.value**2 + step**2 / 12
            variance = variance + (own - below.square)
            # Of pixels at a code where values pile up, or at few of a table, each by itself tells nothing.
            if own_codes > step or hidden_in_a_code(dark, own_codes, c):
                usable, variance = np.ones(usable.shape, bool), np.full(variance.shape, own)
        levels.append(
            ChannelMaps(zero, variance, usable, dark.recording.count, dark.dof, True, unlike_sites(dark, c))
        )
    return levels


def _line(
    lit: list[FrameStatistics], dark: FrameStatistics | None, black: PerChannel, step: float, c: int
) -> Line | NotMeasurable:
    if not any(s.variance is not None for s in lit):
        return NotMeasurable(RECORD_FLATS)
    if why := moved(lit, c):
        return NotMeasurable(why)
    levels = _levels(lit, dark, black, step, c)
    if all(level.known_signal for level in levels):
        return NotMeasurable(DIMMER)
    own_codes = step if dark is None else own_step(dark, step)
    quiet = None if dark is None else noise_below_a_code(dark, own_codes, c)
    bounded = quiet is not None and quiet.read.ci90[0] <= 0
    cut = dark is not None and loses_noise(dark, own_codes, c)
    if bounded or cut:  # then flats of several levels tell the slope alone, and the dark would bend it
        line = fit_line([level for level in levels if not level.known_signal], step**2 / 12)
        if line is not None and line.slope.stderr < _TELLS * line.slope.value:
            return line
    line = fit_line(levels, step**2 / 12)
    if line is None or not line.sure:
        if dark is None:
            return NotMeasurable(f"{RECORD_DARKS}, or flats of several levels")
        return NotMeasurable(BELOW_A_CODE if hidden_in_a_code(dark, own_codes, c) else UNSURE)
    if line.dropped > SET_ASIDE and any(s.recording.kind == "scene" for s in lit):
        return NotMeasurable(f"{100 * line.dropped:.0f} % of pixels change by more than noise: {STILL}")
    if quiet is None or not bounded:
        return line
    # Of the darks' variance only the most that it can be is known, and of their level where it may be.
    brightest = max(float(median(level.signal)) for level in levels)
    doubt = (0.5 * quiet.read.ci90[1] ** 2 + quiet.level.stderr * line.slope.value) / brightest
    return replace(line, slope=normal_estimate(line.slope.value, float(np.hypot(line.slope.stderr, doubt))))


def _baseline(
    lines: list[Line | NotMeasurable], black: PerChannel, first: Recording, step: float,
    quantities: list[Quantity],
) -> Baseline | NotMeasurable:  # fmt: skip
    reads = [q.outcome for q in quantities if q.name == "temporal dark noise" and q.unit == "DN"]
    lacking = [
        n for n, one in zip(channel_names(first.cfa), lines, strict=True) if isinstance(one, NotMeasurable)
    ]
    for outcome in (*lines, *reads):
        if isinstance(outcome, NotMeasurable):
            some = 0 < len(lacking) < len(lines) and outcome in lines and first.cfa != "MONO"
            return NotMeasurable(f"of {', '.join(lacking)}: {outcome.record}") if some else outcome
    slopes = [line.slope for line in lines if isinstance(line, Line)]
    noises = [r for r in reads if isinstance(r, Estimate)]
    return Baseline(
        gain=np.array([e.value for e in slopes]),
        read_noise=np.array([e.value for e in noises]),
        black_level=np.array(black),
        gain_stderr=np.array([e.stderr for e in slopes]),
        read_stderr=np.array([e.stderr for e in noises]),
        white_level=first.white_level,
        code_step=step,
    )
