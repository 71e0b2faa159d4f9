"""Glow: strength whatever its place and reach, on the frames that looked and on others; no dark current."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.signatures.dark_noise import excess_score
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.glow import from_edges, glow_absorb, glow_again, glow_score
from cannoise_jax.signatures.handed import Found
from cannoise_jax.signatures.levels import dark_levels, dark_rise
from tests.discovery.capture import capture_set

SIZE = (96, 128)


def fall(place, reach: float) -> np.ndarray:
    y, x = np.indices(SIZE)
    distance = np.hypot(y - place[0] * SIZE[0], x - place[1] * SIZE[1])
    g = np.exp(-distance / (reach * max(SIZE)))
    return g / np.sqrt(np.mean(g**2))


def darks(rng, signal: np.ndarray, frames: int) -> tuple[Fields, ...]:
    """A short dark and a long one of unit noise that hold the signal at the longer exposure."""
    out = []
    for n, (seconds, share) in enumerate(((0.01, 0.001), (10.0, 1.0))):
        seen = signal * share + rng.standard_normal(SIZE) / np.sqrt(frames)
        level = np.zeros(SIZE)
        for site in np.ndindex(2, 2):
            own = (slice(site[0], None, 2), slice(site[1], None, 2))
            level[own] = seen[own].mean()
        one = np.ones(SIZE, np.float32)
        static = (np.sqrt(frames) * (seen - level)).astype(np.float32)
        out.append(
            Fields(
                "d", "dark", frames, n, 0, seconds, 1.0, level.astype(np.float32), 0 * one, one, 0 * one,
                one > 0, np.zeros((0, *SIZE), np.float32), static, None, np.ones(4), np.zeros(4),
            )
        )  # fmt: skip
    return tuple(out)


@pytest.mark.parametrize(
    ("place", "reach"),
    [
        pytest.param((0, 1), 0.13, marks=pytest.mark.slow),
        pytest.param((1, 1), 0.22, marks=pytest.mark.slow),
        ((0, 0), 0.3),
    ],
)
def test_strength_covers_the_truth_on_frames_that_looked_and_on_others(place, reach):
    rng = np.random.default_rng(1)
    truth, looked, again = 0.09, [], []
    for _ in range(60):
        first, second = (darks(rng, truth * fall(place, reach), n) for n in (6, 2))
        score = glow_score(first)
        assert score is not None
        other = glow_again(score, second)
        assert other is not None
        looked.append((score.amplitude - truth) / score.error)
        again.append((other.amplitude - truth) / other.error)
    for errors in (looked, again):
        assert abs(np.mean(errors)) < 0.6
        assert 0.75 < np.mean(np.abs(errors) < 1.645) < 0.99


def test_what_other_frames_know_of_a_glow_is_theirs():
    """Not what those that found it knew, which of more frames is more."""
    rng = np.random.default_rng(7)
    signal = 40 * fall((0, 1), 0.2)
    score = glow_score(darks(rng, signal, 12))
    other = glow_again(score, darks(rng, signal, 3))
    assert score.payload.formed
    assert other.shift == pytest.approx(2 * score.shift, rel=0.2)
    assert other.amplitude == pytest.approx(score.amplitude, abs=4 * other.error)


def test_glow_of_uncertain_reach_leaves_no_level_for_a_dark_current():
    rng = np.random.default_rng(2)
    signal = 0.08 * fall((1, 0), 0.27)
    for _ in range(20):
        fields = darks(rng, signal, 6)
        score = glow_score(fields)
        left = glow_absorb(fields, score)
        (_, _, _), (_, level, error) = dark_levels(left)
        assert abs(level.mean()) < 4 * error / 2


def test_dark_current_beside_a_glow_is_left_to_be_found():
    rng = np.random.default_rng(3)
    fields = darks(rng, 0.3 * fall((1, 0), 0.2) + 0.5, 6)
    left = glow_absorb(fields, glow_score(fields))
    assert dark_levels(left)[1][1].mean() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("form", ["gauss", "two corners", "plateau"])
def test_a_strong_glow_is_taken_out_whatever_its_form(form):
    rng = np.random.default_rng(4)
    y, x = np.indices(SIZE) / max(SIZE)
    glow = {
        "gauss": np.exp(-((np.hypot(y, x) / 0.3) ** 2)),
        "two corners": np.exp(-np.hypot(y, x) / 0.1) + 0.6 * np.exp(-np.hypot(y, 1 - x) / 0.21),
        "plateau": 1 / (1 + (np.hypot(y, x) / 0.25) ** 4),
    }[form]
    first = darks(rng, 20 * glow, 6)
    score = glow_score(first)
    assert score is not None
    left = glow_absorb(first, score)[1].static
    before = first[1].static
    assert left is not None and before is not None
    # Of forms that are no sum of a few falls too.
    smooth = [ndimage.uniform_filter(s, 8) for s in (before, left)]
    assert np.std(smooth[1]) < 0.08 * np.std(smooth[0])
    assert abs(float(left.mean())) < 0.05


def test_the_noise_of_a_strong_glow_is_no_noise_of_some_pixels():
    size, reach = (96, 128), 20.0
    y, x = np.indices(size)
    glow = 400 * np.exp(-np.hypot(y, x) / reach)
    capture = capture_set(
        7, lambda r: lambda dn, signal, kind, t: dn + 1.5 * r.poisson(glow * t / 0.1, size), kinds="d"
    )
    fields = prepare(capture, all_frames(split_recordings(capture)), False).fields
    score = glow_score(fields)
    assert score is not None
    corner = np.hypot(y, x) < reach
    for f, told in zip((fields[1], glow_absorb(fields, score)[1]), (False, True), strict=True):
        ratio = np.mean(f.contrasts[:, corner] ** 2) / np.mean(f.contrasts[:, ~corner] ** 2)
        assert (abs(ratio - 1) < 0.1) == told


def test_a_glow_of_its_own_form_leaves_no_lines_and_no_level():
    """An oval that belongs to no corner, over a dark current: what is left is noise, and the dark current."""
    rng = np.random.default_rng(7)
    y, x = np.indices(SIZE)
    oval = np.exp(-np.hypot((y - SIZE[0]) / 20, (x - 0.8 * SIZE[1]) / 36))
    signal = 40 * oval + 2.0
    fields = darks(rng, signal, 6)
    score = glow_score(fields)
    assert score.payload.stands_out
    assert score.amplitude == pytest.approx(40 * np.sqrt(np.mean(oval**2)), rel=0.05)
    left = glow_absorb(fields, score)
    (_, _, _), (_, level, _) = dark_levels(left)
    assert level.mean() == pytest.approx(2.0, abs=0.5)
    assert np.std(left[1].static) == pytest.approx(1, abs=0.1)


def test_hot_pixels_beside_a_glow_take_no_dark_current_from_the_others():
    """Nor does what the glow adds to the noise count as a dark current that was taken from the level."""
    size, rng, seconds = (96, 128), np.random.default_rng(8), 0.1
    y, x = np.indices(size)
    glow = 120 * np.exp(-np.hypot(y, x) / 24.0)
    hot = np.where(rng.random(size) < 0.004, 60 * rng.exponential(20.0, size), 0.0)
    capture = capture_set(
        9,
        lambda r: lambda dn, signal, kind, t: dn + 1.5 * r.poisson((60 + glow + hot) * t / seconds, size),
        kinds="df",
    )
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    fields = prepared.fields
    score = glow_score(fields)
    assert score is not None and score.payload.formed
    left = glow_absorb(fields, score)
    charge = dark_rise(dark_levels(left))[0] * seconds / 1.5
    assert charge == pytest.approx(60, rel=0.08)
    hidden = excess_score(left)
    assert hidden is not None
    assert hidden.amplitude * seconds < 3 * hidden.error * seconds + 2


def test_a_glow_of_its_own_form_is_as_bright_in_the_four_sites():
    y, x = np.indices(SIZE)
    signal = 1000 / (1 + (np.hypot(y - 1.03 * SIZE[0], x - 0.2 * SIZE[1]) / 28) ** 2) ** 1.5
    for seed in range(3):
        score = glow_score(darks(np.random.default_rng(seed), signal, 6))
        assert score is not None and score.payload.stands_out
        off = score.payload.template * score.amplitude - signal
        sites = [np.mean(off[r::2, c::2]) for r in (0, 1) for c in (0, 1)]
        assert np.ptp(sites) < 0.6


def test_a_strong_glow_is_drawn_as_it_was_recorded_at_every_site():
    """Gains of the sites that differ by their errors draw no lines through it."""
    signature = from_edges(name="glow", parameter="e_per_s", covers=(), before=(), lifted_by=())
    signal = 400 * np.exp(-np.hypot(*np.indices(SIZE)) / 30.0)
    gain = np.array([2.0, 2.03, 1.99, 1.98])
    fields = tuple(f._replace(gain=gain) for f in darks(np.random.default_rng(3), signal, 6))
    score = glow_score(fields)
    assert score is not None and score.payload.stands_out
    pattern = signature.pattern(fields, score, np.random.default_rng(0))
    found = Found("amp_glow", score, fields, pattern, float(gain.mean()), 1.0, 10.0, 10.0, 1e4, SIZE)
    added = signature.simulate(found)
    rate = added.values["e_per_s"] * np.asarray(added.maps["glow"])[0]
    drawn = rate * gain[channel_index(SIZE)] * found.seconds
    np.testing.assert_allclose(drawn, score.amplitude * pattern, rtol=1e-4, atol=1e-3)
