"""Pixels that answer to the light by another share: found where they are, and nothing else taken for them."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, prepare_split, split_recordings
from cannoise_jax.signatures.handed import Found
from tests.discovery.capture import SIZE, capture_set


def look_of(capture, name="other_response"):
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    return next(s for s in prepared.signatures if s.name == name), prepared.fields


def answering(share, sites):
    """Flats whose light some pixels miss a part of."""
    return lambda rng: lambda dn, signal, kind, t: dn + signal * np.where(sites, share, 0.0)


def grid(down=12, across=12):
    sites = np.zeros(SIZE, bool)
    sites[5::down, 3::across] = True
    return sites


@pytest.mark.parametrize("share", [-0.45, 0.2])
def test_they_are_found_with_their_share_and_taken_out(share):
    signature, fields = look_of(capture_set(2, answering(share, grid()), kinds="df"))
    score = signature.score(fields)
    assert score.log_p < -30 and score.where["pixels"] == grid().sum()
    value, _, error = score.parameters["share"]
    assert abs(value - share) < 5 * error
    assert score.amplitude == pytest.approx(abs(share) * np.sqrt(grid().mean()), rel=0.02)
    assert np.array_equal(score.payload != 0, grid())
    more = "more" if share > 0 else "less"
    assert f"{100 * grid().mean():.2g} % of the pixels respond differently" in signature.kind(score)
    assert f"{100 * abs(share):.2g} % {more}" in signature.kind(score)
    left = signature.score(signature.absorb(fields, score))
    assert left.log_p == 0 and left.amplitude == 0


@pytest.mark.parametrize(("down", "across"), [(4, 4), (8, 4), (16, 8)])
def test_grids_of_a_good_part_of_a_channel_are_found_whole(down, across):
    sites = grid(down, across)
    signature, fields = look_of(capture_set(2, answering(-0.45, sites), kinds="df"))
    found = signature.score(fields).payload != 0
    assert (found & sites).sum() > 0.98 * sites.sum() and (found & ~sites).sum() < 0.05 * sites.sum()


def test_a_grid_in_a_part_of_the_frame_is_found():
    sites = grid(6, 6)
    sites[:30] = sites[66:] = sites[:, :40] = sites[:, 90:] = False
    signature, fields = look_of(capture_set(2, answering(-0.45, sites), kinds="df"))
    assert np.array_equal(signature.score(fields).payload != 0, sites)


@pytest.mark.parametrize("seconds", [0.001, 0.0])
def test_hot_pixels_are_not_taken_for_them_where_no_dark_is_as_long_as_the_flats(seconds):
    """Of one lamp charge grows with the exposure as light does."""

    def alter(rng):
        heat = np.where(rng.random(SIZE) < 0.01, rng.exponential(3e5, SIZE), 0.0)
        return lambda dn, signal, kind, t: dn + heat * signal / 16183.0 * 0.02 if kind == "flat" else dn

    signature, fields = look_of(capture_set(4, alter, kinds="df"))
    short = tuple(f._replace(exposure_s=seconds) if f.kind == "dark" else f for f in fields)
    lit = tuple(f._replace(exposure_s=0.5) if f.kind == "flat" else f for f in short)
    assert signature.score(fields).where["pixels"] > 20
    assert signature.score(lit).where["pixels"] == 0


def test_what_is_added_to_a_camera_model_is_their_map():
    signature, fields = look_of(capture_set(2, answering(-0.4, grid()), kinds="df"))
    score = signature.score(fields)
    pattern = signature.pattern(fields, score, np.random.default_rng(0))
    found = Found("unknown", score, fields, pattern, 1.5, 3.0, 0.1, 0.1, 16183.0, SIZE)
    added = signature.place(found)
    (strength,) = added.values.values()
    shown = strength * np.asarray(added.maps["field"])[0]
    np.testing.assert_allclose(shown[grid()], -0.4, atol=0.02)
    assert not shown[~grid()].any()


def test_the_frames_held_back_show_the_same_pixels_or_none():
    capture = capture_set(3, answering(-0.3, grid()), kinds="df", frames=8)
    parted = split_recordings(capture)
    first, second = prepare_split(capture, parted), prepare_split(capture, parted, held_back=True)
    signature = next(s for s in first.signatures if s.name == "other_response")
    found = signature.score(first.fields)
    again = signature.score_again(second.fields, found)
    assert again.amplitude == pytest.approx(found.amplitude, rel=0.02) and again.gain > 1000
    elsewhere = found.replace(payload=np.roll(found.payload, 5, 1))
    assert signature.score_again(second.fields, elsewhere).gain < 30


def map_of_sensitivities(rng):
    pattern = 0.02 * rng.laplace(size=SIZE) / np.sqrt(2)  # longer tails than a normal map
    return lambda dn, signal, kind, t: dn + signal * pattern


def hits(rng):
    """Of up to all of the light, in single frames."""

    def change(dn, signal, kind, t):
        at = rng.random(SIZE) < 1e-3
        return dn + at * rng.exponential(6000.0, SIZE)

    return change


def hot(rng):
    heat = np.where(rng.random(SIZE) < 0.01, rng.exponential(800.0, SIZE), 0.0)
    return lambda dn, signal, kind, t: dn + heat


def shadows(rng):
    y, x = np.indices(SIZE)
    dark = sum(np.hypot(y - a, x - b) < 4 for a, b in rng.uniform(10, 80, (4, 2)))
    return lambda dn, signal, kind, t: dn - 0.2 * signal * dark


def dead(rng):
    sites = rng.random(SIZE) < 0.003
    return lambda dn, signal, kind, t: dn - signal * sites


def vignetted(rng):
    y, x = np.indices(SIZE)
    fall = 1 - 0.5 * (np.hypot(y - 48, x - 64) / 80) ** 2
    return lambda dn, signal, kind, t: dn - signal * (1 - fall)


@pytest.mark.parametrize("other", [None, map_of_sensitivities, hits, hot, shadows, dead, vignetted])
def test_nothing_else_is_taken_for_them(other):
    signature, fields = look_of(capture_set(4, other, kinds="df"))
    score = signature.score(fields)
    assert score.log_p > np.log(1e-3) or score.where["pixels"] == 0


def test_flats_of_a_few_electrons_have_none():
    for seed in range(8):
        signature, fields = look_of(capture_set(seed, gain=60.0, read=1.0, kinds="df"))
        assert signature.score(fields).where["pixels"] == 0


def test_half_covered_pixels_are_not_dead():
    signature, fields = look_of(capture_set(2, answering(-0.6, grid()), kinds="df"), "dead")
    assert signature.score(fields).where["pixels"] == 0
