"""Light of a column that is read with every pixel of it.

While rows are shifted out light still falls on them: each pixel of a column gains a share of the column's
mean. The template is known from the scene, so that it can be told from columns with offsets or gains of their
own, which do not follow the scene: the scatter of the columns about the template is what it is judged by.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from cannoise_jax.signatures.fields import Fields, channel_index, stays_dn
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.score import ONE_PARAMETER, Score, student_log_p
from cannoise_jax.signatures.signature import COVERS_NOTHING, NOT_SIMULATED, STATIC, Axes, Signature


def _columns(f: Fields, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of every column of every channel: residual, DN, what the scene puts there, and their weight. What a
    channel's fitted offset and factor take of it is taken out of all."""
    assert f.static is not None
    weight = f.weight.astype(np.float64) ** 2 * f.frames
    residual = stays_dn(f)
    values, templates, weights = [], [], []
    channel = channel_index(f.mean.shape)
    for c in range(4):
        w = np.where(channel == c, weight, 0.0)
        if not w.any():
            continue
        each = w.sum(axis)
        used = each > 0
        signal = f.signal.astype(np.float64)
        # Rows of every colour pass: it is the mean of the whole column.
        load = np.where(channel == c, signal.mean(axis, keepdims=True), 0.0)
        basis = np.stack([np.ones_like(signal), signal], -1)
        normal = np.einsum("ij,ijk,ijl->kl", w, basis, basis)
        part = np.linalg.lstsq(normal, np.einsum("ij,ijk,ij->k", w, basis, load), rcond=None)[0]
        own = np.linalg.lstsq(normal, np.einsum("ij,ijk,ij->k", w, basis, residual), rcond=None)[0]
        free = np.where(channel == c, load - basis @ part, 0.0)
        rest = np.where(channel == c, residual - basis @ own, 0.0)
        values.append(((w * rest).sum(axis) / np.where(used, each, 1.0))[used])
        templates.append(((w * free).sum(axis) / np.where(used, each, 1.0))[used])
        weights.append(each[used])
    return np.concatenate(values), np.concatenate(templates), np.concatenate(weights)


def smear_score(fields: tuple[Fields, ...], *, axis: int = 0) -> Score[float] | None:
    """Means of columns (axis 1: of rows) against their light. Amplitude: share of the column's mean signal.
    Columns gain light that falls on them while they are shifted; rows may lose as well as gain.

    Of 300 draws of two scenes of 32 x 48 pixels without it p is below 0.1 in 7 %, 0.05 in 4 %, 0.01 in none.
    """
    slopes, errors = [], []
    for f in fields:
        if f.kind != "scene" or f.static is None or not f.usable.any():
            continue
        value, template, weight = _columns(f, axis)
        power = float(np.sum(weight * template**2))
        if value.size < 32 or power <= 0:
            continue
        slope = float(np.sum(weight * template * value)) / power
        rest = value - slope * template
        # Neighbouring columns share the errors of a reference: their mean products widen the scatter.
        pull = weight * template * rest
        shared = sum(float(np.sum(pull[k:] * pull[: pull.size - k])) * (2 if k else 1) for k in range(6))
        least = 1 / np.sqrt(power)
        slopes.append(slope)
        errors.append(max(np.sqrt(max(shared, float(np.sum(pull**2)))) / power, least))
    if not slopes:
        return None
    b, e = np.array(slopes), np.array(errors)
    share = float(np.average(b, weights=1 / e**2))
    error = float(1 / np.sqrt(np.sum(1 / e**2)))
    # Scenes that disagree are wrong each in their own way: it is their references.
    if b.size > 1:
        error *= max(1.0, float(np.sqrt(np.sum(((b - share) / e) ** 2) / (b.size - 1))))
    z = share / error
    found = share if axis else max(share, 0.0)
    return Score(
        log_p=student_log_p(z, 20.0 * b.size) if axis else student_log_p(z, 20.0 * b.size, 1),
        gain=0.5 * (found / error) ** 2,
        penalty=ONE_PARAMETER,
        amplitude=abs(found),
        error=error,
        shift=error,
        power=1,
        parameters={"fraction": (share, "1", error)},
        where={"axis": ("column", "row")[axis]},
        payload=found,
    )


def without_smear(fields: tuple[Fields, ...], score: Score[float], *, axis: int = 0) -> tuple[Fields, ...]:
    """Scenes without the share of each column (axis 1: of each row) that was found."""
    out = []
    for f in fields:
        if f.kind != "scene" or f.static is None:
            out.append(f)
            continue
        column = f.signal.mean(axis, keepdims=True)
        load = score.payload * (column - column.mean()) * f.weight * np.sqrt(f.frames)
        out.append(f._replace(static=(f.static - load).astype(np.float32)))
    return tuple(out)


def smeared(*, name: str, lifted_by: tuple[str, ...]) -> Signature:
    """A share of each column's light in all of its pixels."""
    return plain(
        name=name,
        axes=Axes("pixel", "column", "frozen", "signal", "share of its column"),
        reads=STATIC | {"signal"},
        score=smear_score,
        absorb=without_smear,
        covers=COVERS_NOTHING,
        simulate=carried(lambda s: {"fraction": s.amplitude}),
        lifted_by=lifted_by,
    )


def streaked(*, name: str, covers: tuple[str, ...]) -> Signature:
    """A share of each row's light in all of its pixels, or missing from them: no mechanism's."""
    return plain(
        name=name,
        axes=Axes("readout", "row", "frozen", "signal", "share of its row"),
        reads=STATIC | {"signal"},
        score=partial(smear_score, axis=1),
        absorb=partial(without_smear, axis=1),
        covers=covers,
        simulate=NOT_SIMULATED,
    )
