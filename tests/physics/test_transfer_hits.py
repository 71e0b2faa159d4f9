"""Particle hits are taken out of darks and counted; hot, noisy and telegraph pixels are not taken for them,
nor they, or hot pixels, for telegraph pixels."""

import dataclasses

import numpy as np
import pytest

from cannoise_jax.mechanisms.coverage import assumed_baseline
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.estimators import maps, noise, particles, telegraph
from cannoise_jax.physics.transfer.estimators.neighbours import in_camera_denoising
from cannoise_jax.physics.transfer.estimators.spectra import pink_noise
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.hits import without_hits
from cannoise_jax.recordings.recording import Recording

SIZE = (96, 128)


def dark(seed, count=8, gain=0.8, read=4.0, charge=0.0, per_frame=0, reach=10, jumps=0.0, tails=0, step=1):
    """A dark of black 200 with tracks of hits, hot or telegraph pixels: charge, e- a frame, of every pixel;
    tails: degrees of freedom of Student's t; and the charge of every hit, DN."""
    rng = np.random.default_rng(seed)
    sigma = rng.standard_t(tails, (count, *SIZE)) if tails else rng.standard_normal((count, *SIZE))
    e = rng.poisson(charge, (count, *SIZE)) + read * sigma
    e += jumps / 2 * (rng.random(SIZE) < 0.02) * np.sign(rng.standard_normal((count, *SIZE)))
    charges = []
    for frame in e:
        for _ in range(per_frame):
            y, x, angle = rng.integers(SIZE[0]), rng.integers(SIZE[1]), rng.uniform(0, 2 * np.pi)
            track = 500 + rng.exponential(1500)
            length = rng.integers(1, reach + 1)
            for k in range(length):
                row, column = int(y + k * np.sin(angle)), int(x + k * np.cos(angle))
                if 0 <= row < SIZE[0] and 0 <= column < SIZE[1]:
                    frame[row, column] += track / length
            charges.append(gain * track)
    frames = np.clip(np.rint((200 + gain * e) / step) * step, 0, 65535).astype(np.uint16)
    own = Recording(frames, "MONO", (200,) * 4, 65535.0, kind="dark", path="dark.h5", exposure_s=60.0)
    return own, np.array(charges)


def baseline(gain, read):
    same = np.ones(4)
    return dataclasses.replace(assumed_baseline(), gain=gain * same, read_noise=gain * read * same)


@pytest.mark.parametrize(
    ("count", "gain", "per_frame"), [(3, 0.8, 3), (8, 3.0, 5), (16, 0.2, 2), (8, 0.8, 10)]
)
def test_hits_are_taken_out_and_noise_stays(count, gain, per_frame):
    own, charges = dark(1, count, gain, per_frame=per_frame)
    clean, hits = without_hits(own)
    assert 0.8 * len(charges) <= len(hits.charge) <= 1.1 * len(charges)
    np.testing.assert_allclose(np.median(hits.charge), np.median(charges), rtol=0.25)
    assert hits.exposure == own.frames.size
    s = frame_statistics(own)
    assert np.sqrt(s.variance.mean()) == pytest.approx(np.sqrt((4 * gain) ** 2 + 1 / 12), rel=0.03)
    if count >= 8:
        assert isinstance(telegraph.rts([s], baseline(gain, 4.0)), NotMeasurable)
        assert abs(in_camera_denoising([s])["weight"].value) < 0.01
        assert pink_noise([s])["sigma_dn"].value < 0.3 * 4 * gain


def test_values_that_no_particle_hit_are_as_they_were():
    own, _ = dark(2, per_frame=3, step=4)
    clean, hits = without_hits(own)
    before, after = own.frames, np.asarray(clean.frames[:])
    changed = before != after
    assert 0 < changed.mean() < 0.03
    assert not changed[:, ~hits.pixels].any()
    assert np.all(after % 4 == 0)
    np.testing.assert_array_equal(clean.frames[3], after[3])
    np.testing.assert_array_equal(clean.frames[2:4, 10:20], after[2:4, 10:20])


def test_what_is_no_hit_stays():
    rng = np.random.default_rng(3)
    hot = np.where(rng.random(SIZE) < 0.01, rng.exponential(500, SIZE), 1.0)
    for more in ({"charge": hot}, {"jumps": 60.0}, {"tails": 4}, {"read": 0.2, "charge": 1.0}, {"gain": 0.1}):
        own, _ = dark(4, **more)
        clean, hits = without_hits(own)
        assert len(hits.charge) <= 1, more
    flat, _ = dark(5, per_frame=5)
    assert without_hits(Recording(flat.frames, "MONO", (200,) * 4, 65535.0, kind="flat"))[1] is None


def test_another_exposure_among_darks_is_no_hit():
    own, _ = dark(6)
    frames = own.frames.copy()
    frames[0, :40] += 300
    assert not len(without_hits(Recording(frames, "MONO", (200,) * 4, 65535.0, kind="dark"))[1].charge)


def test_the_rate_and_charge_of_hits_are_measured():
    own, charges = dark(7, 16, per_frame=4)
    found = particles.cosmic_rays([frame_statistics(own)], baseline(0.8, 4.0))
    truth = 4 / (SIZE[0] * SIZE[1] * 1e-6 * 60)
    assert found["rate"].ci90[0] < truth < found["rate"].ci90[1]
    assert found["charge_e"].value == pytest.approx(charges.mean() / 0.8, rel=0.2)
    assert particles.told([frame_statistics(own)]).endswith("in 16 darks: their pixels are left out")
    none = particles.cosmic_rays([frame_statistics(dark(8)[0])], baseline(0.8, 4.0))
    assert isinstance(none, NotMeasurable) and none.answered
    assert isinstance(particles.cosmic_rays([], assumed_baseline()), NotMeasurable)


@pytest.mark.parametrize("hot", [4e-3, 5e-4])
def test_dark_currents_that_differ_hide_no_hits(hot):
    """Too few hot pixels in every channel to tell the shot noise there: together, or not even together."""
    rng = np.random.default_rng(13)
    charge = 24 * np.exp(0.3 * rng.standard_normal(SIZE)) * np.where(rng.random(SIZE) < hot, 30, 1)
    own, charges = dark(14, 6, 1.8, charge=charge, per_frame=10, reach=6)
    found = particles.cosmic_rays([frame_statistics(own)], baseline(1.8, 4.0))
    truth = 10 / (SIZE[0] * SIZE[1] * 1e-6 * 60)
    assert found["rate"].value == pytest.approx(truth, rel=0.1)
    assert found["charge_e"].value == pytest.approx(charges.mean() / 1.8, rel=0.12)
    spared, _ = dark(15, 6, 1.8, charge=charge)
    assert len(without_hits(spared)[1].charge) <= 1


@pytest.mark.parametrize(("gain", "read", "heat"), [(0.8, 4.0, 300), (3.0, 2.0, 30), (0.2, 15.0, 5000)])
def test_hot_pixels_are_no_telegraph_pixels_nor_noisy_ones(gain, read, heat):
    rng = np.random.default_rng(9)
    own, _ = dark(
        10, 16, gain, read, charge=np.where(rng.random(SIZE) < 0.01, rng.exponential(heat, SIZE), 0)
    )
    s, base = frame_statistics(own), baseline(gain, read)
    assert isinstance(telegraph.rts([s], base), NotMeasurable)
    assert noise.heavy_tails([s], base)["tukey_lambda"].value == pytest.approx(0.135, abs=0.02)
    assert maps.pixel_read_noise_map([s], base)["spread"].value < 0.08


@pytest.mark.slow
def test_telegraph_pixels_are_found_beside_hot_ones():
    rng = np.random.default_rng(11)
    hot = np.where(rng.random(SIZE) < 0.01, rng.exponential(300, SIZE), 0)
    own, _ = dark(12, 16, charge=hot, jumps=50.0)
    found = telegraph.rts([frame_statistics(own)], baseline(0.8, 4.0))
    assert found["jump_dn"].value == pytest.approx(40.0, rel=0.1)
    assert found["fraction"].value == pytest.approx(0.02, rel=0.3)
