"""Single pixels that stand out are no pattern of groups, no tails of all pixels and no likeness."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.signatures.added import draw_pixels, likeness
from cannoise_jax.signatures.code_spacing import _wider
from cannoise_jax.signatures.events import spike_score
from cannoise_jax.signatures.fields import helmert
from cannoise_jax.signatures.group_sums import grouped, outlying, shared_sums
from cannoise_jax.signatures.shape import kurtosis_score
from tests.discovery.looks import SIGNATURES, white

SIZE = (64, 96)
_RNG = np.random.default_rng
PATTERNS = (
    "tile_8_frozen",
    "tile_32_frozen",
    "diagonal_frozen",
    "row_additive_static",
    "column_additive_static",
)


def with_static(seed, change, **more):
    fields = white(_RNG(seed), size=SIZE, **more)
    return tuple(f._replace(static=change(f).astype(np.float32)) for f in fields)


@pytest.mark.parametrize("name", PATTERNS)
@pytest.mark.parametrize("share, height", [(0.02, 100.0), (0.05, 8.0), (1.0, 2.0)])
def test_patterns_of_single_pixels_are_none_of_groups(name, share, height):
    """Hot pixels, weak and strong, and a white map of all of them: p stays uniform."""
    p = []
    for seed in range(30):
        heat = _RNG(900 + seed)
        hot = (heat.random(SIZE) < share) * heat.exponential(height, SIZE)
        values = with_static(seed, lambda f, hot=hot: f.static + hot, kinds=("dark", "dark"))
        score = SIGNATURES[name].score(values)
        p.append(np.exp(score.log_p))
    assert stats.kstest(p, "uniform", alternative="greater").pvalue > 1e-3
    assert min(p) > 1e-4


@pytest.mark.parametrize("name, axis", [("row_additive_static", 0), ("column_additive_static", 1)])
def test_lines_are_as_strong_with_hot_pixels_as_without(name, axis):
    lines = 0.4 * _RNG(1).standard_normal(SIZE[axis])
    lines = lines[:, None] if axis == 0 else lines[None, :]
    hot = (_RNG(2).random(SIZE) < 0.02) * 300.0
    told = [
        SIGNATURES[name].score(
            with_static(3, lambda f, more=more: f.static + lines + more, kinds=("dark",) * 2)
        )
        for more in (0.0, hot)
    ]
    assert told[0].log_p < -20 and told[1].log_p < -20
    assert told[1].amplitude == pytest.approx(told[0].amplitude, abs=2 * told[0].error)


def test_sums_of_normal_noise_are_those_of_all_pixels():
    (field,) = white(_RNG(4), kinds=("dark",), size=SIZE)
    rows = grouped(np.indices(SIZE)[0])
    sums = shared_sums((field,), rows, "additive")
    plain = (field.static - field.static.mean()).sum(1)
    normal = sums.score / np.sqrt(sums.information)
    assert normal == pytest.approx(plain / np.sqrt(SIZE[1]), abs=0.6)
    assert np.corrcoef(normal, plain)[0, 1] > 0.98
    assert outlying(field.static, np.ones(SIZE), rows).mean() < 1e-3


def test_a_few_pixels_far_out_are_no_tails_of_all():
    fields = white(_RNG(5), kinds=("dark",) * 3, frames=6, size=SIZE)
    before = kurtosis_score(fields)
    hit = fields[1].contrasts.copy()
    hit[2].flat[:: SIZE[0] * SIZE[1] // 5] = 60.0
    after = kurtosis_score((fields[0], fields[1]._replace(contrasts=hit), fields[2]))
    assert after.log_p > -12 and after.gain < before.gain + 30
    assert after.amplitude < 0.1


@pytest.mark.parametrize("kurtosis", [0.1, 0.5])
def test_tails_of_all_pixels_keep_their_size(kurtosis):
    """Student's t of excess kurtosis 6 / (nu - 4), of unit variance."""
    nu = 4 + 6 / kurtosis
    fields = white(_RNG(6), kinds=("dark",) * 3, frames=2, size=(160, 192))
    scale = np.sqrt((nu - 2) / nu)
    drawn = []
    for f in fields:
        frames = scale * _RNG(60 + f.number).standard_t(nu, (2, 160, 192))
        contrast, mean = (frames[1] - frames[0]) / np.sqrt(2), (frames[1] + frames[0]) / np.sqrt(2)
        drawn.append(f._replace(contrasts=contrast[None].astype(np.float32), static=mean.astype(np.float32)))
    score = kurtosis_score(tuple(drawn))
    assert score.amplitude == pytest.approx(kurtosis, abs=max(4 * score.error, 0.2 * kurtosis))


@pytest.mark.parametrize("shared", [0.0, 0.3])
def test_pixels_of_a_cell_are_drawn_as_alike_as_they_are(shared):
    rng = _RNG(7)
    cells = np.kron(rng.standard_normal((80, 100)), np.ones((2, 2)))
    truth = np.sqrt(1 - shared) * rng.standard_normal((160, 200)) + np.sqrt(shared) * cells
    information = np.full(truth.shape, 0.8)
    score = information * truth + np.sqrt(information) * rng.standard_normal(truth.shape)
    drawn = draw_pixels(score, information, 1.0, rng)
    within = np.mean(drawn[:, 0::2] * drawn[:, 1::2]) / drawn.var()
    across = np.mean(drawn[:, 1:-1:2] * drawn[:, 2::2]) / drawn.var()
    assert within == pytest.approx(shared, abs=0.03) and abs(across) < 0.03
    assert drawn.var() == pytest.approx(truth.var(), rel=0.05)
    assert np.corrcoef(drawn.ravel(), truth.ravel())[0, 1] > 0.35


def test_chance_likeness_and_a_few_far_pixels_count_as_none():
    rng = _RNG(8)
    information = np.full((4000, 4), 2.0)
    values = rng.standard_normal((4000, 4))
    values[:3] = 400.0
    noise = np.sqrt(information) * rng.standard_normal((4000, 4))
    assert np.array_equal(likeness(information * values + noise, information, 1.0), np.eye(4))


def test_a_map_of_all_pixels_leaves_those_in_sight_that_are_no_part_of_it():
    rng = _RNG(9)
    (field,) = white(rng, kinds=("flat",), frames=6, size=SIZE, signal=900.0, sigma=30.0)
    response = 0.01 * rng.standard_normal(SIZE)
    dim = np.zeros(SIZE, bool)
    dim.flat[100::1500] = True
    change = np.where(dim, -0.9, response) * np.sqrt(6) * field.signal / field.sigma
    field = field._replace(static=(field.static + change).astype(np.float32))
    prnu = SIGNATURES["pixel_relative_static"]
    score = prnu.score((field,))
    (left,) = prnu.absorb((field,), score)
    assert score.amplitude == pytest.approx(0.01, rel=0.1)
    assert np.array_equal(left.static[dim], field.static[dim])
    assert left.static[~dim].std() == pytest.approx(1.0, abs=0.05)


def test_pixels_that_two_hits_met_by_chance_go_with_the_hits():
    rng = _RNG(10)
    frames = rng.standard_normal((8, *SIZE))
    frames += 15.0 * (rng.random(frames.shape) < 0.01)
    (field,) = white(rng, kinds=("dark",), frames=8, size=SIZE)
    field = field._replace(
        contrasts=np.einsum("nt,tij->nij", helmert(8), frames).astype(np.float32),
        static=(frames.mean(0) * np.sqrt(8)).astype(np.float32),
    )
    clocking = SIGNATURES["clocking"]
    (left,) = clocking.absorb((field,), clocking.score((field,)))
    before, after = (SIGNATURES["telegraph"].score((f,)) for f in (field, left))
    # Noisy as telegraph pixels are, but not the same ones again; and without the hits not even noisy.
    assert before.gain > 1000 and before.log_p > -7
    assert after.gain < 10 and after.log_p > -7


@pytest.mark.parametrize("gain, multiplied", [(24.0, True), (40.0, False)])
def test_electrons_that_do_not_stand_out_are_counted(gain, multiplied):
    """Of single electrons of exponential size, half of the gain that variance tells in the mean, a few stand
    out of a noise of 4 DN; of those of one size nearly all do."""
    rng, rate = _RNG(12), 0.004
    fields = []
    for f in white(rng, kinds=("dark", "dark"), frames=10, size=SIZE, sigma=4.0):
        size = (10, *SIZE)
        each = rng.exponential(gain / 2, size) if multiplied else gain
        frames = rng.standard_normal(size) + (rng.random(size) < rate) * each / 4.0
        contrasts = np.einsum("nt,tij->nij", helmert(10), frames).astype(np.float32)
        static = (frames.mean(0) * np.sqrt(10)).astype(np.float32)
        fields.append(f._replace(contrasts=contrasts, static=static, gain=np.full(4, gain)))
    found = SIGNATURES["clocking"].score(tuple(fields))
    assert found.amplitude == pytest.approx(rate, rel=0.2)
    assert np.isfinite(found.shift)
    # A camera model draws electrons of the gain that variance tells.
    assert found.payload == pytest.approx(0.5 if multiplied else 1.0, rel=0.1)


def test_electrons_are_counted_where_many_pixels_hold_two_of_them():
    rng, rate = _RNG(13), 0.03
    fields = []
    for f in white(rng, kinds=("dark", "dark"), frames=16, size=SIZE, sigma=4.0):
        size = (16, *SIZE)
        frames = rng.standard_normal(size) + rng.poisson(rate, size) * rng.exponential(16.0, size) / 4.0
        contrasts = np.einsum("nt,tij->nij", helmert(16), frames).astype(np.float32)
        static = (frames.mean(0) * np.sqrt(16)).astype(np.float32)
        fields.append(f._replace(contrasts=contrasts, static=static, gain=np.full(4, 32.0)))
    found = SIGNATURES["clocking"].score(tuple(fields))
    assert found.amplitude == pytest.approx(rate, rel=0.2)
    assert abs(found.amplitude - rate) < 3 * found.error


@pytest.mark.parametrize("growth, told", [(0.0, False), (0.5, True)])
def test_codes_far_apart_are_told_to_grow_farther_apart(growth, told):
    """Three flats, each over some eight codes of a lattice that widens with the signal, or does not."""
    there = [100]
    while there[-1] < 3000:
        there.append(there[-1] + round(20 * (there[-1] / 500) ** growth))
    code = np.concatenate(
        [np.arange(low, low + width) for low, width in ((700, 150), (1400, 250), (2500, 350))]
    )
    assert (_wider(code, ~np.isin(code, there)) < -10) == told


@pytest.mark.parametrize("exposure", [None, 0.0])
def test_hits_of_frames_of_unknown_exposure_are_counted_by_the_frame(exposure):
    rng = _RNG(10)
    fields = white(rng, kinds=("scene", "scene"), frames=8, size=SIZE)
    fields = tuple(f._replace(exposure_s=exposure) for f in fields)
    fields[0].contrasts[2, 30, 40] += 40.0
    score = spike_score(fields, kind="hits")
    assert score is not None and np.isfinite([score.amplitude, score.error, score.shift]).all()
    megapixels = sum(f.frames for f in fields) * fields[0].mean.size / 1e6
    assert score.amplitude * megapixels == pytest.approx(round(score.amplitude * megapixels), abs=1e-6)


@pytest.mark.parametrize(("gain", "seen"), [(1.5, 0.0), (27.0, 0.5), (60.0, 1.0)])
def test_single_electrons_are_told_as_far_as_they_stand_out(gain, seen):
    """Noise of 4.5 DN: an electron of 27 DN lies at the limit and a little above, half of them beyond."""
    fields = [f._replace(gain=np.full(4, gain), sigma=np.full(SIZE, 4.5)) for f in white(_RNG(3), size=SIZE)]
    darks = tuple(f for f in fields if not f.lit)
    score = SIGNATURES["clocking"].score(darks)
    assert score is not None
    frames = sum(f.frames for f in darks) * fields[0].mean.size
    expected = 3 / frames / seen if seen else np.inf
    assert score.shift == pytest.approx(expected, rel=0.5)
