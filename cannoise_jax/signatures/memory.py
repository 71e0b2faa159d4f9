"""What a frame keeps of the frame before it.

Charge left behind carries the shot noise of the frame before: noise of successive frames correlates by
f (1 - f) / (f^2 + (1 - f)^2) times the share of shot noise, and that of frames two apart does not. Noise of
the readout that lasts (1/f noise of pixels, telegraph signals) correlates darks as well, and scenes or lamps
that move correlate frames at every distance: both are fitted beside it.

The sum of products of successive frames, their mean taken out, is a quadratic form of the contrasts whose
trace is made zero: its mean is zero whatever the scale of the noise.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.signatures.fields import Fields, helmert
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import Score, normal_log_p
from cannoise_jax.signatures.signature import CONTRASTS, Axes, Signature

_LAGS = (1, 2, 3)
"""Frames apart: a charge that stays behind by half is down to an eighth at three."""


def _forms(times: list[int]) -> dict[int, Float[np.ndarray, "n n"]]:
    """Matrix of each distance between frames in the space of contrasts: half of every pair, no trace."""
    contrast = helmert(len(times))
    apart = np.abs(np.subtract.outer(times, times))
    out = {}
    for lag in _LAGS:
        form = contrast @ ((apart == lag) / 2) @ contrast.T
        out[lag] = form - np.trace(form) / len(form) * np.eye(len(form))
    return out


def cleaned(field: Fields) -> np.ndarray:
    """Contrasts between the frames, of unit variance, without what rows, columns and whole frames share and
    without drift of the light."""
    c = field.contrasts[: field.frames - 1]
    c = c - c.mean(2, keepdims=True)
    c = c - c.mean(1, keepdims=True)
    c = without_light(field, c) if field.lit else c
    # What was taken out may have been in the scale of the noise.
    middle = c[:, field.usable]
    return c / max(float(np.sqrt(np.mean(np.minimum(middle**2, 25.0)))), 1e-3) if middle.size else c


def without_light(field: Fields, c: np.ndarray) -> np.ndarray:
    """Contrasts without their part in proportion to the signal: the light of whole frames."""
    root = field.relative - field.relative.mean(1, keepdims=True)
    root = root - root.mean(0, keepdims=True)
    power = float(np.sum(root**2))
    if power <= 1e-3 * float(np.sum(field.relative**2)):
        return c
    return c - np.einsum("nij,ij->n", c, root)[:, None, None] / power * root


def _sums(field: Fields, times: list[int]) -> tuple[np.ndarray, np.ndarray] | None:
    """For each distance the sum over the pixels of their form, with weight one and with the share of shot
    noise, `[lag, 2]`, and the matrix that maps correlation of the read noise and of the shot noise at these
    distances to them, with its last two axes the null covariance: `[lag, 2, 2]`."""
    if field.frames < 3 or len(times) != field.frames:
        return None
    forms = _forms(times)
    c = cleaned(field)
    power = np.einsum("nij,nij->ij", c, c)
    kept = field.usable & (power < stats.chi2.isf(1e-4, len(c)))
    if kept.mean() < 0.2:
        return None
    shot = np.clip(field.shot, 0, 1).astype(np.float64)
    weights = np.stack([(1 - shot) * kept, shot * kept])
    u, i = np.zeros((len(_LAGS), 2)), np.zeros((len(_LAGS), 2, 2))
    for k, lag in enumerate(_LAGS):
        form = forms[lag]
        moved = c.transpose(1, 2, 0) @ form.astype(np.float32)
        value = np.einsum("ijn,nij->ij", moved, c)
        unit = 2 * float(np.trace(form @ form))
        u[k] = [float(np.sum(w * value)) for w in weights]
        i[k] = unit * np.array([[float(np.sum(a * b)) for b in weights] for a in weights])
    return u, i


def lag_score(fields: tuple[Fields, ...], *, times: dict[int, list[int]]) -> Score | None:
    """Correlation of the shot noise of successive frames beyond that of the read noise. Amplitude: share of
    the charge left behind. times: the frames of every recording, in the order they were taken."""
    u, i = np.zeros((len(_LAGS), 2)), np.zeros((len(_LAGS), 2, 2))
    chosen = 0
    for f in fields:
        sums = _sums(f, times.get(f.number, [])[: f.frames])
        if sums is None:
            continue
        u, i = u + sums[0], i + sums[1]
        chosen += f.lit
    if not chosen or not i[0, 1, 1] > 0:
        return None
    values, errors = np.zeros(len(_LAGS)), np.full(len(_LAGS), np.inf)
    for k in range(len(_LAGS)):
        if i[k, 1, 1] <= 0:
            continue
        matrix = i[k] + np.diag([1e-9 * i[k, 1, 1]] * 2)
        covariance = np.linalg.inv(matrix)
        values[k] = float((covariance @ u[k])[1])
        errors[k] = float(np.sqrt(covariance[1, 1]))
    z = values[0] / errors[0]
    later = [n for n in (1, 2) if np.isfinite(errors[n])]
    beyond = max((values[n] - 2 * errors[n] for n in later), default=0.0)
    # What lasts longer than a frame is no charge left behind: motion, light that drifts by place.
    lasts = beyond > 0.5 * values[0]
    fraction = _fraction(values[0])
    return Score(
        log_p=0.0 if lasts else normal_log_p(z, 1),
        gain=0.0 if lasts else 0.5 * max(z, 0.0) ** 2,
        penalty=0.5 * float(np.log(max(i[0, 1, 1], 2.0))),
        amplitude=fraction,
        error=float(errors[0]),
        shift=float(errors[0]),
        power=1,
        parameters={"fraction": (fraction, "1", float(errors[0]))},
        where={"axis": "frame", "correlation": float(values[0])},
    )


def _fraction(correlation: float) -> float:
    """Share left behind that gives this correlation of shot noise."""
    if correlation <= 0:
        return 0.0
    grid = np.linspace(0, 0.5, 501)
    return float(np.interp(correlation, grid * (1 - grid) / (grid**2 + (1 - grid) ** 2), grid))


def in_order(fields: tuple[Fields, ...], score: Score, *, times: dict[int, list[int]]) -> tuple[Fields, ...]:
    """Fields whose contrasts are whitened over successive frames, and in whose mean frames that remember each
    other count for fewer. The first frame, which remembers others than these, tells nothing of the light."""
    out = []
    for f in fields:
        order = times.get(f.number, [])[: f.frames]
        if f.frames < 3 or len(order) != f.frames:
            out.append(f)
            continue
        contrast = helmert(f.frames)
        successive = np.abs(np.subtract.outer(order, order)) == 1
        rho = score.where["correlation"] * float(np.mean(f.shot[f.usable])) if f.usable.any() else 0.0
        law = contrast @ (np.eye(f.frames) + rho * successive) @ contrast.T
        values, vectors = np.linalg.eigh(law)
        # The noise of the contrasts is what it was: of frames that are alike more than they show of it.
        alone = len(law) / np.trace(law)
        root = (vectors / np.sqrt(alone * np.maximum(values, 0.05))) @ vectors.T
        inner = np.einsum("mn,nij->mij", root, f.contrasts[: f.frames - 1]).astype(np.float32)
        last = f.contrasts[f.frames - 1 :]
        if f.lit:  # either these frames or those before hold the first
            inner = _without_light_of(f, inner, root @ contrast[:, order.index(0)]) if 0 in order else inner
            last = _without_light_of(f, last, np.ones(len(last)))
        contrasts = np.concatenate([inner, last])
        # Noise of a mean of such frames, which sigma stands for; contrasts keep their unit.
        more = np.float32(np.sqrt(alone * (1 + rho * successive.sum() / f.frames)))
        static = None if f.static is None else f.static / more
        out.append(
            f._replace(
                contrasts=contrasts, static=static, sigma=f.sigma * more, louder=f.louder / float(more)
            )
        )
    return tuple(out)


def _without_light_of(field: Fields, c: np.ndarray, of: Float[np.ndarray, "n"]) -> np.ndarray:
    """Contrasts without that part of what is in proportion to the signal which is of one frame. of: what that
    adds to each."""
    power = float(np.sum(field.relative**2))
    along = of / max(float(np.linalg.norm(of)), 1e-12)
    share = float(along @ np.einsum("nij,ij->n", c, field.relative)) / max(power, 1e-12)
    return (c - (share * along)[:, None, None] * field.relative).astype(np.float32)


def lag(recorded: Recorded, *, name: str, before: tuple[str, ...], lifted_by: tuple[str, ...]) -> Signature:
    """What a frame keeps of the frame before it. before: signatures of what stays, whose noise it changes."""
    return plain(
        name=name,
        axes=Axes("pixel", "pixel", "redrawn", "signal", "lag in time"),
        reads=CONTRASTS | {"shot", "signal"},
        score=partial(lag_score, times=recorded.times),
        absorb=partial(in_order, times=recorded.times),
        simulate=carried(lambda s: {"fraction": s.amplitude}),
        covers=(),
        before=lambda score: before,
        lifted_by=lifted_by,
    )
