"""What a name of the vocabulary says: how a camera departs from Poisson-Gaussian noise. Imports nothing; the
names themselves stand with their mechanisms, and `mechanisms.VOCABULARY` holds them all.

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
    unit: of the amplitude; "1" for a dimensionless number.
    within: ids that contain this one as a special case.
    listed: its place in lists, by numbers that leave room between them: one more changes no other.
    says_exposure: whether the definition says what the exposure does to it, which the sentence of a
      finding says otherwise.
    Raises ValueError for a class that there is not.
    """

    id: str
    definition: str
    entry: int | None
    kind: Class
    unit: str
    amplitude: str
    within: tuple[str, ...] = ()
    listed: int = 10000
    says_exposure: bool = False

    def __post_init__(self):
        if self.kind not in CLASSES:
            raise ValueError(f"{self.id}: class {self.kind!r}: one of {', '.join(CLASSES)}")


FRACTION = "rms fraction of the signal"
RMS = "rms, DN"

UNKNOWN = Term(
    "unknown", "A structure that no named mechanism explains.", None,
    "unknown", "1", "explained share of the held-out gain",
)  # fmt: skip
