"""How pixels and lines move from frame to frame: a name that says how is held to it."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.compare.families import STATIC, STRUCTURE, of
from cannoise_jax.discovery.compare.measure import shared, shared_variance
from cannoise_jax.discovery.compare.moves import JUMPS, LEVEL_CHANCES, lines_after, lone_values, two_levels
from cannoise_jax.discovery.compare.run import compare_bank
from cannoise_jax.discovery.compare.sources import modelled
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.adequacy import doubt
from cannoise_jax.discovery.proof.check import frames_for_names
from cannoise_jax.discovery.proof.claims import by_level, forgetful, lasting
from cannoise_jax.discovery.proof.claims import two_levels as more_levels
from cannoise_jax.discovery.proof.own_part import borne_by
from cannoise_jax.discovery.search.fit import Step
from cannoise_jax.discovery.search.name import Named
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.signatures.carriers import carrier, refined
from cannoise_jax.signatures.fields import helmert
from tests.discovery.capture import capture_set, row_offsets

KEY = jax.random.key(5)
GAIN, READ, BLACK, WHITE, SIGMA, JUMP = 1.5, 3.0, 200.0, 16383.0, 1.5, 27.0


def drawn(alter, name, **values):
    """Darks that were altered against a simulator with a mechanism of these strengths, and without."""
    capture = capture_set(8, alter, kinds="d", read=READ, frames=10)
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


@pytest.mark.parametrize(("alter", "doubted"), [(remembering(0.8), True), (row_offsets(SIGMA), False)])
def test_rows_that_remember_the_frame_before_are_no_row_noise(alter, doubted):
    full, less = drawn(alter, "row_noise", sigma_dn=SIGMA)
    found = forgetful(full, borne_by(full, less))
    assert (found is not None) == doubted
    if found is not None:
        assert any("remember" in line for line in found.against)


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


def test_how_many_pixels_jump_says_nothing_of_their_levels():
    """Twice as many in the simulator, or half: pixels of two levels stay such."""
    for fraction in (0.005, 0.02):
        assert two_levels_enough(jumping(2), fraction) is None
        assert two_levels_enough(jumping(3), fraction) is not None


@pytest.mark.parametrize("stays", ["in all recordings", "in each by itself"])
def test_rows_that_differ_from_recording_to_recording_are_no_fixed_pattern(stays):
    """Means of rows of equal variance in every recording, the same ones or others."""
    rng = np.random.default_rng(8)
    rows = rng.standard_normal((96, 1))
    own: dict[tuple, np.ndarray] = {}

    def alter(rng):
        def change(dn, signal, kind, t):
            new = rows if stays == "in all recordings" else rng.standard_normal((96, 1))
            return dn + 0.5 * SIGMA * own.setdefault((t, float(signal.mean())), new)

        return change

    capture = capture_set(3, alter, kinds="df", frames=6)
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    signature = next(s for s in prepared.signatures if s.name == "row_additive_static")
    score = signature.score(prepared.fields)
    assert score is not None and score.log_p < -20
    named = Named(score, signature, "row_fpn", (("row_fpn", 1.0),), False)
    found = lasting(Step(named, prepared.fields, score.log_p))
    assert (found is None) == (stays == "in all recordings")
    if found is not None:
        assert found.left > 0.6 and "in common" in found.against[0]


@pytest.mark.parametrize("flats", ["as the darks", "of their own"])
def test_columns_that_darks_share_and_flats_have_not_are_no_fixed_pattern(flats):
    """Darks of one level cannot tell offsets of columns from errors of their converters, which are another
    one's at another level."""
    rng = np.random.default_rng(9)
    own = {"dark": rng.standard_normal((1, 128))}

    def alter(rng):
        def change(dn, signal, kind, t):
            kind = "dark" if flats == "as the darks" else f"{kind} {signal.mean():.0f}"
            kind = "dark" if kind.startswith("dark") else kind
            return dn + SIGMA * own.setdefault(kind, rng.standard_normal((1, 128)))

        return change

    step = named_map(capture_set(3, alter, kinds="df", frames=6), "column_additive_static", "column_fpn")
    found = lasting(step)
    assert step.log_p < -20 and (found is None) == (flats == "as the darks")
    if found is not None:
        assert found.left > 0.6 and "darks and flats" in found.against[0]


def named_map(capture, name, mechanism):
    """A finding of one signature in all frames, under a name."""
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    signature = next(s for s in prepared.signatures if s.name == name)
    score = signature.score(prepared.fields)
    assert score is not None
    return Step(Named(score, signature, mechanism, ((mechanism, 1.0),), False), prepared.fields, score.log_p)


def test_what_rare_values_of_one_sign_lift_all_pixels_by_is_no_map():
    """The mean of a recording is that of most values: the few lift the means of pixels above it, everywhere
    and always, so that all recordings have that in common."""

    def lifted(rng):
        return lambda dn, signal, kind, t: dn + 100 * (rng.random(dn.shape) < 0.003)

    step = named_map(capture_set(3, lifted, kinds="df", frames=6), "pixel_additive_static", "dsnu")
    assert step.log_p < -5
    found = lasting(step)
    assert found is not None and "in common" in found.against[0]


def remembered_pixels(rng):
    """Noise of pixels of which half is that of the frame before, in one long dark."""
    last = rng.standard_normal((96, 128))

    def alter(dn, signal, kind, t):
        nonlocal last
        if kind == "dark" and t > 0.05:
            last = 0.6 * last + 0.8 * rng.standard_normal(dn.shape)
            dn = dn + 3 * last
        return dn

    return alter


def thermal_pixels(rng):
    """Pixels of unlike dark current, of exponential law."""
    rate = 10 * np.random.default_rng(2).exponential(1.0, (96, 128))
    return lambda dn, signal, kind, t: dn + rate * t / 0.1 * (kind == "dark")


@pytest.mark.parametrize(("alter", "stays"), [(thermal_pixels, True), (remembered_pixels, False)])
def test_what_grows_with_the_exposure_grows_in_every_recording(alter, stays):
    capture = capture_set(6, alter, kinds="df", frames=6)
    # Another one of the longer exposure, so that two recordings tell.
    more = capture_set(7, alter, kinds="d", frames=6).recordings[1]
    again = dataclasses.replace(more, path="9_dark.h5")
    capture = dataclasses.replace(capture, recordings=(*capture.recordings, again))
    found = lasting(named_map(capture, "pixel_thermal_static", "dsnu"))
    assert (found is None) == stays


@pytest.mark.parametrize("strength", [0.12, 0.3, 1.0])
def test_maps_that_stay_keep_their_name(strength):
    """Ten draws each, from just seen to as strong as the noise: none is doubted."""
    for seed in range(10):
        fixed = strength * 4.5 * np.random.default_rng(seed).standard_normal((96, 128))

        def alter(rng, fixed=fixed):
            return lambda dn, signal, kind, t: dn + fixed

        capture = capture_set(seed, alter, kinds="d", frames=5)
        assert lasting(named_map(capture, "pixel_additive_static", "dsnu")) is None


def wavy(rng):
    """A converter whose codes are off by a wave over the signal."""
    return lambda dn, signal, kind, t: dn + 12 * np.sin(2 * np.pi * (dn - 200) / 700) * (kind == "scene")


def wrong_light(rng):
    """References whose pixels are wrong, each by itself."""
    own: dict[float, np.ndarray] = {}

    def alter(dn, signal, kind, t):
        if kind != "scene":
            return dn
        return dn + own.setdefault(float(signal.mean()), 12 * rng.standard_normal(dn.shape))

    return alter


@pytest.mark.parametrize(("alter", "of_places"), [(wrong_light, True), (wavy, False)])
def test_what_follows_the_signal_is_no_error_of_single_pixels_of_a_reference(alter, of_places):
    step = named_map(capture_set(5, alter), "scene_static", "reference_error")
    assert step.log_p < -20
    found = by_level(step)
    assert (found is None) == of_places
    if found is not None:
        assert found.left > 0.5 and "signal" in found.against[0]


def test_darks_say_nothing_of_sensitivities():
    """One flat, and darks whose level grows, more in pixels that are less sensitive."""
    rng = np.random.default_rng(9)
    shape = rng.standard_normal((96, 128))
    gains, offsets = 0.01 * shape, SIGMA * (8 - 2 * shape)

    def alter(rng):
        return lambda dn, signal, kind, t: dn + gains * signal + offsets * t / 0.1 * (kind == "dark")

    capture = capture_set(4, alter, kinds="df", frames=6, size=(96, 128))
    capture = dataclasses.replace(capture, recordings=(*capture.recordings[:2], capture.recordings[-1]))
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    signature = next(s for s in prepared.signatures if s.name == "pixel_relative_static")
    score = signature.score(prepared.fields)
    assert score is not None and score.log_p < -20
    named = Named(score, signature, "prnu", (("prnu", 1.0),), False)
    assert lasting(Step(named, prepared.fields, score.log_p)) is None


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


def test_what_a_redrawn_wave_leaves_in_a_mean_of_few_frames_is_no_fixed_pattern():
    """One frequency at random phases: its mean over the frames is as large or small as these happen to add
    up to. Of ten cameras none has rows that stay."""
    plain = SensorModel.poisson_gaussian([[GAIN] * 4], [[READ] * 4], (BLACK,) * 4, WHITE, "RGGB")
    model = plain.with_mechanism("banding", amplitude_dn=2 * SIGMA, frequency=FREQUENCY)
    for seed in range(10):
        capture = capture_set(seed, waves, kinds="d", frames=6)
        found = compare_bank(capture, modelled(model, KEY), sets=2, alpha=0.01)
        (j,) = (j for j in found.judgements if (j.family, j.where) == (of(STATIC, STRUCTURE), "all dark"))
        assert np.abs(j.z).max() < j.passing


@pytest.mark.parametrize("lines", ["white", "a wave"])
def test_what_maps_share_by_chance_scatters_as_stated(lines):
    rng, at = np.random.default_rng(7), np.arange(128)

    def profile():
        wave = 3 * np.sin(0.9 * at + rng.uniform(0, 2 * np.pi))
        return (rng.standard_normal(128) if lines == "white" else wave)[:, None]

    def draw():
        maps = [profile() + rng.standard_normal((128, 48)) for _ in range(2)]
        return shared(*maps), shared_variance(*maps)

    values, stated = (np.array(v) for v in zip(*(draw() for _ in range(300)), strict=True))
    ratio = values.var(0) / stated.mean(0)
    # A frequency between two of the grid spreads over both.
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
    place, frequency = carrier(*found, (96, 128))
    assert place == over
    assert frequency * (128 if over == "raster" else 1) == pytest.approx(cycles, abs=3e-4)
