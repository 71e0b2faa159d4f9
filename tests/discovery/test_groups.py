"""Layouts without a name: found where they are, silent where they are not, gone once taken out."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.signatures import groups
from cannoise_jax.signatures.fields import Fields, helmert, refit
from tests.discovery.capture import capture_set
from tests.discovery.looks import SIGNATURES

SIZE = (64, 96)


def field(rng, frames=4, offsets=None, number=0):
    """A dark of unit noise, plus offsets [frames, h, w]."""
    values = rng.standard_normal((frames, *SIZE)) + (0 if offsets is None else offsets)
    one = np.ones(SIZE, np.float32)
    return Fields(
        "d", "dark", frames, number, 0, 1.0, 0.1, one, 0 * one, one, 0 * one, one > 0,
        np.einsum("nt,tij->nij", helmert(frames), values).astype(np.float32),
        (values.mean(0) * np.sqrt(frames)).astype(np.float32), None, np.ones(4), np.zeros(4),
    )  # fmt: skip


LAYOUTS = [s.kin for s in SIGNATURES.values() if s.name == f"{s.kin}_redrawn" and s.kin != "wave"]


def log_p(fields, name, time):
    return groups.group_score(fields, name=name, time=time).log_p


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in ("tile_16", "diagonal") else pytest.mark.slow) for n in LAYOUTS]
)
def test_p_is_uniform_without_an_effect(name):
    rng = np.random.default_rng(0)
    p = np.exp([log_p((field(rng), field(rng)), name, "redrawn") for _ in range(200)])
    for level in (0.5, 0.1):
        assert np.mean(p < level) == pytest.approx(level, abs=3.5 * np.sqrt(level / 200))


@pytest.mark.parametrize("name", LAYOUTS)
def test_an_offset_new_in_every_frame_is_found_and_taken_out(name):
    rng = np.random.default_rng(1)
    layout = groups.layout(name, SIZE).of
    draws = rng.standard_normal((6, layout.max() + 1))
    draws -= draws.mean(1, keepdims=True)
    sigma = 0.6
    fields = (field(rng, 6, sigma * draws[:, layout]),)
    score = groups.group_score(fields, name=name, time="redrawn")
    assert score.log_p < np.log(1e-4)
    drawn = sigma * np.sqrt(np.mean(draws**2) * (layout.max() + 1) / layout.max())
    assert abs(score.amplitude - drawn) < 3 * score.error
    after = groups.group_absorb(fields, score, name=name, time="redrawn")
    assert log_p(after, name, "redrawn") > np.log(1e-3)
    assert after[0].contrasts.std() == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("name", ["tile_8", "diagonal"])
def test_an_offset_that_stays_is_not_taken_for_one_that_is_redrawn(name):
    rng = np.random.default_rng(2)
    layout = groups.layout(name, SIZE).of
    pattern = 0.3 * rng.standard_normal(layout.max() + 1)[layout]
    fields = tuple(field(rng, 4, pattern, n) for n in range(2))
    assert log_p(fields, name, "redrawn") > np.log(1e-3)
    score = groups.group_score(fields, name=name, time="frozen")
    assert score.log_p < np.log(1e-6)
    after = groups.group_absorb(fields, score, name=name, time="frozen")
    assert log_p(after, name, "frozen") > np.log(1e-3)


def redrawn_by(draw, strength):
    """Noise of this strength, new in every frame, that `draw(rng)` shapes over the frame."""
    return lambda rng: lambda dn, signal, kind, exposure: dn + strength * draw(rng)


def coloured(rng, size):
    """A series of power 1/f and unit variance."""
    spectrum = np.fft.rfft(rng.standard_normal(size))
    frequency = np.maximum(np.arange(spectrum.size), 1)
    scale = np.sqrt(size / (2 * np.sum(1 / frequency[1:-1]) + 1 / frequency[-1]))
    return np.fft.irfft(spectrum * np.where(np.arange(spectrum.size), frequency**-0.5, 0), size) * scale


DRAWS = {
    "row_additive_temporal": lambda rng: rng.standard_normal((96, 1)),
    "column_additive_temporal": lambda rng: rng.standard_normal((1, 128)),
    "row_slope": lambda rng: coloured(rng, 96)[:, None],
    "raster_slope": lambda rng: coloured(rng, 96 * 128).reshape(96, 128),
    "tile_16_redrawn": lambda rng: np.kron(rng.standard_normal((6, 8)), np.ones((16, 16))),
}
STRENGTHS = (("row_additive_temporal", 1.5), ("tile_16_redrawn", 15.0))
"""Looked at by default."""


@pytest.mark.parametrize("sigma", [pytest.param(2.0, marks=pytest.mark.slow), 45.0])
@pytest.mark.parametrize(
    "name", ["row_additive_temporal", pytest.param("row_slope", marks=pytest.mark.slow), "tile_16_redrawn"]
)
def test_what_is_left_of_strong_offsets_is_white(name, sigma):
    """The modelled noise holds strong offsets too: once out, no line or tile stands above its pixels."""
    capture = capture_set(57, redrawn_by(DRAWS[name], sigma), kinds="df")
    prepared = prepare_split(capture, split_recordings(capture))
    signatures = {p.name: p for p in prepared.signatures}
    fields = prepared.fields
    left = refit(signatures[name].absorb(fields, signatures[name].score(fields)))
    again = signatures["tile_16_redrawn" if name.startswith("tile") else "row_additive_temporal"].score(left)
    assert again.log_p > np.log(0.01)
    # What the pixels are left with is their own noise: 3 electrons and shot noise of 1.5 DN/e-, and rounding.
    own = [np.mean(f.sigma.astype(np.float64) ** 2) for f in left]
    # What offsets lift a dark by is no charge.
    true = [4.5**2 + 1 / 12 + 1.5 * np.mean(f.signal) * f.lit for f in left]
    assert np.abs(np.log(np.divide(own, true))).max() < 0.08


@pytest.mark.parametrize(
    ("name", "strength"),
    [
        pytest.param(n, s, marks=() if (n, s) in STRENGTHS else pytest.mark.slow)
        for n in DRAWS
        for s in (1.5, 15.0)
    ],
)
def test_strength_of_what_is_redrawn_is_told_however_strong(name, strength):
    capture = capture_set(11, redrawn_by(DRAWS[name], strength))
    prepared = prepare_split(capture, split_recordings(capture))
    scores = {p.name: p.score(prepared.fields) for p in prepared.signatures if p.name in DRAWS}
    found = scores[name]
    assert abs(found.amplitude - strength) < 3.5 * found.error + 0.015 * strength
    assert max(scores, key=lambda n: scores[n].gain) == name


def test_weak_pink_noise_leaves_its_exponent_open_and_its_strength_near():
    """How fast the power of weak noise falls cannot be seen; that it falls about as 1/f is known."""
    ratios, errors = [], []
    for seed in range(8):
        capture = capture_set(seed, redrawn_by(DRAWS["raster_slope"], 0.3), kinds="d")
        prepared = prepare_split(capture, split_recordings(capture))
        score = {p.name: p for p in prepared.signatures}["raster_slope"].score(prepared.fields)
        ratios.append(score.amplitude / 0.3)
        errors.append((score.amplitude - 0.3) / score.error)
    assert np.max(np.abs(np.log(ratios))) < 0.45
    assert np.sqrt(np.mean(np.square(errors))) < 1.3
