"""The closed form of every mechanism is what Monte Carlo finds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.mechanisms import ENTRIES
from cannoise_jax.physics.core import chain
from cannoise_jax.physics.core.registry import mechanism
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import context_of
from tests.physics.harness import (
    FRAMES,
    PER_RECORDING,
    SETTINGS,
    SIZE,
    camera,
    frames_of,
    key_of,
    prepared,
)


def analogue(model: SensorModel, key, frames: int) -> np.ndarray:
    """The chain without rounding; what acts on codes acts on the unrounded values."""
    context, values, maps = prepared(model)
    y, _ = chain.run_chain(model, key, context, values, frames)
    for i, fitted in enumerate(model.mechanisms):
        if fitted.record.acts_on == "code":
            y = fitted.record.sample(key, y, values[i], maps[i], context)
    return np.asarray(y, np.float64)


# The clamp's holds on an even light, and has a test of its own.
WITH_EFFECT = [e.id for e in ENTRIES if e.record.effect is not None and e.id != "hot_pixel_suppression"]


@pytest.mark.parametrize("id", WITH_EFFECT)
def test_closed_form_is_what_monte_carlo_finds(id):
    model, record = camera(id), mechanism(id)
    context, values, maps = prepared(model)
    effect = record.effect(values[0], maps[0], context)
    if id in PER_RECORDING:
        run = jax.jit(jax.vmap(lambda k: chain.run_chain(model, k, context, values, 2)[0]))
        pairs = np.asarray(run(jax.random.split(key_of(id), FRAMES)), np.float64)
        y, later = pairs[:, 0], pairs
    else:
        y = analogue(model, key_of(id), FRAMES)
        later = None
    if id == "missing_codes":
        y = frames_of(model, key_of(id))
    base = np.asarray(context.black_level + context.mean_dn)[0]
    own = np.broadcast_to(np.asarray(context.own_variance())[0], SIZE)

    def wide(v):
        return np.broadcast_to(np.asarray(0.0 if v is None else v, np.float64), (1, *SIZE))[0]

    variance = own + wide(effect.variance)
    assert (variance > -1e-6).all()
    n = len(y)
    z = y - (base + wide(effect.mean))
    # Frames that remember each other count for fewer.
    memory = 1 + 2 * sum(float(np.max(np.abs(wide(v) / variance))) for v in (effect.temporal or {}).values())
    if id in PER_RECORDING:
        memory = 1.0
    sparse = id in ("cosmic_rays", "brighter_fatter", "lossy_compression", "missing_codes")
    error = np.sqrt(np.maximum(z.var(axis=0), 1e-6) / n * memory)
    slack = 0.05 if sparse else 1e-4 * base
    assert (np.abs(z.mean(axis=0)) < 5.5 * error + slack).all(), "mean"

    # Sums of squares over frames, with their own scatter as the yardstick.
    def close(products, expected, what, tolerance=0.0):
        per_frame = products.reshape(n if len(products) == n else len(products), -1).mean(axis=1)
        blocks = per_frame[: len(per_frame) // 30 * 30].reshape(30, -1).mean(axis=1)
        error = blocks.std(ddof=1) / np.sqrt(30)
        gap = abs(blocks.mean() - float(np.mean(expected)))
        assert gap < 5 * error + tolerance, f"{what}: {blocks.mean():.4f} against {np.mean(expected):.4f}"

    first_order = (
        0.03 if id in ("brighter_fatter", "excess_noise", "lossy_compression", "cosmic_rays") else 0.003
    )
    if id != "missing_codes":
        # At the edge a pixel stands in for its missing neighbour: the closed form holds inside.
        own_neighbour = id in ("in_camera_denoising", "demosaicing", "crosstalk", "brighter_fatter")
        place = (slice(2, -2), slice(2, -2)) if own_neighbour else (slice(None), slice(None))
        inner = z[:, place[0], place[1]]
        close(inner**2, variance[place], "variance", first_order * float(np.mean(variance)))
        for half in (slice(0, inner.shape[1] // 2), slice(inner.shape[1] // 2, None)):
            expected = variance[place][half]
            close(inner[:, half] ** 2, expected, "variance by place", first_order * float(np.mean(variance)))
    shared = {"row": (z[:, :, 3] * z[:, :, 8], wide(effect.row), (3, 8)),
              "column": (z[:, 1] * z[:, 6], wide(effect.column).T, (1, 6)),
              "frame": (z[:, 1, 3] * z[:, 6, 8], None, None)}  # fmt: skip
    lags = effect.lags or {}
    tolerance = first_order * float(np.mean(variance))
    if not lags and effect.frame is None:
        for name in ("row", "column"):
            product, power, (a, b) = shared[name]
            close(product, np.sqrt(np.maximum(power[:, a] * power[:, b], 0)), name, tolerance)
    if effect.frame is not None:
        power = wide(effect.frame)
        close(shared["frame"][0], np.sqrt(power[1, 3] * power[6, 8]), "frame", tolerance)
    for (dy, dx), expected in lags.items():
        ahead = z[:, dy:, dx:] if dy + dx else z
        product = z[:, : SIZE[0] - dy, : SIZE[1] - dx] * ahead
        inside = slice(2, -3)  # away from the edges, where a neighbour stands in for a missing one
        keep = product[:, : SIZE[0] - dy, : SIZE[1] - dx]
        want = wide(expected)[: SIZE[0] - dy, : SIZE[1] - dx]
        if id in ("in_camera_denoising", "demosaicing", "crosstalk", "brighter_fatter"):
            rows = slice(2, max(SIZE[0] - dy - 2, 3)) if dy < 4 else slice(2, 3)
            if dy >= 4:
                continue  # the frame is too small for an interior at this lag
            keep, want = keep[:, rows, inside], want[rows, inside]
        close(keep, want, f"lag {dy}, {dx}", tolerance)
    for step, expected in (effect.temporal or {}).items():
        if later is not None:
            if step == 1:
                w = later - (base + wide(effect.mean))
                close(w[:, 0] * w[:, 1], wide(expected), "temporal", tolerance)
        else:
            close(z[:-step] * z[step:], wide(expected), f"temporal {step}", tolerance)
    centred = y - y.mean(axis=0)
    if effect.third is not None:
        third = np.asarray(context.gain_dn_per_e**2 * context.mean_dn)[0] + wide(effect.third)
        close(centred**3, third, "third cumulant", 0.02 * float(np.mean(np.abs(third))))
    if effect.fourth is not None and np.isfinite(np.asarray(effect.fourth)).all():
        fourth = np.asarray(context.gain_dn_per_e**3 * context.mean_dn)[0] + wide(effect.fourth)
        close(centred**4 - 3 * variance**2, fourth, "fourth cumulant", 0.05 * float(np.mean(variance**2)))


def test_clamped_peaks_have_the_moments_of_the_closed_form():
    record, weight = mechanism("hot_pixel_suppression"), 0.7
    base = SensorModel.poisson_gaussian(1.0, 6.0, 60, 1060, "MONO")
    context = context_of(base, jnp.zeros((1, 64, 64)), SETTINGS)
    noise = 6.0 * np.random.default_rng(2).normal(size=(60, 64, 64)).astype(np.float32)
    y = np.asarray(record.sample(None, jnp.asarray(noise), {"weight": weight}, {}, context))[:, 2:-2, 2:-2]
    effect = record.effect({"weight": weight}, {}, context)
    assert y.mean() == pytest.approx(float(np.mean(effect.mean)), abs=0.04)
    assert y.var() == pytest.approx(36 + float(np.mean(effect.variance)), rel=0.01)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 0.95])
def test_compressed_codes_below_black_have_moments(exponent):
    model = SensorModel.poisson_gaussian(1.0, 3.0, 100.0, 4095.0, "RGGB").with_mechanism(
        "dsnu", sigma_dn=20.0
    )
    model = model.with_mechanism("lossy_compression", step_dn=30.0, exponent=exponent)
    assert np.isfinite(model.expected(np.zeros((16, 24), np.float32), Settings(100.0))).all()
