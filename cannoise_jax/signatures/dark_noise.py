"""Noise of the darks against their exposure, beside their level: shot noise of charge whose mean was taken
away before the codes were stored.

A camera that clamps its black level to shielded pixels stores darks that do not rise, though their noise
does: then the dark current is told by the variance (EMVA 1288 release 4.0, section 7, cameras with dark
current compensation). For block b of the frame and recording r

    excess_br = variance_br / K^2 - level_br / K,

medians over pixels, so that warm pixels move neither. Without compensation it does not depend on the
exposure, however large the dark current is; with it, it grows by the hidden electrons a second. A level that
falls says that the clamp takes more than there is: it is left out, and told as the share that is taken. The
slopes of the blocks scatter by all that is random in them, which gives the standard error.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Addition, Found, Many
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import ONE_PARAMETER, Score, student_log_p
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    COVERS_NOTHING,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    Axes,
    Signature,
    unchanged,
)

_SIDE = 4
"""Blocks along each side of the frame."""
_WARMER = 3.0
"""Kelvin by which the electronics of two recordings may differ."""
_JOHNSON = 1 / 300
"""Relative change of the variance of thermal noise per kelvin."""
_FEWEST = 100
"""Pixels of a block, at least."""


def _of_blocks(field: Fields) -> tuple[np.ndarray, np.ndarray] | None:
    """Variance (DN^2) and level (DN) of every block, medians over its pixels; None where one has too few."""
    n = len(field.contrasts)
    power = np.einsum("nij,nij->ij", field.contrasts, field.contrasts) / n * (field.sigma * field.louder) ** 2
    power = power * (n / stats.chi2.median(n))
    assert field.static is not None
    level = field.mean + field.charged + field.static * field.sigma / np.float32(np.sqrt(field.frames))
    out = []
    for rows in np.array_split(np.arange(level.shape[0]), _SIDE):
        for columns in np.array_split(np.arange(level.shape[1]), _SIDE):
            at = np.ix_(rows, columns)
            kept = field.usable[at]
            if kept.sum() < _FEWEST:
                return None
            out.append((float(median(power[at][kept])), float(median(level[at][kept]))))
    variance, levels = np.array(out).T
    return variance, levels


def excess_score(fields: Many) -> Score | None:
    """Growth of the darks' variance beyond that of their level, electrons a second."""
    # Noise of less than a code is not told by a median.
    dark = [
        f
        for f in fields
        if f.kind in DARK
        and f.exposure_s is not None
        and f.static is not None
        and len(f.contrasts)
        and float(median(f.sigma)) > f.step
    ]
    t = np.array([f.exposure_s for f in dark], float)
    group = np.array([f.group for f in dark])
    groups = [group == g for g in np.unique(group)]
    if all(len(np.unique(t[g])) < 2 for g in groups):
        return None
    told = [_of_blocks(f) for f in dark]
    if any(one is None for one in told):
        return None
    gain = np.array([float(np.mean(f.gain)) for f in dark])[:, None]
    variance, level = (np.array(part) for part in zip(*told, strict=True))  # type: ignore[arg-type]
    variance, level = variance / gain**2, level / gain
    each = variance.mean(1)
    warmer = _WARMER * _JOHNSON * each
    weight = 1 / (warmer**2 + 2 * each**2 / [len(f.contrasts) * f.mean.size for f in dark])
    centred = t.copy()
    for g in groups:  # each gain setting has a read noise of its own
        centred[g] -= np.average(t[g], weights=weight[g])
    parts = weight * centred / np.sum(weight * centred**2)
    rise = float(np.einsum("r,rb->b", parts, level).mean())
    excess = variance - level if rise > 0 else variance
    rest = excess.mean(1)
    for g in groups:
        rest[g] -= np.average(rest[g], weights=weight[g])
    slopes = np.einsum("r,rb->b", parts, excess)
    rate = float(slopes.mean())
    error = float(np.sqrt(slopes.var(ddof=1) / slopes.size + np.sum((parts * warmer) ** 2)))
    freedom = len(t) - len(groups) - 1
    if freedom > 0:  # what does not grow with the exposure counts as error
        error *= np.sqrt(max(1.0, float(np.sum(weight * (rest - rate * centred) ** 2)) / freedom))
    z = rate / error
    share = 1 + max(-rise, 0.0) / max(rate, error)
    return Score(
        log_p=student_log_p(z, slopes.size - 1, 1),
        gain=0.5 * z**2 if z > 0 else 0.0,
        penalty=ONE_PARAMETER,
        amplitude=max(rate, 0.0),
        error=error,
        shift=error,
        power=1,
        parameters={
            "e_per_s": (rate, "e-/s", error),
            "share": (share, "1", share * error / max(rate, error)),
        },
        where={"axis": "frame", "recordings": [f.name for f in dark]},
    )


def beside_level(recorded: Recorded, *, name: str, rate: str, share: str) -> tuple[Signature, ...]:
    """Variance of the darks that grows with the exposure, beyond what their level says; nothing where a gain
    is not known. rate, share: the mechanism's parameters."""

    def simulate(found: Found) -> Addition:
        told = found.score.parameters
        return Addition({rate: told["e_per_s"][0], share: told["share"][0]})

    if not all(np.all(b.gain_stderr > 0) for b in recorded.baselines):
        return ()
    return (
        Signature(
            name=name,
            axes=Axes("pixel", "pixel", "redrawn", "exposure", "poisson"),
            reads=CONTRASTS | frozenset({"mean", "charged", "static"}),
            score=excess_score,
            absorb=unchanged,
            covers=COVERS_NOTHING,
            predict=NO_LAW,
            pattern=NO_PATTERN,
            simulate=simulate,
            place=NO_PLACE,
            detectable=BY_SHIFT,
            least=NO_CLOSED_FORM,
        ),
    )
