"""How pixels and lines move from frame to frame: a name that says how is held to it."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.stats import norm

from cannoise_jax.discovery.compare.families import NEXT_FRAME, NEXT_LINES, STATIC, STRUCTURE, of
from cannoise_jax.discovery.compare.measure import shared, shared_variance
from cannoise_jax.discovery.compare.moves import (
    JUMPS,
    LEVEL_CHANCES,
    lines_after,
    lone_values,
    noise_of_lines,
    two_levels,
)
from cannoise_jax.discovery.compare.run import compare_bank
from cannoise_jax.discovery.compare.sources import modelled
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.adequacy import doubt
from cannoise_jax.discovery.proof.check import frames_for_names
from cannoise_jax.discovery.proof.claims import forgetful, memory
from cannoise_jax.discovery.proof.claims import two_levels as more_levels
from cannoise_jax.discovery.proof.own_part import borne_by
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.signatures import laws
from cannoise_jax.signatures.carriers import carrier, refined
from cannoise_jax.signatures.fields import helmert
from tests.discovery.capture import SIZE, capture_set, row_offsets

KEY = jax.random.key(5)
GAIN, READ, BLACK, WHITE, SIGMA, JUMP = 1.5, 3.0, 200.0, 16383.0, 1.5, 27.0


def drawn(alter, name, frames=10, **values):
    """Darks that were altered against a simulator with a mechanism of these strengths, and without."""
    size = SIZE if frames > 4 else (1600, 48)  # of few frames more rows tell as much
    capture = capture_set(8, alter, kinds="d", read=READ, frames=frames, size=size)
    plain = SensorModel.poisson_gaussian([[GAIN] * 4], [[READ] * 4], (BLACK,) * 4, WHITE, "RGGB")
    return [
        compare_bank(capture, modelled(m, KEY), sets=2, alpha=0.002)
        for m in (plain.with_mechanism(name, **values), plain)
    ]


def remembering(memory):
    """Row noise that is partly that of the frame before; recordings begin anew where the kind changes."""

    def alter(rng):
        last: dict[float, np.ndarray] = {}

        def change(dn, signal, kind, t):
            new = rng.standard_normal((dn.shape[0], 1))
            old = last.get(t, rng.standard_normal((dn.shape[0], 1)))
            last[t] = memory * old + np.sqrt(1 - memory**2) * new
            return dn + SIGMA * last[t]

        return change

    return alter


@pytest.mark.parametrize(
    ("alter", "frames", "doubted"),
    [
        pytest.param(remembering(0.8), 10, True, marks=pytest.mark.slow),
        (remembering(0.8), 3, True),
        (row_offsets(SIGMA), 10, False),
    ],
)
def test_rows_that_remember_the_frame_before_are_no_row_noise(alter, frames, doubted):
    full, less = drawn(alter, "row_noise", frames, sigma_dn=SIGMA)
    found = forgetful(full, borne_by(full, less))
    assert (found is not None) == doubted
    if found is not None:
        assert any("remember" in line for line in found.against)


@pytest.mark.parametrize("frames", [3, 4, 10])
@pytest.mark.parametrize("kept", [-0.5, 0.0, 0.8])
def test_the_memory_of_lines_is_told_whatever_the_number_of_frames(frames, kept):
    """Lines that are new in part in every frame, the mean of the frames out of them."""
    rng, size = np.random.default_rng(frames), (4000, 8)
    lines = [rng.standard_normal((size[0], 1))]
    for _ in range(frames - 1):
        lines.append(kept * lines[-1] + np.sqrt(1 - kept**2) * rng.standard_normal((size[0], 1)))
    values = np.stack(lines) + 0.1 * rng.standard_normal((frames, *size))
    contrasts = np.einsum("nt,tij->nij", helmert(frames), values)
    correlation, _ = lines_after(contrasts, np.ones(size, bool))
    assert memory(correlation[1:2], frames)[0] == pytest.approx(kept, abs=0.1)


def jumping(levels):
    """One pixel of a hundred jumps between levels, six standard deviations apart where it has two; three are
    of the same variance."""
    apart = JUMP * np.sqrt(3 / (levels**2 - 1))

    def alter(rng):
        sites = rng.random((96, 128)) < 0.01
        middle = (levels - 1) / 2
        return lambda dn, signal, kind, t: dn + sites * apart * (rng.integers(0, levels, dn.shape) - middle)

    return alter


@pytest.mark.parametrize(("levels", "doubted"), [(3, True), (2, False)])
def test_pixels_of_three_levels_are_no_telegraph_pixels(levels, doubted):
    found = two_levels_enough(jumping(levels))
    assert (found is not None) == doubted
    if found is not None:
        assert found.left > 0.5 and "more than two levels" in found.against[0]


def two_levels_enough(alter, fraction=0.01):
    return more_levels(drawn(alter, "rts", jump_dn=JUMP, fraction=fraction, rate=0.5)[0])


@pytest.mark.slow
def test_how_many_pixels_jump_says_nothing_of_their_levels():
    """Twice as many in the simulator, or half: pixels of two levels stay such."""
    for fraction in (0.005, 0.02):
        assert two_levels_enough(jumping(2), fraction) is None
        assert two_levels_enough(jumping(3), fraction) is not None


def flips(rng):
    """One bit of one code in seven hundred is wrong; the black level has it clear: nearly all go up."""

    def alter(dn, signal, kind, t):
        codes = np.round(dn).astype(int)
        return np.where(rng.random(dn.shape) < 0.0015, codes ^ 16, codes)

    return alter


def test_steps_of_one_size_to_one_side_are_no_heavy_tails():
    """Of equal excess kurtosis: 0.2, that of a Tukey lambda of 0.1."""
    full, less = drawn(flips, "heavy_tails", tukey_lambda=0.1)
    found = doubt(full, borne_by(full, less))
    assert found is not None and any("tails" in line or "one frame" in line for line in found.against)


def contrasts(values):
    return np.tensordot(helmert(len(values)), values, 1)


@pytest.mark.parametrize("levels", [2, 3])
def test_two_levels_are_enough_for_pixels_that_have_two(levels):
    rng = np.random.default_rng(3)
    values = rng.standard_normal((10, 400)) + 6.0 * rng.integers(0, levels, (10, 400))
    counts = two_levels(contrasts(values), np.ones(400))
    assert counts.sum() == 400 and counts.size == len(LEVEL_CHANCES) + 1
    assert (counts[3:].sum() > 300) if levels == 3 else (counts[3:].sum() < 20)


def test_values_that_lie_off_alone_are_counted_by_size_and_side():
    rng = np.random.default_rng(4)
    values = rng.standard_normal((8, 64, 64)).astype(np.float32)
    values[2, 5, 5], values[3, 9, 9] = 14.0, -7.5
    found, counts = lone_values(contrasts(values), np.ones((64, 64)), np.ones((64, 64), bool))
    assert np.argwhere(found).tolist() == [[5, 5], [9, 9]]
    below, above = counts[:, : len(JUMPS)], counts[:, len(JUMPS) :]
    assert above[2, JUMPS.index(12.0)] == 1 and below[3, JUMPS.index(6.0)] == 1
    assert below[:, JUMPS.index(8.0) :].sum() == 0
    # Beyond 2.5 standard deviations normal noise has 0.62 % on each side.
    assert below.sum() == pytest.approx(0.0062 * values.size, rel=0.3)


@pytest.mark.parametrize("spectrum", ["white", "red"])
def test_lines_of_independent_frames_scatter_as_stated(spectrum):
    rng = np.random.default_rng(5)

    def draw():
        rows = rng.standard_normal((6, 64))
        rows = np.cumsum(rows, 1) if spectrum == "red" else rows
        frames = rows[:, :, None] + 0.1 * rng.standard_normal((6, 64, 48))
        return lines_after(contrasts(frames), np.ones((64, 48), bool))

    values, stated = (np.array(v) for v in zip(*(draw() for _ in range(200)), strict=True))
    scatter = values.var(0) / stated.mean(0)
    assert (scatter > 0.3).all() and (scatter < 2.0).all()


UNEVEN = {
    "white": lambda rng, shape: rng.standard_normal(shape),
    "tails": lambda rng, shape: rng.standard_t(5, shape),
    "pixels": lambda rng, shape: rng.standard_normal(shape) * np.exp(0.35 * rng.standard_normal(shape[1:])),
    "rows": lambda rng, shape: rng.standard_normal(shape) + rng.standard_normal((shape[0], shape[1], 1)),
    "columns": lambda rng, shape: (
        rng.standard_normal(shape) * np.exp(0.06 * rng.standard_normal((1, 1, shape[2])))
    ),
}


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=() if k in ("pixels", "columns") else pytest.mark.slow) for k in UNEVEN]
)
def test_noise_of_lines_is_alike_unless_lines_have_noise_of_their_own(kind):
    rng, shape = np.random.default_rng(12), (7, 96, 128)
    kept = np.ones(shape[1:], bool)

    def measured(kind):
        z = UNEVEN[kind](rng, shape)
        return noise_of_lines((z / z.std()).astype(np.float32), kept)

    z = []
    for _ in range(60):
        values, variance = measured(kind)
        simulated = np.stack([measured("white" if kind == "columns" else kind)[0][None] for _ in range(2)])
        z.append(laws.compare_means(values[None], simulated, variance).z)
    rows, columns = np.transpose(z)
    assert np.std(rows) == pytest.approx(1, abs=0.3) and np.abs(rows).max() < 4
    if kind == "columns":
        assert np.median(columns) > 7
    else:
        assert np.std(columns) == pytest.approx(1, abs=0.3) and np.abs(columns).max() < 4


def test_names_are_held_against_frames_in_the_order_they_were_taken():
    capture = capture_set(1, kinds="df", size=(256, 320), frames=9)
    splits = [([0, 1, 2, 4, 5, 6, 8], [3, 7])] * len(capture.recordings)
    chosen = [frames for _, frames in frames_for_names(capture, splits)]
    assert all(frames == list(range(len(frames))) for frames in chosen)
    # Six recordings of 82 thousand pixels: not nine frames of each, but more than a pair.
    assert {len(frames) for frames in chosen} == {2} or all(2 < len(frames) < 9 for frames in chosen)


def test_light_that_the_surface_does_not_follow_is_no_pattern_that_recordings_share():
    """Of two colours that alternate from column to column, off to either side."""
    rng = np.random.default_rng(6)
    at = np.linspace(-1, 1, 160)
    off = 0.3 * at**6 * np.where(np.arange(160) % 2, 1.0, -1.0)
    one, two = (rng.standard_normal((128, 160)) + off for _ in range(2))
    assert abs(shared(one, two)[2]) * np.sqrt(160) < 3
    steps = 0.3 * rng.standard_normal(160)
    one, two = (rng.standard_normal((128, 160)) + steps for _ in range(2))
    assert shared(one, two)[2] * np.sqrt(160) > 8


FREQUENCY = 0.0011
"""Cycles a pixel of the raster: a period of seven rows."""


def waves(rng):
    """A wave along the raster, of a phase of its own in every frame."""

    def alter(dn, signal, kind, t):
        phase = 2 * np.pi * (FREQUENCY * np.arange(dn.size) + rng.uniform())
        return dn + 2 * SIGMA * np.sin(phase).reshape(dn.shape)

    return alter


@pytest.mark.parametrize(
    "seeds", [range(2), pytest.param(range(2, 10), marks=pytest.mark.slow)], ids=["few", "more"]
)
def test_what_a_redrawn_wave_leaves_in_a_mean_of_few_frames_is_no_fixed_pattern(seeds):
    """One frequency at random phases: its mean over the frames is as large or small as these happen to add
    up to. Of ten cameras none has rows that stay."""
    plain = SensorModel.poisson_gaussian([[GAIN] * 4], [[READ] * 4], (BLACK,) * 4, WHITE, "RGGB")
    model = plain.with_mechanism("banding", amplitude_dn=2 * SIGMA, frequency=FREQUENCY)
    for seed in seeds:
        capture = capture_set(seed, waves, kinds="d", frames=6)
        found = compare_bank(capture, modelled(model, KEY), sets=2, alpha=0.01)
        (j,) = (j for j in found.judgements if (j.family, j.where) == (of(STATIC, STRUCTURE), "all dark"))
        assert np.abs(j.z).max() < j.passing


@pytest.mark.parametrize("lines", ["white", pytest.param("a wave", marks=pytest.mark.slow)])
def test_what_maps_share_by_chance_scatters_as_stated(lines):
    rng, at = np.random.default_rng(7), np.arange(128)

    def profile():
        wave = 3 * np.sin(0.9 * at + rng.uniform(0, 2 * np.pi))
        return (rng.standard_normal(128) if lines == "white" else wave)[:, None]

    def draw():
        maps = [profile() + rng.standard_normal((128, 48)) for _ in range(2)]
        return shared(*maps), shared_variance(*maps)

    values, stated = (np.array(v) for v in zip(*(draw() for _ in range(120)), strict=True))
    ratio = values.var(0) / stated.mean(0)
    # Of 120 draws a variance is known to 13 %. A frequency between two of the grid spreads over both.
    assert (ratio > 0.6).all() and (ratio < (2.5 if lines == "a wave" else 1.5)).all()
    assert lines == "white" or stated[:, 1].mean() > 20 / 128


@pytest.mark.parametrize("over", ["row", "raster"])
def test_a_wave_is_drawn_where_it_runs_and_at_its_own_frequency(over):
    """Along the rows alone, or on from the end of each to the start of the next: a fifth of a period apart at
    the other end of a row. The grid of frequencies has half a period in the frame."""
    rng = np.random.default_rng(9)
    cycles = 0.2031
    n = np.arange(96 * 128).reshape(96, 128)
    run = cycles / 128 * n if over == "raster" else cycles * (n // 128)

    def alter(rng):
        return lambda dn, *_: dn + 3 * np.sin(2 * np.pi * (run + rng.uniform()))

    capture = capture_set(int(rng.integers(9)), alter, kinds="d")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    signature = next(s for s in prepared.signatures if s.name == "wave_redrawn")
    score = signature.score(prepared.fields)
    assert score is not None
    weighted = [f.contrasts * f.weight.astype(np.float32) for f in prepared.fields]
    found = refined(weighted, score.payload[:2])
    place, told = carrier(*found, (96, 128))
    if over == "row":
        assert place == over and told["frequency"] == pytest.approx(cycles, abs=3e-4)
    else:
        assert place == "pixel" and told["frequency_y"] == pytest.approx(cycles, abs=3e-4)
        assert told["frequency_x"] == pytest.approx(cycles / 128, abs=3e-4)


def test_lone_values_of_few_codes_do_not_jump_with_the_scale():
    """Noise of 1.4 codes: a limit of so many standard deviations passes a code where these grow by a
    fiftieth, and of values that are not spread over their codes a third fewer then lie beyond it."""
    rng = np.random.default_rng(7)
    codes = np.round(rng.normal(0.0, 1.4, (12, 240, 240))).astype(np.float32)
    contrasts = np.tensordot(helmert(12).astype(np.float32), codes, 1)
    usable = np.ones(codes.shape[1:], bool)

    def counts(sigma: float, spread: bool) -> np.ndarray:
        z, one = contrasts / np.float32(sigma), np.ones(usable.shape, np.float32)
        return lone_values(z, one, usable, one / np.float32(sigma) if spread else None)[1].sum(0)

    def share(sigma: float) -> float:
        return norm.sf(JUMPS[1] * sigma / 1.43) - norm.sf(JUMPS[2] * sigma / 1.43)

    apart = {spread: counts(1.48, spread)[1] / counts(1.45, spread)[1] for spread in (False, True)}
    expected = share(1.48) / share(1.45)
    assert abs(np.log(apart[True] / expected)) < 0.1 < abs(np.log(apart[False] / expected))


def test_frames_that_do_not_follow_each_other_tell_no_memory():
    """Of a camera that is drawn as it is, every fourth frame is held back: they keep less of each other than
    frames that are drawn in a row."""
    capture = capture_set(8, remembering(0.9), kinds="d", frames=16)

    def in_a_row(key, clean, settings):
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
        change = remembering(0.9)(rng)
        dn = 200.0 + 4.5 * rng.standard_normal((settings.frames, *np.shape(clean)))
        return np.clip(np.round(np.stack([change(f, f, "dark", 0.0) for f in dn])), 0, 16383)

    chosen = ([], list(range(3, 16, 4))), ([], [0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14])
    apart, looking = (
        compare_bank(capture, in_a_row, KEY, sets=6, alpha=0.002, held_back=[c] * 2) for c in chosen
    )
    families = [{j.family for j in found.judgements} for found in (apart, looking)]
    assert not {NEXT_FRAME, NEXT_LINES} & families[0] and {NEXT_FRAME, NEXT_LINES} <= families[1]
    off = [np.abs(j.z).max() for j in looking.judgements if j.family == NEXT_LINES]
    assert max(off) < 4
