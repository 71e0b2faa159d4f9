"""Noise of the gain itself: the excess noise of an electron multiplier.

It raises variance and third cumulant of the shot noise by E x^2 and E x^3 of its gain x. A gain read off the
variance takes the one for the other, but the third cumulant is then (2 F^2 - 1) / F^2 times that of Poisson
noise of that gain (gamma law), at every signal. No other source of the gain is needed while the skewness
shows: up to some thousand electrons."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.fields import Fields, each_frame
from cannoise_jax.signatures.memory import cleaned
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.remembered import remembered
from cannoise_jax.signatures.score import Score, normal_log_p
from cannoise_jax.signatures.signature import CONTRASTS, Axes, Signature, unchanged

_FAR = 7.0
"""Standard deviations from which on a value is no noise."""
_EXCESS = 4.0
"""Nats of the relative skewness, from 0 to 0.75 by the gamma law, at its least error of 0.01: an Occam factor
log(0.75 / (2.5 x 0.01)) = 3.4. Flats of hundreds of electrons and more, 96 x 128 pixels, know it to 0.27."""


def _too_few(field: Fields) -> bool:
    return field.frames < 3 or bool(median(field.sigma) < 0.65 * field.step)


def _left(field: Fields) -> float:
    """What the mean of the frames leaves of the third moment; the residuals have unit variance again."""
    return (1 - 2 / field.frames) * (1 - 1 / field.frames) ** -0.5


def _third(field: Fields, contrasts: np.ndarray, far: float) -> Float[np.ndarray, "h w"]:
    """Sum over the frames of the third powers of the residuals, those beyond `far` left out."""
    total = np.zeros(field.mean.shape)
    for z in each_frame(field._replace(contrasts=contrasts, before=0), static=False):
        z = np.where(np.abs(z) < far, z, 0).astype(np.float64)
        total += z * z * z
    return total


def _of_darks(darks: tuple[Fields, ...], lit: Fields) -> tuple[float, float]:
    """Third cumulant of the noise of the darks of a lit recording's gain setting and pixels, DN^3, values
    left out as they are there, and its standard error; 0 without darks."""
    values, weights, far = [], [], _FAR * float(median(lit.sigma))
    for f in darks:
        kept = f.usable & lit.usable
        if f.group != lit.group or _too_few(f) or not kept.any():
            continue
        # As they are: what stands out would be in the scale of the noise.
        cubes = _third(f, f.contrasts[: f.frames - 1], far / float(median(f.sigma)))
        third = (cubes * f.sigma.astype(np.float64) ** 3)[kept] / (f.frames * _left(f))
        values.append(float(third.mean()))
        weights.append(third.size / max(float(third.var()), 1e-30))
    if not values:
        return 0.0, 0.0
    return float(np.average(values, weights=weights)), float(np.sum(weights) ** -0.5)


def excess_score(
    fields: tuple[Fields, ...], *, of_darks: Callable[[Fields], tuple[float, float]]
) -> Score | None:
    """Third moment of the temporal noise beyond that of Poisson noise of the fitted gain, at every signal,
    and beyond that of the darks, which no light made. Amplitude: F^2 - 1. Of 300 draws of a flat of 40
    electrons, six frames, without it p is below 0.1 in 4 %, 0.05 in 2 %, 0.01 in 0.3 %.

    of_darks: of a lit recording the third cumulant that its darks have, with all that light hides."""
    halves = np.zeros((2, 3))
    for f in fields:
        if not f.lit or _too_few(f):
            continue
        base = (float(np.mean(f.gain)) * f.shot / f.sigma).astype(np.float64) * _left(f)
        bright = base < 0.12
        also, doubt = (k * _left(f) / f.sigma.astype(np.float64) ** 3 for k in of_darks(f))
        off = _third(f, cleaned(f), _FAR) - f.frames * (base + also)
        kept = f.usable & (base > 0.004)
        for n, part in enumerate((kept & bright, kept & ~bright)):
            w = base * part
            halves[n] += [
                float(np.sum(w * off)),
                float(np.sum(w * base)) * f.frames,
                float(np.sum((w * off) ** 2)) + float(np.sum(w * doubt) * f.frames) ** 2,
            ]
    u, i, v = halves.sum(0)
    if i <= 0:
        return None
    relative, error = u / i, float(np.sqrt(v + (0.01 * i) ** 2) / i)
    z = relative / error
    parts = [(a / b, np.sqrt(c) / b) for a, b, c in halves if b > 1e-3 * i]
    apart = len(parts) == 2 and abs(parts[0][0] - parts[1][0]) > 4 * np.hypot(parts[0][1], parts[1][1]) + 0.1
    # The gamma law adds at most as much again; twice the variance half of it.
    ruled_out = relative - 3 * error > 0.75 or apart
    excess = 1 / max(1 - min(max(relative, 0.0), 0.75), 0.25) - 1
    spread = error * (1 + excess) ** 2
    return Score(
        log_p=0.0 if ruled_out else normal_log_p(z, 1),
        gain=0.0 if ruled_out else 0.5 * max(z, 0.0) ** 2,
        penalty=_EXCESS,
        amplitude=excess,
        error=spread,
        shift=error,
        power=1,
        parameters={"relative_skewness": (relative, "1", error)},
        where={"axis": "signal", "range": [0.0, 1.0]},
    )


def skewed(
    recorded: Recorded, *, name: str, covers: tuple[str, ...], lifted_by: tuple[str, ...]
) -> Signature:
    """Shot noise more skewed than its variance says: that of a random gain."""
    # The darks stay as they were recorded: every pass of a search asks for the same.
    of_darks = remembered("usable", "sigma")(partial(_of_darks, recorded.unlit))
    return plain(
        name=name,
        axes=Axes("pixel", "pixel", "redrawn", "signal", "skewed"),
        reads=CONTRASTS | {"shot", "signal"},
        score=partial(excess_score, of_darks=of_darks),
        absorb=unchanged,
        simulate=carried(lambda s: {"excess": s.amplitude}),
        covers=covers,
        lifted_by=lifted_by,
        of_gain=True,
    )
