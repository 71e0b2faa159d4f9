"""A scene that moves while its frames are taken.

To first order a frame that is shifted by d differs from the mean by d times the slope of the scene, along the
rows and along the columns: two numbers a frame, in the contrasts, where a reference that is shifted against
all frames cancels. Light that grows or fades is taken out first.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from cannoise_jax.signatures.fields import Fields, helmert
from cannoise_jax.signatures.plain import plain
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import Score, chi2_log_sf, normal_log_p, sidak
from cannoise_jax.signatures.signature import CONTRASTS, COVERS_NOTHING, Axes, Signature


def _slopes(f: Fields) -> np.ndarray:
    """Change of the mean by a shift of one pixel down and right, in standard deviations `[2, h, w]`; pixels
    two apart are of one colour."""
    source = f.mean.astype(np.float64)
    p = np.pad(source, 2, mode="reflect")
    h, w = source.shape
    down = (p[4:, 2 : 2 + w] - p[:h, 2 : 2 + w]) / 4
    right = (p[2 : 2 + h, 4:] - p[2 : 2 + h, :w]) / 4
    out = np.stack([down, right]) * f.weight
    basis = np.stack([f.weight.astype(np.float64), f.relative.astype(np.float64)])
    normal = np.einsum("kij,lij->kl", basis, basis)
    part = np.linalg.lstsq(normal, np.einsum("kij,nij->kn", basis, out), rcond=None)[0]
    return out - np.einsum("kn,kij->nij", part, basis)


def shifts(f: Fields) -> tuple[np.ndarray, np.ndarray] | None:
    """Shift of every contrast `[n, 2]`, px, and its information matrix `[2, 2]`."""
    if f.kind != "scene" or f.frames < 3 or len(f.contrasts) < f.frames - 1:
        return None
    t = _slopes(f)
    c = f.contrasts[: f.frames - 1].astype(np.float64)
    normal = np.einsum("kij,lij->kl", t, t)
    if np.linalg.eigvalsh(normal)[0] <= 0:
        return None
    return np.einsum("nij,kij->nk", c, t) @ np.linalg.inv(normal), normal


_TWO_WAYS = 6.0
"""Nats of a motion down and across, 3.0 each: 0.5 log(n) of n = 400 values. By its Occam factor the cost
would be 6.6 each, of a range of 2 px and errors of 0.0011 px (measured, scenes of 96 x 128 pixels)."""


def motion_score(fields: tuple[Fields, ...], *, times: dict[int, list[int]]) -> Score | None:
    """Slopes of the scene in the contrasts between frames. Amplitude: steady motion, px per frame, or the rms
    of one that is not steady."""
    chi2, dof, steady_z, speeds, errors, rms = 0.0, 0, 0.0, [], [], []
    for f in fields:
        found = shifts(f)
        if found is None:
            continue
        beta, normal = found
        power = np.einsum("nk,kl,nl->n", beta, normal, beta)
        chi2 += float(np.sum(power))
        dof += 2 * len(beta)
        order = times.get(f.number, [])[: f.frames]
        at = np.array(order if len(order) == f.frames else range(f.frames), float)
        course = helmert(f.frames) @ at
        velocity = course @ beta / float(course @ course)
        information = normal * float(course @ course)
        steady_z += float(velocity @ information @ velocity)
        speeds.append(float(np.hypot(*velocity)))
        errors.append(float(np.sqrt(np.trace(np.linalg.inv(information)) / 2)))
        rms.append(float(np.sqrt(np.mean(beta**2))))
    if not dof:
        return None
    even = chi2_log_sf(steady_z, 2 * len(speeds))
    log_p = sidak(min(chi2_log_sf(chi2, dof), even), 2)
    gain = 0.5 * max(chi2 - dof, steady_z - 2 * len(speeds), 0.0)
    best = float(np.max(speeds)) if even < normal_log_p(2.0) else float(np.max(rms))
    error = float(np.min(errors))
    return Score(
        log_p=log_p,
        gain=gain,
        penalty=_TWO_WAYS,
        amplitude=best,
        error=error,
        shift=error,
        power=1,
        parameters={"shift": (best, "px", error)},
        where={"axis": "edge", "edge": "motion"},
    )


def without_motion(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Scenes without the slopes in their contrasts; what stays is that of a mean of moving frames."""
    out = []
    for f in fields:
        found = shifts(f)
        if found is None:
            out.append(f)
            continue
        inner = f.contrasts[: f.frames - 1] - np.einsum("nk,kij->nij", found[0], _slopes(f))
        contrasts = np.concatenate([inner, f.contrasts[f.frames - 1 :]]).astype(np.float32)
        out.append(f._replace(contrasts=contrasts, static=None))
    return tuple(out)


def moving(recorded: Recorded, *, name: str, lifted_by: tuple[str, ...]) -> Signature:
    """Edges that move from frame to frame; the scene's, not the camera's."""
    return plain(
        name=name,
        axes=Axes("photons", "edge", "redrawn", "signal", "shift"),
        reads=CONTRASTS | {"mean", "signal"},
        score=partial(motion_score, times=recorded.times),
        absorb=without_motion,
        covers=COVERS_NOTHING,
        lifted_by=lifted_by,
    )
