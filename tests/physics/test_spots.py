"""Stars that move over flats are found and taken out; what fills the frame, or stays, is left alone."""

import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, transfer_at
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, BLACK, GAIN, READ, LIGHT = (120, 160), 500.0, 0.8, 4.5, 18000.0
ROWS, COLUMNS = np.mgrid[: SIZE[0], : SIZE[1]]


def star(row, column, width=1.8):
    return np.exp(-((ROWS - row) ** 2 + (COLUMNS - column) ** 2) / (2 * width**2))


def stars(height, number, move=(2.0, 3.0), seed=9):
    """Light of so many stars in frame t, up to twice as high or half, electrons."""
    rng = np.random.default_rng(seed)
    placed = [(rng.uniform(8, 100), rng.uniform(8, 130), height * rng.uniform(0.5, 2)) for _ in range(number)]
    return lambda t: sum(h * star(y + move[0] * t, x + move[1] * t) for y, x, h in placed)


def flat(more=lambda t: 0.0, count=9, seed=1, light=lambda t: 1.0, cfa="MONO", prnu=0.006, noise=None):
    """Vignetted frames. more: light of frame t beside the even one, electrons; noise(rng, electrons)."""
    rng = np.random.default_rng(seed)
    even = 1 - 0.3 * ((ROWS - 60) ** 2 + (COLUMNS - 80) ** 2) / (60**2 + 80**2)
    sensitive, taken = 1 + prnu * rng.standard_normal(SIZE), []
    for t in range(count):
        e = rng.poisson((LIGHT * even * light(t) + more(t)) * sensitive).astype(float)
        e = e if noise is None else noise(rng, e)
        taken.append(BLACK + GAIN * (e + READ * rng.standard_normal(SIZE)))
    codes = np.rint(np.stack(taken)).astype(np.uint16)
    return Recording(codes, cfa, (BLACK,) * 4, 65535.0, "made", "flat", exposure_s=2.0, path="f.h5")


def dark():
    rng = np.random.default_rng(3)
    codes = np.rint(BLACK + GAIN * READ * rng.standard_normal((8, *SIZE))).astype(np.uint16)
    return Recording(codes, "MONO", (BLACK,) * 4, 65535.0, "made", "bias", exposure_s=0.0)


@pytest.mark.parametrize(("height", "number"), [pytest.param(3000.0, 5, marks=pytest.mark.slow), (500.0, 3)])
def test_stars_leave_gain_and_neighbours_alone(height, number):
    capture = CaptureSet("made", (flat(stars(height, number)), dark()))
    (transfer,), findings = calibrate(capture)
    gain = np.mean([o.value for o in transfer.outcomes("system gain")])
    assert gain == pytest.approx(GAIN, rel=0.015)
    (given,) = (f for f in findings if f.mechanism == "crosstalk")
    assert given.verdict == "not significant"
    table = {q.name: q.outcome for q in of_all_pixels(transfer).quantities}
    assert table["PRNU1288"].value == pytest.approx(0.6, rel=0.05)


def test_a_star_is_replaced_and_its_neighbourhood_is_kept():
    drawn = stars(3000.0, 4)
    with_stars, without = flat(drawn), flat()
    s = frame_statistics(with_stars)
    assert s.spots is not None and 0.02 < s.spots.mean() < 0.2 and (s.clipped >= s.spots).all()
    cleaned = np.asarray(s.recording.frames[:], float)
    bright = np.stack([drawn(t) > 800 for t in range(with_stars.count)])
    noise = np.sqrt(2 * LIGHT) * GAIN / np.sqrt(bright.sum())
    left = (cleaned - np.asarray(without.frames, float))[bright]
    assert np.mean(left) == pytest.approx(0, abs=3 * noise)
    kept = ~s.spots
    np.testing.assert_array_equal(cleaned[:, kept], with_stars.frames[:, kept])


def jumping(rng, e):
    return np.where(np.random.default_rng(5).random(SIZE) < 0.01, e + 3000 * (rng.random(SIZE) < 0.5), e)


def shared(rng, e):
    """A tenth of the charge given to the neighbours."""
    beside = sum(np.roll(e, shift, axis) for axis in (0, 1) for shift in (-1, 1))
    return 0.9 * e + 0.025 * beside


NULL = {
    "even light": {},
    "colours": {"cfa": "RGGB"},
    "lamp that drifts": {"light": lambda t: 0.95**t},
    "light that leans": {"more": lambda t: 300 * t * (COLUMNS / 160 - 0.5)},
    "strong pattern": {"prnu": 0.03},
    "pixels that jump": {"noise": jumping},
    "crosstalk": {"noise": shared},
    "noise of rows": {"noise": lambda rng, e: e + 60 * rng.standard_normal((SIZE[0], 1))},
    "noise of columns": {"noise": lambda rng, e: e + 60 * rng.standard_normal(SIZE[1])},
    "star that stays": {"more": stars(3000.0, 4, move=(0.0, 0.0))},
    "two frames": {"count": 2},
}


@pytest.mark.parametrize("name", NULL)
def test_without_spots_nothing_is_taken_out(name):
    for seed in range(3):
        assert frame_statistics(flat(seed=seed, **NULL[name])).spots is None


def test_a_scene_that_moves_is_no_spot():
    """A third of the frame moves."""
    moving = lambda t: 6000.0 * ((COLUMNS + 7 * t) % 40 < 14)  # noqa: E731
    assert frame_statistics(flat(moving)).spots is None


def test_spots_are_said():
    from cannoise_jax.physics.transfer.faults import faults

    said = faults([frame_statistics(r) for r in (flat(stars(3000.0, 4)), dark())]).spots
    assert said.startswith("f.h5: spots of light move") and "\n" not in said
    assert not faults([frame_statistics(r) for r in (flat(), dark())]).spots


def test_photon_transfer_of_all_flats_holds_beside_stars():
    recordings = [flat(stars(2000.0, 4)), flat(light=lambda t: 0.4, seed=2), dark()]
    found = transfer_at([frame_statistics(r) for r in recordings])
    assert np.mean([o.value for o in found.outcomes("system gain")]) == pytest.approx(GAIN, rel=0.015)
