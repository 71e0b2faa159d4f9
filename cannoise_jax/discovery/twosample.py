"""A two-sample test that knows no physics: can a small network tell residuals from draws of the simulator?

Patches of 32 x 32 residuals, standardised by the baseline. The network is trained on one half of the frames
and one half of the image, and measured on the other halves of both. 0.5: it cannot tell.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key
from scipy import stats

from cannoise_jax.discovery.fields import Fields, frame_fields
from cannoise_jax.evaluation.kl import kl_divergence, kl_floor

SIDE = 32
_FILTERS = 8
_STEPS = 250
_BATCH = 128
_MOST = 6000
"""Patches per class and split."""


class Patches(NamedTuple):
    """Standardised patches and the frame each comes from."""

    values: Float[np.ndarray, "n s s"]
    unit: np.ndarray


class Verdict(NamedTuple):
    """Area under the curve with its 90 % interval by resampling frames; histogram divergence and its
    floor."""

    auc: float
    low: float
    high: float
    kl: float
    kl_floor: float


def draw_fields(rng: np.random.Generator, fields: tuple[Fields, ...]) -> tuple[np.ndarray, ...]:
    """Frames drawn from the baseline at the fitted means, rounded, standardised like the recordings."""
    out = []
    for f in fields:
        gain = float(np.mean(f.gain))
        shape = (f.frames, *f.mean.shape)
        shot = np.zeros(shape)
        read = np.maximum(f.sigma**2 - f.step**2 / 12, 0)
        if f.lit and gain > 0:
            electrons = np.maximum(f.signal / gain, 0)
            shot = gain * (rng.poisson(electrons, shape) - electrons)
            read = np.maximum(read - gain * np.maximum(f.signal, 0), 0)
        values = f.mean + shot + np.sqrt(read) * rng.standard_normal(shape)
        rounded = np.round(values / f.step) * f.step
        # The real residuals are free of what each recording's own mean fit took away.
        out.append(((rounded - f.mean) * f.weight).astype(np.float32))
    return tuple(out)


def real_fields(fields: tuple[Fields, ...]) -> tuple[np.ndarray, ...]:
    """Standardised frames of the recordings, with their static part where the mean is modelled."""
    return tuple(frame_fields(f) for f in fields)


def cut(frames: tuple[np.ndarray, ...], parity: int) -> Patches:
    """Non-overlapping patches of every other site of a checkerboard."""
    values, unit, number = [], [], 0
    for stack in frames:
        t, h, w = stack.shape
        ny, nx = h // SIDE, w // SIDE
        tiles = stack[:, : ny * SIDE, : nx * SIDE].reshape(t, ny, SIDE, nx, SIDE).transpose(0, 1, 3, 2, 4)
        sites = (np.add.outer(np.arange(ny), np.arange(nx)) % 2) == parity
        chosen = tiles[:, sites]
        values.append(chosen.reshape(-1, SIDE, SIDE))
        unit.append(np.repeat(np.arange(t) + number, chosen.shape[1]))
        number += t
    return Patches(np.clip(np.concatenate(values), -8, 8), np.concatenate(unit))


def _init(key: Key[Array, ""]):
    keys = jax.random.split(key, 5)
    features = 4 * _FILTERS
    return {
        "conv": 0.2 * jax.random.normal(keys[0], (5, 5, 1, _FILTERS)),
        "rows": jax.random.normal(keys[1], (SIDE, _FILTERS)) / SIDE + 1 / SIDE,
        "columns": jax.random.normal(keys[2], (SIDE, _FILTERS)) / SIDE + 1 / SIDE,
        "hidden": jax.random.normal(keys[3], (features, 16)) / np.sqrt(features),
        "bias": jnp.zeros(16),
        "out": jax.random.normal(keys[4], (16,)) / 4,
        "offset": jnp.zeros(()),
    }


def _logit(params, x: Float[Array, "b s s"]) -> Float[Array, "b"]:
    """Local filters and whole-line projections, squared and averaged, then two dense layers."""
    local = jax.lax.conv_general_dilated(
        x[..., None], params["conv"], (2, 2), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    rows = jnp.einsum("bij,jk->bik", x, params["rows"]) * np.sqrt(SIDE)
    columns = jnp.einsum("bij,ik->bjk", x, params["columns"]) * np.sqrt(SIDE)
    pooled = [jnp.mean(local**2, (1, 2)), jnp.mean(jnp.abs(local) ** 3, (1, 2)) / 2]
    pooled += [jnp.mean(rows**2, 1), jnp.mean(columns**2, 1)]
    features = jnp.log1p(jnp.concatenate(pooled, -1))
    hidden = jax.nn.tanh((features - 0.5) @ params["hidden"] + params["bias"])
    return hidden @ params["out"] + params["offset"]


@jax.jit
def _train(key: Key[Array, ""], x: Float[Array, "n s s"], y: Float[Array, "n"]):
    optimiser = optax.adam(optax.cosine_decay_schedule(1e-2, _STEPS))
    start, order = jax.random.split(key)
    params = _init(start)

    def loss(p, a, b):
        return optax.sigmoid_binary_cross_entropy(_logit(p, a), b).mean()

    def step(carry, k):
        p, state = carry
        chosen = jax.random.randint(k, (_BATCH,), 0, x.shape[0])
        updates, state = optimiser.update(jax.grad(loss)(p, x[chosen], y[chosen]), state)
        return (optax.apply_updates(p, updates), state), None

    (params, _), _ = jax.lax.scan(step, (params, optimiser.init(params)), jax.random.split(order, _STEPS))
    return params


_scores = jax.jit(_logit)


def area(real: np.ndarray, fake: np.ndarray) -> float:
    """Area under the curve of two sets of scores."""
    ranks = stats.rankdata(np.concatenate([real, fake]))
    return float((ranks[: real.size].sum() - real.size * (real.size + 1) / 2) / (real.size * fake.size))


def _sized(rng: np.random.Generator, patches: Patches, number: int) -> Patches:
    """Exactly `number` patches, drawn without repeats where there are enough: one compiled size serves
    all."""
    chosen = rng.choice(len(patches.values), number, replace=len(patches.values) < number)
    return Patches(patches.values[chosen], patches.unit[chosen])


def two_sample(
    key: Key[Array, ""],
    train: tuple[Fields, ...],
    test: tuple[Fields, ...],
    train_base: tuple[Fields, ...],
    test_base: tuple[Fields, ...],
    span: float,
) -> Verdict:
    """Residual fields against draws of the baseline. `train`, `test`: what is left of the recordings with the
    model taken out; `*_base`: the fields of the baseline, from which the draws are made."""
    seed, fit, again = (int(v) for v in jax.random.randint(key, (3,), 0, 2**31 - 1))
    rng = np.random.default_rng(seed)
    fake_train, fake_test = draw_fields(rng, train_base), draw_fields(rng, test_base)
    # Recordings whose mean is not modelled are compared without their static part, draws likewise.
    fake_train = _match(train, fake_train)
    fake_test = _match(test, fake_test)
    real_train, real_test = real_fields(train), real_fields(test)
    number = int(min(_MOST, max(len(cut(real_train, 0).values), 256)))
    number = 2 ** int(np.log2(number))
    a, b = _sized(rng, cut(real_train, 0), number), _sized(rng, cut(fake_train, 0), number)
    x = np.concatenate([a.values, b.values]).astype(np.float32)
    y = np.concatenate([np.ones(number), np.zeros(number)]).astype(np.float32)
    params = _train(jax.random.key(fit), x, y)
    c, d = cut(real_test, 1), cut(fake_test, 1)
    size = int(min(_MOST, len(c.values), len(d.values)))
    c, d = _sized(rng, c, size), _sized(rng, d, size)
    real, fake = np.asarray(_scores(params, c.values)), np.asarray(_scores(params, d.values))
    resampled = []
    rng = np.random.default_rng(again)
    units = np.unique(c.unit)
    groups_c, groups_d = (
        [np.flatnonzero(c.unit == u) for u in units],
        [np.flatnonzero(d.unit == u) for u in units],
    )
    for _ in range(200):
        drawn = rng.integers(0, len(units), len(units))
        rc, rd = np.concatenate([groups_c[u] for u in drawn]), np.concatenate([groups_d[u] for u in drawn])
        if rc.size and rd.size:
            resampled.append(area(real[rc], fake[rd]))
    low, high = np.quantile(resampled, (0.05, 0.95))
    sigmas = [f.sigma / span for f in test]
    noise = np.concatenate([(v * s).ravel() for v, s in zip(real_test, sigmas, strict=True)])
    drawn_noise = np.concatenate([(v * s).ravel() for v, s in zip(fake_test, sigmas, strict=True)])
    return Verdict(
        area(real, fake),
        float(low),
        float(high),
        kl_divergence(noise, drawn_noise),
        kl_floor(noise, drawn_noise.size, seed=0),
    )


def _match(fields: tuple[Fields, ...], drawn: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Removes from the draws the frame mean that the recordings of unmodelled mean lack."""
    out = []
    for f, d in zip(fields, drawn, strict=True):
        if f.static is None and f.frames > 1:
            d = (d - d.mean(0)) * np.float32(np.sqrt(f.frames / (f.frames - 1.0)))
        out.append(d * f.usable)
    return tuple(out)
