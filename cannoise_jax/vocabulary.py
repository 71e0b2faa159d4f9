"""The names of the ways in which a camera departs from Poisson-Gaussian noise. Imports nothing.

`amplitude` says what the one number quoted for a mechanism means. Rules: an additive field is its rms in
DN over all pixels and frames of a recording (also when only few pixels carry it); a sinusoid is its peak; a
multiplicative field is its rms as a fraction of the signal. Exceptions are spelled out in the entry.

`within` names the mechanisms that contain the entry as a special case: some value of *their* parameters,
bounds included, gives exactly this one. A frozen map counts as a parameter, for a calibration fits it pixel
by pixel. So:
- any static pattern proportional to the signal is a PRNU map: column_gain, green_imbalance, lens_shading,
  and dead_pixels (a response of zero);
- any static offset pattern without noise of its own is a DSNU map: row_fpn, column_fpn, channel_offset,
  amplifier_mismatch. amp_glow and hot_pixels are *not*: their charge brings its own shot noise and grows with
  the exposure, which an offset map does not;
- row_pink_noise of exponent 0 is row_noise. pink_noise is kept at exponents of at least 0.5, so it contains
  neither read_noise_error (white) nor row_noise (pink along the raster is never constant along a row);
- a wrong black level may differ per channel, so bookkeeping contains channel_offset;
- lossy_compression whose step does not grow with the signal is quantization. missing_codes neither contains
  quantization nor is contained: they agree at the period 2 only;
- flicker (a line at a row frequency) and illumination_drift (one factor per frame) do not contain each other,
  and banding (additive) contains neither; heavy_tails, rts and pixel_read_noise_map share a marginal
  distribution but not their behaviour in time, so none contains another;
- reference_error allows for a shift of the reference, so it contains misregistration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Class = Literal["sensor", "capture", "bookkeeping", "unknown"]
CLASSES: tuple[Class, ...] = ("sensor", "capture", "bookkeeping", "unknown")


@dataclass(frozen=True)
class Term:
    """One name: what it means, and the meaning and unit of its amplitude.

    entry: number of the effect in the catalogue of noise mechanisms; None: not in it.
    core: whether the mechanism carries the full contract (closed form, estimator, likelihood).
    unit: of the amplitude; "1" for a dimensionless number.
    within: ids that contain this one as a special case.
    """

    id: str
    definition: str
    entry: int | None
    kind: Class
    core: bool
    unit: str
    amplitude: str
    within: tuple[str, ...] = ()


_FRACTION = "rms fraction of the signal"
_RMS = "rms, DN"

_TERMS = (
    # Sensor, core.
    Term("gain_error", "The system gain differs from the one assumed, so shot noise has another slope.", 1,
         "sensor", True, "1", "relative error of the gain: true over assumed, minus one"),
    Term("read_noise_error", "The white read noise differs from the one assumed.", 39,
         "sensor", True, "1", "relative error of the read noise: true over assumed, minus one"),
    Term("prnu", "Photo-response non-uniformity: every pixel has its own fixed sensitivity.", 5,
         "sensor", True, "1", _FRACTION),
    Term("dsnu", "Dark-signal non-uniformity: every pixel has its own fixed offset.", 20,
         "sensor", True, "DN", _RMS),
    Term("column_gain", "Every column has its own fixed gain.", 6,
         "sensor", True, "1", _FRACTION, ("prnu",)),
    Term("nonlinearity", "The response bends: the mean signal is not proportional to the light.", 8,
         "sensor", True, "1", "fraction of the signal lost at the white level"),
    Term("saturation", "Pixels hold no more charge than their full well.", 9,
         "sensor", True, "1", "full well in normalised units: the clean signal at which the pixel is full"),
    Term("black_clipping", "Values below a level near black are cut off.", 10,
         "sensor", True, "DN", "clipping level above (positive) or below the black level, DN"),
    Term("crosstalk", "Charge or signal leaks into the neighbouring pixels of the mosaic after collection.",
         13, "sensor", True, "1", "total fraction of charge given away"),
    Term("dark_current", "Thermal charge grows with the exposure and brings its own shot noise.", 19,
         "sensor", True, "e-/s", "mean dark current, e-/s"),
    Term("amp_glow", "Light of the readout electronics adds charge near an edge or corner.", 21,
         "sensor", True, "DN", _RMS),
    Term("hot_pixels", "A few pixels have a dark current far above the others, at fixed places.", 22,
         "sensor", True, "DN", _RMS),
    Term("heavy_tails", "Read noise has heavier tails than a Gaussian, in every pixel alike.", 26,
         "sensor", True, "1", "excess kurtosis of the read noise"),
    Term("pixel_read_noise_map", "Every pixel has its own fixed read noise.", 27,
         "sensor", True, "1", "rms relative spread of the read noise over the pixels"),
    Term("rts", "Random telegraph signal: a few pixels jump between two levels.", 28,
         "sensor", True, "DN", _RMS),
    Term("row_noise", "One random offset per row, white from row to row, redrawn in every frame.", 29,
         "sensor", True, "DN", _RMS, ("row_pink_noise",)),
    Term("column_noise", "One random offset per column, white, redrawn in every frame.", 30,
         "sensor", True, "DN", _RMS),
    Term("row_fpn", "One fixed offset per row.", 37, "sensor", True, "DN", _RMS, ("dsnu",)),
    Term("column_fpn", "One fixed offset per column.", 37, "sensor", True, "DN", _RMS, ("dsnu",)),
    Term("pink_noise", "1/f noise along the raster scan.", 32, "sensor", True, "DN", _RMS),
    Term("row_pink_noise", "An offset constant along each row and 1/f from row to row, redrawn per frame.",
         31, "sensor", True, "DN", _RMS),
    Term("banding", "A sinusoid of fixed frequency in the raster scan: interference pick-up.", 33,
         "sensor", True, "DN", "peak, DN"),
    Term("offset_drift", "The black level moves from frame to frame.", 35, "sensor", True, "DN", _RMS),
    Term("channel_offset", "Each colour channel has its own black-level error.", 36,
         "sensor", True, "DN", _RMS, ("dsnu", "bookkeeping")),
    Term("amplifier_mismatch", "Regions read by different amplifiers differ by a step in offset.", 38,
         "sensor", True, "DN", "step between adjoining regions, DN", ("dsnu",)),
    Term("green_imbalance", "The two green channels differ in sensitivity.", 49,
         "sensor", True, "1",
         "rms fraction of the signal over the green pixels: half of the relative difference", ("prnu",)),
    Term("quantization", "Codes are spaced more widely than assumed.", 41,
         "sensor", True, "DN", "spacing of the codes, DN", ("lossy_compression",)),
    Term("missing_codes", "Some codes never occur: digital scaling or converter faults.", 42,
         "sensor", True, "code steps", "period: one code in every so many is missing"),
    Term("in_camera_denoising", "The camera has averaged each pixel with its neighbours of the same colour.",
         45, "sensor", True, "1", "blend weight of the neighbours' mean"),
    # Sensor, others.
    Term("poisson_skew", "Shot noise is Poisson, with its skewness, where a Gaussian was assumed.", 2,
         "sensor", False, "1", "strength: 0 Gaussian, 1 Poisson"),
    Term("excess_noise", "Random gain of an electron multiplier raises the shot noise.", 3,
         "sensor", False, "1", "excess noise factor F^2, minus one"),
    Term("clock_induced_charge", "Spurious charge of the clocking, the same in every exposure time.", 4,
         "sensor", False, "e-", "mean charge per pixel and frame, e-"),
    Term("dual_gain", "The conversion gain switches at an ISO or at a signal level.", 7,
         "sensor", False, "1", "relative step of the gain at the switch"),
    Term("brighter_fatter", "Collected charge repels further charge: shot noise correlates.", 12,
         "sensor", False, "1/e-", "minus a00: relative loss of shot-noise variance per electron"),
    Term("lens_shading", "Sensitivity falls smoothly towards the corners.", 15,
         "sensor", False, "1", "fraction of the signal lost in the corners", ("prnu",)),
    Term("dead_pixels", "A few pixels do not respond to light.", 23,
         "sensor", False, "1", "fraction of the pixels", ("prnu",)),
    Term("cosmic_rays", "Single bright tracks that do not repeat.", 24,
         "sensor", False, "1/(Mpx s)", "events per megapixel and second"),
    Term("temperature_drift", "The temperature, and with it the dark current, moves from frame to frame.", 25,
         "sensor", False, "K", "rms temperature change, K"),
    Term("image_lag", "A frame keeps part of the charge of the frame before it.", 14,
         "sensor", False, "1", "fraction of the charge left behind"),
    Term("smear", "Bright pixels leak into their whole column.", 11,
         "sensor", False, "1", "added signal as a fraction of the column's mean signal"),
    Term("lossy_compression", "Raw codes are rounded to a step that grows with the signal.", 44,
         "sensor", False, "DN", "code spacing at the white level, DN"),
    Term("defect_correction", "Listed pixels are replaced by the mean of their neighbours.", 47,
         "sensor", False, "1", "fraction of the pixels"),
    Term("hot_pixel_suppression", "Pixels above all their neighbours of the same colour are clamped to them.",
         46, "sensor", False, "1", "blend weight of the clamped value"),
    Term("demosaicing", "The mosaic has been interpolated from a coarser or another mosaic.", 48,
         "sensor", False, "1", "blend weight of the interpolated value"),
    # Capture.
    Term("flicker", "Mains-driven light read by a rolling shutter: rows brighten and darken in turn.", 16,
         "capture", True, "1", "peak, as a fraction of the signal"),
    # The catalogue has a lamp that drifts as what others are confused with; a frame and its reference that
    # differ by a factor are its nearest entry.
    Term("illumination_drift", "The brightness of the light moves from frame to frame.", 18,
         "capture", True, "1", _FRACTION),
    Term("reference_error", "The reference image is not the true mean: noisy, blurred, shifted or scaled.",
         17, "capture", True, "DN", "rms difference between the reference and the true mean, DN"),
    Term("misregistration", "The reference is shifted against the frames.", 17,
         "capture", False, "px", "length of the shift, px", ("reference_error",)),
    Term("scene_motion", "The scene moves between frames.", 17,
         "capture", False, "px", "motion per frame, px"),
    # Bookkeeping, and what has no name.
    Term("bookkeeping", "Wrong black level, white level, colour pattern or units in the description.", 50,
         "bookkeeping", True, "DN", "rms error of the description, DN"),
    Term("unknown", "A structure that no named mechanism explains.", None,
         "unknown", False, "1", "explained share of the held-out gain"),
)  # fmt: skip

VOCABULARY: dict[str, Term] = {term.id: term for term in _TERMS}


def of_kind(kind: Class, *, core: bool | None = None) -> tuple[str, ...]:
    """Ids of one class, in the vocabulary's order; only the core ones, or only the others, if asked."""
    return tuple(t.id for t in _TERMS if t.kind == kind and core in (None, t.core))


def core_ids() -> tuple[str, ...]:
    """Ids that carry the full contract."""
    return tuple(t.id for t in _TERMS if t.core)


def contains(general: str, special: str) -> bool:
    """Whether `general` is `special` or contains it as a special case, in any number of steps."""
    return general == special or any(contains(general, outer) for outer in VOCABULARY[special].within)
