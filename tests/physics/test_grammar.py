"""Every place in the grammar does what its closed form claims, and places that contradict themselves are
refused."""

import itertools
import zlib
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core.grammar import (
    TIMES,
    Distribution,
    Point,
    Spectrum,
    contradiction,
    mechanism_from_grammar,
)
from cannoise_jax.physics.core.places import SITES
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import context_of

# As many rows as columns, blocks as channels: what is compiled for one serves the other.
SIZE, FRAMES, BLOCKS = (6, 6), 1500, 30
KERNEL = tuple((np.array([0, 5, 0, 5, 6, 2, 0, 3, 1]) / 10).tolist())
VALUES = {
    "exponent": 1.0, "frequency": 0.13, "frequency_y": -0.21, "frequency_x": 0.13, "tukey_lambda": -0.05,
    "fraction": 0.3, "rate": 0.2, "memory_frames": 1.5,
}  # fmt: skip
SIGMA_DN = 5.0


def grid() -> list[Point]:
    """Every combination of sites, time, spectrum and distribution that is allowed; what they act on, how and
    with which power of the signal, in turn."""
    acts: Any = itertools.cycle(
        itertools.product(
            (("photons", "mean"), ("pixel", "charge"), ("readout", "signal"), ("digital", "code")),
            ("add", "multiply"),
        )
    )
    signals = itertools.cycle((0.0, 0.5, 1.0))
    axes = itertools.product(SITES, TIMES, get_args(Spectrum), get_args(Distribution))
    lines: list[dict[str, Any]] = [{"group": 2, "phase": 1}, {"interleave": 2}, {"group": 2, "interleave": 2}]
    every: list[dict[str, Any]] = [
        {"over": o, "time": t, "spectrum": s, "distribution": d, "kernel": KERNEL if s == "kernel" else ()}
        for o, t, s, d in axes
    ]
    every += [{"over": o, "time": t, **n} for o in ("row", "column") for t in TIMES for n in lines]
    allowed = [e for e in every if contradiction(Point("readout", "signal", **e)) is None]
    return [
        Point(stage, acts_on, combine=combine, signal=signal, blocks=(2, 2), **e)
        for e, ((stage, acts_on), combine), signal in zip(allowed, acts, signals)  # noqa: B905
    ]


def name_of(point: Point) -> str:
    extra = "" if point.plain else f"-{point.group}x{point.interleave}"
    return f"{point.over}-{point.time}-{point.spectrum}-{point.distribution}{extra}"


def wide(values) -> np.ndarray:
    return np.broadcast_to(np.asarray(0.0 if values is None else values, np.float64), (1, *SIZE))[0]


def shifted(values: np.ndarray, dy: int, dx: int) -> tuple[np.ndarray, np.ndarray]:
    """Values at all places that have one (dy, dx) away, and those there."""
    width, left = SIZE[1] - abs(dx), max(-dx, 0)
    right = left + dx
    return values[..., : SIZE[0] - dy, left : left + width], values[..., dy:, right : right + width]


def close(products: np.ndarray, expected, what: str, slack: float):
    """The mean over frames is as expected, within six of its own standard errors."""
    blocks = products.reshape(len(products), -1).mean(axis=1)
    blocks = blocks[: len(blocks) // BLOCKS * BLOCKS].reshape(BLOCKS, -1).mean(axis=1)
    error, want = blocks.std(ddof=1) / np.sqrt(BLOCKS), float(np.mean(expected))
    assert abs(blocks.mean() - want) <= 6 * error + slack, f"{what}: {blocks.mean():.4g}, claimed {want:.4g}"


def slices() -> list:
    """Every fifth point, among which is every value of every axis; the others take the slow tests."""
    return [
        pytest.param(p, id=name_of(p), marks=() if n % 5 == 0 else pytest.mark.slow)
        for n, p in enumerate(grid())
    ]


@pytest.mark.parametrize("point", slices())
def test_every_allowed_point_does_what_it_claims(point):
    # So bright that shot noise is nothing beside the field.
    base = SensorModel.poisson_gaussian(1e-3, 0.0, 200, 16383, "MONO")
    context = context_of(base, jnp.full((1, *SIZE), 0.05), Settings())
    record = mechanism_from_grammar(point)
    assert record.sample is not None and record.effect is not None
    signal = float(context.mean_dn[0, 0, 0])
    unit = signal if point.combine == "multiply" else 1e-3 if point.acts_on == "mean" else 1.0
    strength = SIGMA_DN / unit / 0.05**point.signal
    values = {n: jnp.float32(VALUES.get(n, strength)) for n in record.defaults()}
    seed = zlib.crc32(name_of(point).encode())
    maps = record.draw_maps(jax.random.key(seed), values, context) if record.draw_maps else {}
    charges = point.acts_on in ("mean", "charge")
    level = context.mean_dn / 1e-3 if charges else context.black_level + context.mean_dn
    x = jnp.broadcast_to(level, (3 if point.time == "frozen" else FRAMES, *SIZE))
    drawn = np.asarray(record.sample(jax.random.key(seed + 1), x, values, maps, context), np.float64)
    y = (drawn - np.asarray(level, np.float64)) * (1e-3 if charges else 1.0)
    effect = record.effect(values, maps, context)
    mean = wide(effect.mean)
    if point.time == "frozen":
        np.testing.assert_allclose(y, np.broadcast_to(mean, y.shape), atol=0.02)
        return
    z, variance = y - mean, wide(effect.variance)
    slack = 0.01 * float(variance.mean())
    close(z, 0.0, "mean", 1e-3)
    close(z**2, variance, "variance", slack)
    for n in (1, 2):
        close(z[:-n] * z[n:], wide((effect.temporal or {}).get(n)), f"{n} frames later", slack)
    row, column, frame = (wide(v) for v in (effect.row, effect.column, effect.frame))
    lags = {(0, 1): row + frame, (0, 2): row + frame, (1, 0): column + frame, (2, 0): column + frame}
    if point.plain and point.spectrum == "white":
        lags |= {(1, 1): frame}
    lags |= {lag: wide(v) for lag, v in (effect.lags or {}).items()}
    for (dy, dx), claimed in lags.items():
        here, there = shifted(z, dy, dx)
        close(here * there, shifted(claimed, dy, dx)[0], f"lag {dy}, {dx}", slack)
    close(z**3, wide(effect.third), "third cumulant", 0.01 * SIGMA_DN**3)
    close(z**4 - 3 * variance**2, wide(effect.fourth), "fourth cumulant", 0.02 * SIGMA_DN**4)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"over": "raster", "time": "drifting", "spectrum": "sinusoid"}, "it does not drift"),
        ({"over": "frame", "time": "redrawn", "spectrum": "sinusoid"}, "runs over rows"),
        ({"over": "block", "time": "redrawn", "spectrum": "power_law"}, "runs over rows"),
        ({"over": "row", "time": "redrawn", "spectrum": "kernel", "kernel": KERNEL}, "filters pixels"),
        (
            {
                "over": "pixel", "time": "redrawn", "spectrum": "kernel", "kernel": KERNEL,
                "distribution": "tukey_lambda",
            },
            "it is gaussian",
        ),
        ({"over": "row", "time": "redrawn", "spectrum": "power_law", "distribution": "sparse"}, "gaussian"),
        ({"over": "pixel", "time": "telegraph", "distribution": "tukey_lambda"}, "two levels"),
        ({"over": "row", "time": "telegraph", "spectrum": "power_law"}, "two levels"),
        ({"over": "block", "time": "redrawn", "group": 2}, "come in groups"),
    ],
)  # fmt: skip
def test_axes_that_do_not_go_together_are_refused(axes, message):
    base, point = (
        SensorModel.poisson_gaussian(1.0, 3.0, 100, 1023, "MONO"),
        Point("readout", "signal", **axes),
    )
    with pytest.raises(ValueError, match=message) as caught:
        base.with_mechanism("odd", point=point)
    assert str(caught.value).startswith("odd: grammar: ") and "\n" not in str(caught.value)
