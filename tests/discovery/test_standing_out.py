"""Pixels that stand out are taken out before what they imprint on, and stay in the list beside it."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.signatures.events import spike_score
from tests.discovery.capture import SIZE, capture_set
from tests.discovery.test_model import found

LONG_S = 0.05
"""Exposures beyond it show charge that grows."""


def struck(rng):
    """Hits of single frames of long darks, each of three pixels in a line, among hot pixels and rows."""
    heat = np.where(rng.random(SIZE) < 0.004, rng.exponential(60.0, SIZE), 0.0)

    def change(dn, signal, kind, t):
        dn = dn + 1.5 * rng.poisson(heat * (t > LONG_S)) + 1.0 * rng.standard_normal((SIZE[0], 1))
        if t > LONG_S:
            for y, x in rng.integers(0, [SIZE[0], SIZE[1] - 3], (8, 2)):
                dn[y, x : x + 3] += rng.uniform(300, 1500)
        return dn

    return change


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_hits_are_not_taken_for_hot_pixels(seed):
    names = [s.named.mechanism for s in found(capture_set(seed, struck, kinds="df"))[1]]
    assert {"cosmic_rays", "hot_pixels", "row_noise"} == set(names)


def bombarded(rng):
    """Tracks of three to nine pixels in long darks, so many that pixels are hit in several frames, beside
    offsets of pixels with a tail."""
    offsets = 2.5 * (rng.gamma(2.0, 1.0, SIZE) - 2.0)

    def change(dn, signal, kind, t):
        dn = dn + offsets
        if t > LONG_S:
            for y, x in rng.integers(0, [SIZE[0], SIZE[1] - 9], (60, 2)):
                long = rng.integers(3, 10)
                dn[y, x : x + long] += rng.exponential(400.0) * np.linspace(1.0, 0.02, long)
        return dn

    return change


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_pixels_that_are_hit_twice_are_not_hot(seed):
    names = [s.named.mechanism for s in found(capture_set(seed, bombarded, kinds="df", frames=12))[1]]
    assert {"cosmic_rays", "dsnu"} <= set(names) and "hot_pixels" not in names


def column_of_heat(rng):
    """A column of which most pixels are hot."""
    heat = np.zeros(SIZE)
    heat[20:, 57] = rng.uniform(200, 500, SIZE[0] - 20)
    return lambda dn, signal, kind, t: dn + 1.5 * rng.poisson(heat * (t > LONG_S))


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_hot_column_is_of_hot_pixels_and_no_pattern_of_columns(seed):
    steps = found(capture_set(seed, column_of_heat, kinds="df"))[1]
    assert [s.named.mechanism for s in steps] == ["hot_pixels"]
    assert steps[0].named.score.where["pixels"] == pytest.approx(SIZE[0] - 20, abs=3)


def warm_and_glowing(rng):
    """A dark current that all pixels have, and light of the readout from a corner."""
    y, x = np.indices(SIZE)
    charge = 30.0 + 40.0 * np.exp(-np.hypot(y, x) / 25.0)
    return lambda dn, signal, kind, t: dn + 1.5 * rng.poisson(charge * t / 0.1, SIZE)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_dark_current_is_what_a_glow_leaves_of_the_level(seed):
    steps = found(capture_set(seed, warm_and_glowing, kinds="df"))[1]
    strength = {s.named.mechanism: s.named.score.amplitude for s in steps}
    assert strength["dark_current"] == pytest.approx(300.0, rel=0.05)
    assert "amp_glow" in strength


@pytest.mark.slow
def test_hits_of_the_frames_before_are_out_of_those_held_back():
    """What was hit before lies far from its mean in all frames that are seen against it. One hit that is left
    in one of the sets would be noise of its row."""
    rows = []
    for seed in range(1, 4):
        capture = capture_set(seed, struck, kinds="df")
        splits = split_recordings(capture)
        looks, held = (prepare_split(capture, splits, held_back=back) for back in (False, True))
        hits = next(s for s in looks.signatures if s.name == "hits")
        left = hits.absorb(held.fields, hits.score(looks.fields))

        def far(fields):
            return sum(int(np.sum(np.abs(f.contrasts).max(0) > 8)) for f in fields if not f.lit)

        # Shot noise of the hottest pixels lies as far.
        assert far(held.fields) > 100 and far(left) < 0.05 * far(held.fields)
        rows.append(next(s for s in held.signatures if s.name == "row_additive_temporal").score(left))
    typical = float(np.median([r.amplitude for r in rows]))
    assert typical == pytest.approx(1.0, abs=3 * max(r.error for r in rows))


@pytest.mark.parametrize(("number", "frames"), [(8, 12), (40, 12)])
def test_rate_and_charge_of_hits_are_those_of_whole_tracks(number, frames):
    """Ends of tracks are faint, and many pixels are hit in several frames."""
    fallen = []

    def alter(rng):
        def change(dn, signal, kind, t):
            dn = np.array(dn)
            for y, x in rng.integers(0, [SIZE[0], SIZE[1] - 9], (number if t > LONG_S else 0, 2)):
                long = rng.integers(3, 10)
                track = rng.exponential(400.0) * np.linspace(1.0, 0.02, long)
                dn[y, x : x + long] += track
                fallen.append(track.sum() / 1.5)
            return dn

        return change

    capture = capture_set(3, alter, kinds="d", frames=frames)
    score = spike_score(prepare_split(capture, split_recordings(capture)).fields, kind="hits")
    assert score is not None
    charge = score.parameters["charge_e"][0]
    rate = number / (0.11 * SIZE[0] * SIZE[1] / 1e6)
    assert score.amplitude * charge == pytest.approx(rate * np.mean(fallen), rel=0.15)
    assert score.amplitude == pytest.approx(rate, rel=0.25)


@pytest.mark.parametrize(("share", "most"), [(0.0, 1.1), (0.01, 1.8)])
def test_pixels_that_jump_in_two_recordings_are_no_particles(share, most):
    """Those that jump in one alone cannot be told from them."""

    def alter(rng):
        jumps = rng.random(SIZE) < share

        def change(dn, signal, kind, t):
            dn = dn + 60.0 * (jumps & (rng.random(SIZE) < 0.04))
            for y, x in rng.integers(0, [SIZE[0], SIZE[1] - 5], (8 if t > LONG_S else 0, 2)):
                dn[y, x : x + 5] += 300.0
            return dn

        return change

    capture = capture_set(4, alter, kinds="d", frames=12)
    score = spike_score(prepare_split(capture, split_recordings(capture)).fields, kind="hits")
    assert score is not None
    assert 0.9 < score.amplitude / (8 / (0.11 * SIZE[0] * SIZE[1] / 1e6)) < most
