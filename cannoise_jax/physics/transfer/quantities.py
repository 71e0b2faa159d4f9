"""The lines of the photon transfer table, one channel at a time: noise, dark current, saturation.

Definitions follow EMVA 1288 release 4.0; `transfer` puts the lines together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.transfer.black import Black
from cannoise_jax.physics.transfer.dark import Series, dark_currents, dark_series, unlike_charge
from cannoise_jax.physics.transfer.estimate import (
    Z90,
    Estimate,
    NotMeasurable,
    Outcome,
    normal_estimate,
    root,
    scatter_estimate,
)
from cannoise_jax.physics.transfer.estimators.lines import line_noise, wave_of_rows
from cannoise_jax.physics.transfer.fit import Line
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.full_well import full_codes, full_signal
from cannoise_jax.physics.transfer.quiet import (
    BELOW_A_CODE,
    coarse,
    hidden_in_a_code,
    loses_noise,
    mean_square_of,
    noise_below_a_code,
    square_below_a_code,
    unchanging,
)
from cannoise_jax.physics.transfer.rails import is_cut_off
from cannoise_jax.physics.transfer.ranges import coarser_range
from cannoise_jax.physics.transfer.several_gains import uneven_gain
from cannoise_jax.physics.transfer.spacing import MOSTLY_ROUNDING, own_step, spacing_line
from cannoise_jax.physics.transfer.straight import NOT_LINEAR, bends
from cannoise_jax.physics.transfer.views import pixel_variance, quiet_mean_square, quiet_pixels
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import DARK, PerChannel

RECORD_FLATS = "record at least 2 frames of an even, steady light, best at several levels up to saturation"
UNSURE = (
    "the noise of the flats does not surely grow with their light (too dim, or darks and flats of other "
    "settings): record brighter flats, 2 frames or more, best at several levels"
)
CUT_OFF = "darks are cut off at black: raise the camera's offset and record darks again"
SET_ASIDE = 0.1
"""Share of pixels beyond which those set aside are no few outliers, and the others no sound majority: of the
noisiest camera tried it is a fortieth."""
_NOISIER = 1.0
"""Per cent of pixels set aside from which they are said."""
_OWN = 0.04
"""Share of the temporal variance of a dark from which its own dark charge is said: 2 % of the noise."""
DIMMER = "values of all flats pile up at the highest code: record dimmer flats, 2 frames or more"
RECORD_DARKS = (
    "record at least 2 frames of one exposure with the cap on (one alone shows no noise), best that of flats"
)


@dataclass(frozen=True)
class Quantity:
    """One cell of the table: what was measured and the outcome. channel: of `channel_names`, or all. doubt:
    of the note, what bears on all other numbers too."""

    name: str
    unit: str
    channel: str
    outcome: Outcome
    note: str = ""
    doubt: str = ""


def noise_quantities(
    name: str, c: int, line: Line | NotMeasurable, statistics: Sequence[FrameStatistics],
    dark: FrameStatistics | None, *, step: float, black: Black, series: Series | NotMeasurable,
) -> list[Quantity]:  # fmt: skip
    """Black level, gain, and temporal noise in the dark."""
    out: list[Quantity] = []
    spaced, step = spacing_line(statistics, step, c), step if dark is None else own_step(dark, step)
    sigma = _read_noise(line, dark, step, c)
    level_note, noise_note = _own_charge(dark, black, line, sigma, series)
    if dark is not None:
        level = scatter_estimate(dark.frame_means[:, c])
        if not np.isclose(black.level[c], level.value, rtol=1e-9, atol=0):
            level = normal_estimate(black.level[c], black.error[c])
        if dark.rounded is not None:
            stored = float(dark.frame_means[:, c].mean())
            level_note = f"before rounding: noise below a code is stored with a mean of {stored:.4f} DN"
        out.append(Quantity("black level", "DN", name, level, black.note or level_note))
    if isinstance(line, NotMeasurable):
        out += [Quantity("system gain", "DN/e-", name, line), Quantity("inverse gain", "e-/DN", name, line)]
    else:
        inverse = Estimate(
            1 / line.slope.value, line.slope.stderr / line.slope.value**2,
            (1 / line.slope.ci90[1], 1 / max(line.slope.ci90[0], 1e-12)),
        )  # fmt: skip
        bent = bends(statistics, black.level, c, black.error[c])
        uneven = uneven_gain(statistics, c)
        odd = coarser_range(statistics, c) or bent or uneven
        note = "; ".join(filter(None, (set_aside(line), odd, spaced)))
        rounded = spaced if spaced.endswith(MOSTLY_ROUNDING) else ""
        severe = (bent if bent.endswith(NOT_LINEAR) else "") or rounded or uneven
        out.append(Quantity("system gain", "DN/e-", name, line.slope, note, _doubt(line, severe)))
        out.append(Quantity("inverse gain", "e-/DN", name, inverse))
    note = "pixels; row noise taken out" + ("" if dark is None else _left_out(dark, c))
    note = "; ".join(filter(None, (note, noise_note)))
    out.append(Quantity("temporal dark noise", "DN", name, sigma, note))
    out.append(Quantity("temporal dark noise", "e-", name, in_electrons(sigma, line)))
    if dark is not None and dark.total is not None:
        with_rows = _with_rows(sigma, dark, dark.total, step, c)
        out.append(Quantity("temporal dark noise, rows included", "DN", name, with_rows))
        out.append(Quantity("temporal dark noise, rows included", "e-", name, in_electrons(with_rows, line)))
    as_recorded = _as_recorded(sigma, dark, step, c)
    out.append(Quantity("temporal dark noise, as recorded", "DN", name, as_recorded, "quantisation included"))
    out.append(Quantity("temporal dark noise, as recorded", "e-", name, in_electrons(as_recorded, line)))
    return out


def _with_rows(
    pixels: Outcome, dark: FrameStatistics, each: Float[np.ndarray, "H W"], step: float, c: int
) -> Outcome:
    """Temporal dark noise with what rows do together, DN. pixels: that without; each: the variance of every
    pixel, rows included."""
    if isinstance(pixels, NotMeasurable):
        return pixels
    if loses_noise(dark, step, c):
        return NotMeasurable(CUT_OFF)
    values = site(each, c)
    rows_error = np.sqrt(2 / dark.row_means[1:, :, 0].size)
    if noise_below_a_code(dark, step, c) is not None:
        dof = dark.recording.count - 1.0
        total, _ = square_below_a_code(values, dof, step)
        rows = max(total - square_below_a_code(pixel_variance(dark, c), dark.dof, step)[0], 0.0)
        low, value, high = (
            float(np.sqrt(v**2 + rows)) for v in (pixels.ci90[0], pixels.value, pixels.ci90[1])
        )
        return Estimate(value, max(pixels.stderr, rows_error * rows / max(value, 1e-9) / 2), (low, high))
    total, _ = quiet_mean_square(replace(dark, variance=each, dof=dark.recording.count - 1.0), c)
    pixel, _ = quiet_mean_square(dark, c)
    count = values.size * (dark.recording.count - 1)
    value = float(np.sqrt(max(total - step**2 / 12, 0)))
    error = 0.5 * np.sqrt(2 / count) * total / max(value, 1e-9)
    error = np.hypot(error, rows_error * max(total - pixel, 0) / max(value, 1e-9) / 2)
    return normal_estimate(value, float(error))


def _as_recorded(sigma: Outcome, dark: FrameStatistics | None, step: float, c: int) -> Outcome:
    """The temporal noise of the codes of a dark, rows and quantisation included, DN: sigma_y.dark of EMVA
    1288. sigma: of the pixels without either, which tells it where there is no dark."""
    if dark is None or dark.total is None or loses_noise(dark, step, c):
        if isinstance(sigma, NotMeasurable):
            return sigma
        low, value, high = (
            float(np.hypot(v, step / np.sqrt(12))) for v in (sigma.ci90[0], sigma.value, sigma.ci90[1])
        )
        return Estimate(value, sigma.stderr, (low, high))
    values, dof = site(dark.total, c), dark.recording.count - 1.0
    if noise_below_a_code(dark, step, c) is not None:
        return root(normal_estimate(*square_below_a_code(values, dof, step)))
    total, keep = quiet_mean_square(replace(dark, variance=dark.total, dof=dof), c)
    pixel, _ = quiet_mean_square(dark, c)
    rows_error = np.sqrt(2 / dark.row_means[1:, :, 0].size) * max(total - pixel, 0.0)
    error = float(np.hypot(np.sqrt(2 / (keep.sum() * dof)) * total, rows_error))
    return root(normal_estimate(total, error))


def _left_out(dark: FrameStatistics, c: int) -> str:
    """How many noisier pixels the noise of the others is told without, where they are no few. Below half a
    code that is how near to the next one they are, not how noisy."""
    if dark.variance is None or coarse(dark):
        return ""
    share = 100 * (1 - float(quiet_pixels(dark, c).mean()))
    return f"; {share:.1f} % of pixels are far noisier and set aside" if share > _NOISIER else ""


def set_aside(line: Line) -> str:
    """How many pixels the line was drawn without, and what so many mean."""
    said = f"{100 * line.dropped:.2f} % of pixels set aside"
    if line.dropped > SET_ASIDE:
        said += ": so many are no outliers: the light moves, or the gain is not to be trusted"
    return said


def _doubt(line: Line, of_flats: str) -> str:
    """Why a gain is not to be trusted; empty where nothing says so. of_flats: what speaks against theirs."""
    reasons = (set_aside(line) if line.dropped > SET_ASIDE else "", of_flats)
    said = "; ".join(filter(None, reasons))
    return f"the gain, and with it all that is in electrons: {said}" if said else ""


def _read_noise(
    line: Line | NotMeasurable, dark: FrameStatistics | None, step: float, c: int
) -> Estimate | NotMeasurable:
    """Temporal dark noise in DN: the line's offset, or from darks alone when there is no line or when they
    are quieter than about a code."""
    quiet = None if dark is None else noise_below_a_code(dark, step, c)
    if quiet is not None:
        return quiet.read
    if isinstance(line, Line) and line.offset.ci90[0] > 0:
        return root(line.offset)
    if dark is None or dark.variance is None:
        return NotMeasurable(RECORD_DARKS)
    if hidden_in_a_code(dark, step, c):
        return NotMeasurable(BELOW_A_CODE)
    if is_cut_off(dark, c):
        return NotMeasurable(CUT_OFF)
    square, stderr = mean_square_of(dark, c)
    return root(normal_estimate(square - step**2 / 12, stderr))


def in_electrons(value: Outcome, line: Line | NotMeasurable) -> Outcome:
    """A measurement in DN as one in e-, the error of the gain in its interval."""
    if isinstance(value, NotMeasurable):
        return value
    if isinstance(line, NotMeasurable):
        return line
    gain = line.slope
    ratio = value.value / gain.value
    error = float(np.hypot(value.stderr / gain.value, ratio * gain.stderr / gain.value))
    sides = [
        np.hypot((end - value.value) / gain.value, ratio * Z90 * gain.stderr / gain.value)
        for end in value.ci90
    ]
    return Estimate(ratio, error, (max(ratio - float(sides[0]), 0.0), ratio + float(sides[1])))


def series_of(
    c: int, line: Line | NotMeasurable, statistics: Sequence[FrameStatistics]
) -> Series | NotMeasurable:
    """The darks of one channel over their exposures, in electrons."""
    darks = [s for s in statistics if s.recording.kind in DARK]
    return line if isinstance(line, NotMeasurable) else dark_series(darks, [c], [line.slope.value])


def _own_charge(
    dark: FrameStatistics | None, black: Black, line: Line | NotMeasurable, sigma: Outcome,
    series: Series | NotMeasurable,
) -> tuple[str, str]:  # fmt: skip
    """What the black level and the temporal noise of a dark are without its own dark charge; empty where that
    hardly matters, or is not known."""
    seconds = None if dark is None else black.seconds
    if not seconds or isinstance(line, NotMeasurable) or isinstance(series, NotMeasurable):
        return "", ""
    rate, _, agree, _ = dark_currents(series)
    if isinstance(sigma, NotMeasurable) or not agree or not rate.significant:
        return "", ""
    gain, charge = line.slope.value, rate.value * seconds
    square = (sigma.value / gain) ** 2
    if charge < _OWN * square:
        return "", ""
    said = f"at {seconds:g} s, {charge:.3g} e- of dark charge in it; without "
    level, read = float(np.mean(black.level)) - gain * charge, np.sqrt(max(square - charge, 0.0))
    return f"{said}{level:.2f} DN", f"{said}{read:.3g} e-"


def dark_current_quantities(
    name: str, c: int, line: Line | NotMeasurable, statistics: Sequence[FrameStatistics],
    series: Series | NotMeasurable,
) -> list[Quantity]:  # fmt: skip
    """Dark current by both ways."""
    darks = [s for s in statistics if s.recording.kind in DARK]
    names = ("dark current, by mean", "dark current, by variance")
    if isinstance(series, NotMeasurable):
        return [Quantity(title, "e-/s", name, series) for title in names]
    assert isinstance(line, Line)
    by_mean, by_variance, _, note = dark_currents(series, line.slope.stderr / line.slope.value)
    note = "; ".join(filter(None, (note, unlike_charge(darks, c))))
    return [
        Quantity(names[0], "e-/s", name, by_mean, note),
        Quantity(names[1], "e-/s", name, by_variance),
    ]


def saturation_quantities(
    name: str, c: int, line: Line | NotMeasurable, statistics: Sequence[FrameStatistics], black: PerChannel
) -> list[Quantity]:
    """The level at which codes pile up, or else pixels are full, above black."""
    full, half = full_signal(statistics, c), max([s.code_step for s in statistics], default=1.0) / 2
    seen = {s.high[c]: "codes pile up" for s in statistics if np.isfinite(s.high[c])}
    seen = dict.fromkeys(full_codes(statistics), "every pixel of flats that are left out is") | seen
    end = max(seen, default=full)
    said = seen.get(end, "the noise of the flats collapses")
    if not np.isfinite(end):
        missing = NotMeasurable("no pixel reached its end: record a flat that saturates")
        return [Quantity("saturation level", unit, name, missing) for unit in ("DN", "e-")]
    value = end - black[c]
    outcome = Estimate(value, half / np.sqrt(3), (value - half, value + half))
    return [
        Quantity("saturation level", "DN", name, outcome, f"{said} at {end:.0f} DN"),
        Quantity("saturation level", "e-", name, in_electrons(outcome, line)),
    ]


def line_noise_quantity(title: str, dark: FrameStatistics | None, axis: int) -> Quantity:
    """Temporal noise that whole rows (axis 0) or columns (axis 1) share."""
    if dark is None or dark.variance is None:
        return Quantity(title, "DN", "all", NotMeasurable(RECORD_DARKS))
    if unchanging(dark):
        return Quantity(title, "DN", "all", NotMeasurable(BELOW_A_CODE))
    wave = wave_of_rows(dark) if axis == 0 else None
    said = f"nearly all of it is one wave of {wave.frequency.value:.4g} cycles per row" if wave else ""
    return Quantity(title, "DN", "all", line_noise(dark, axis), said)
