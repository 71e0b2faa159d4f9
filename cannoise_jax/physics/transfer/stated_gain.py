"""The gain that files state against the gain that photon transfer measures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from cannoise_jax.recordings.recording import Recording

_SIGMAS = 3.0
"""Standard errors of a disagreement: by chance once in 370 settings."""

_FAR = 2.0
"""Factor between the two from which on one of them is of something else."""


def gain_note(recordings: Iterable[Recording], gains: Sequence[float], errors: Sequence[float]) -> str | None:
    """One line where the recordings of one setting state e-/DN (EGAIN of FITS): that the measured gain
    agrees with it, or that it does not by three standard errors and the rounding of what is stated.

    gains, errors: of the channels, DN/e-; each is a measurement of its own, so their scatter is an error
    as well. None where no gain is stated or measured.
    """
    stated = sorted({r.egain for r in recordings if r.egain is not None})
    if not stated or not gains:
        return None
    if len(stated) > 1:
        return f"the files state several gains, {', '.join(f'{e:g}' for e in stated)} e-/DN, at one setting"
    values = 1 / np.asarray(gains, np.float64)
    sigmas = np.maximum(np.asarray(errors, np.float64), 1e-12) * values**2
    weights = 1 / sigmas**2
    mean = float(np.sum(weights * values) / weights.sum())
    scatter = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0
    error = max(float(weights.sum() ** -0.5), scatter)
    text = f"the files state a gain of {stated[0]:g} e-/DN, photon transfer finds {mean:.3g} ± {error:.2g}"
    if abs(mean - stated[0]) <= _SIGMAS * error + _rounding(stated[0]):
        return f"{text}: they agree"
    return f"{text}: they disagree beyond the error ({100 * (mean / stated[0] - 1):+.1f} %)"


def far_from_stated(recordings: Iterable[Recording], gains: Sequence[float]) -> str:
    """That the measured gain is another than the stated one by a factor of two or more, as no error of
    either makes it; empty where it is not, or none is stated."""
    stated = {r.egain for r in recordings if r.egain is not None}
    if len(stated) != 1 or not gains:
        return ""
    (said,) = stated
    found = float(np.mean(1 / np.asarray(gains, np.float64)))
    factor = max(found / said, said / found)
    if factor < _FAR:
        return ""
    return (
        f"the files state a gain of {said:g} e-/DN, photon transfer finds {found:.3g}, a factor of "
        f"{factor:.3g}: the stated gain is of another setting or of codes of another scale, or the frames "
        "are averaged, added or smoothed"
    )


def _rounding(value: float) -> float:
    """Half a unit of the last decimal that is stated: 2.0 and 2 are one number, and taken for 2.0."""
    _, _, decimals = f"{value!r}".partition(".")
    return 0.5 * 10.0 ** -(1 if "e" in decimals else len(decimals))
