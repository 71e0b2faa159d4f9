"""Whether loud pixels were clamped to those about them before frames were stored.

Of independent noise one pixel in nine is above its eight neighbours, and one in nine below, whatever its law,
as long as its sides are alike and codes are fine. A camera that takes what stands out for hot pixels, or a
program that does, leaves hardly any.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.frames import FrameStatistics

_FRAMES, _SIDE = 4, 1024
"""Of a flat, the frames and the side of the middle, pixels, that are looked at: millions tell it as well."""
_FEWER = 0.5
"""Of the share of pixels on one side of all about them, that on the other up to which these were clamped:
Poisson noise of five electrons has 0.98."""
_BROAD, _NEITHER = 3.0, 0.03
"""Noise, codes, from which on few pixels are as high as their neighbours, and the share up to which both
sides were clamped: of noise that a Gaussian of one pixel smoothed 0.033 are left."""
_LEAST_PIXELS = 100
"""On the fuller side, from which on chance is no matter."""


def clamped(s: FrameStatistics | None) -> str:
    """That pixels of a flat are above or below all about them more rarely than those of raw frames; empty
    where they are not, or no flat tells."""
    if s is None or s.variance is None:
        return ""
    step = 1 if s.recording.cfa == "MONO" else 2
    height, width = s.recording.size
    rows, columns = (slice(m := max((n - _SIDE) // 4 * 2, 0), m + _SIDE) for n in (height, width))
    usable = ~s.clipped[rows, columns]
    about = np.zeros((2 * step + 1, 2 * step + 1), bool)
    about[::step, ::step] = True
    about[step, step] = False
    above = below = 0
    for frame in np.asarray(s.recording.frames[:_FRAMES, rows, columns]):
        above += int(np.sum((frame > ndimage.maximum_filter(frame, footprint=about)) & usable))
        below += int(np.sum((frame < ndimage.minimum_filter(frame, footprint=about)) & usable))
    pixels = int(usable.sum()) * min(_FRAMES, s.recording.count)
    noise = float(np.sqrt(median(s.variance)))
    # Where the light changes by more than the noise from pixel to pixel neither side shows.
    slopes = (np.abs(s.mean[:, step:] - s.mean[:, :-step]), np.abs(s.mean[step:] - s.mean[:-step]))
    broad = noise > max(_BROAD * s.code_step, *(float(median(slope)) for slope in slopes))
    one_side = min(above, below) < _FEWER * max(above, below) and max(above, below) > _LEAST_PIXELS
    neither = broad and above + below < 2 * _NEITHER * pixels and pixels > 10 * _LEAST_PIXELS
    if not one_side and not neither:
        return ""
    what = "loud pixels were" if above < below else "dark pixels were"
    what = "loud and dark pixels were" if neither else what
    return (
        f"{100 * above / pixels:.2g} % of the pixels of a flat are above all eight of their colour about "
        f"them, and {100 * below / pixels:.2g} % below, of raw frames 11 %: {what} clamped to those about "
        "them"
    )
