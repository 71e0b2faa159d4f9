"""Parts of flats that no light reaches, and of darks that are noisier: told, and kept from what they would
bend."""

import re

import numpy as np
import pytest

from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable
from cannoise_jax.physics.transfer.estimators.dead import dead_pixels
from cannoise_jax.physics.transfer.estimators.light import flicker
from cannoise_jax.physics.transfer.estimators.maps import column_gain, pixel_read_noise_map, prnu
from cannoise_jax.physics.transfer.estimators.noise import heavy_tails
from cannoise_jax.physics.transfer.estimators.telegraph import rts
from cannoise_jax.physics.transfer.faults import faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.photon_transfer import transfer_at
from cannoise_jax.physics.transfer.shape import dark_lines
from cannoise_jax.physics.transfer.unlit import UNLIT, unlit, without_unlit
from cannoise_jax.recordings.recording import Recording

SIZE, GAIN, READ, BLACK = (96, 128), 0.5, 4.0, 500.0


def recorded(kind, light, seconds=1.0, count=8, seed=1, change=None):
    rng = np.random.default_rng([seed, kind == "dark", round(100 * seconds)])
    electrons = rng.poisson(light, (count, *SIZE)) + READ * rng.standard_normal((count, *SIZE))
    dn = GAIN * electrons if change is None else change(GAIN * electrons)
    frames = np.rint(BLACK + dn).clip(0, 16383).astype(np.uint16)
    path = f"{kind}_{seconds:g}s.h5"
    return Recording(frames, "MONO", (BLACK,) * 4, 16383.0, kind=kind, exposure_s=seconds, path=path)


def statistics(light, **more):
    return [frame_statistics(recorded(kind, v, **more)) for kind, v in (("flat", light), ("dark", 0.0))]


def covered(kind):
    """Light that leaves a part unlit, and that part."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    dark = {
        "columns": x >= 100, "rows": y < 20, "circle": np.hypot(y - 48, x - 64) > 44,
        "corner": (y < 30) & (x < 30),
    }[kind]  # fmt: skip
    return np.where(dark, 0.0, 12000.0), dark


@pytest.mark.parametrize("kind", ["columns", "rows", "circle", "corner"])
def test_unlit_parts_are_told_and_bear_on_nothing(kind):
    light, dark = covered(kind)
    found = statistics(light)
    told = unlit(found[0], (BLACK,) * 4)
    assert np.mean(told == dark) > 0.995
    line = faults(found).unlit
    assert line.startswith("flat_1s.h5: no light reaches") and "\n" not in line
    assert ("columns 101 to 128" in line) == (kind == "columns") and ("rows 1 to 20" in line) == (
        kind == "rows"
    )
    result = transfer_at(found)
    for gain in result.outcomes("system gain", "DN/e-"):
        assert isinstance(gain, Estimate) and gain.value == pytest.approx(GAIN, rel=0.03)
    for noise in result.outcomes("temporal dark noise", "e-"):
        assert isinstance(noise, Estimate) and noise.value == pytest.approx(READ, rel=0.03)
    assert {o.record for o in result.outcomes("PRNU1288") if isinstance(o, NotMeasurable)} == {UNLIT}
    for measured in (prnu, column_gain, dead_pixels, flicker):
        assert measured(result.statistics).record == UNLIT


def test_vignetting_dust_and_dim_flats_are_lit():
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    steep = 12000 * np.cos(np.arctan(np.hypot(y - 48, x - 64) / 55)) ** 4
    assert (steep.min() / steep.max()) < 0.2
    steep[40:43, 50:53] = 0.0
    for light in (steep, 3.0, 0.0):
        assert not unlit(statistics(light)[0], (BLACK,) * 4).any()
        assert not faults(statistics(light)).unlit


def test_a_dead_block_is_no_quiet_part_of_the_darks():
    light, dead = covered("columns")
    found = [
        frame_statistics(recorded(k, v, change=lambda dn: np.where(dead, 0.0, dn)))
        for k, v in (("flat", light), ("dark", 0.0))
    ]
    result = transfer_at(found)
    for noise in result.outcomes("temporal dark noise", "DN"):
        assert isinstance(noise, Estimate) and noise.value == pytest.approx(GAIN * READ, rel=0.03)
    (own,) = (s for s in result.statistics if s.recording.kind == "dark")
    assert own.dead is not None and np.array_equal(own.dead, dead)


@pytest.mark.parametrize("charged", [True, False])
def test_overscan_gathers_no_charge_and_masked_pixels_do(charged):
    """What no header says is cut off: 28 columns of 128 took a fifth of the dark current away."""
    light, dark = covered("columns")
    darks = [
        frame_statistics(recorded("dark", np.where(dark & ~charged, 0.0, 4.0) * t, t))
        for t in (0.1, 5.0, 10.0)
    ]
    result = transfer_at([frame_statistics(recorded("flat", light)), *darks])
    for rate in result.outcomes("dark current, by mean"):
        assert isinstance(rate, Estimate) and rate.value == pytest.approx(4.0, rel=0.05)
    found = [s.dead is not None for s in result.statistics if s.recording.kind == "dark"]
    assert not any(found) if charged else all(found)


@pytest.mark.parametrize(("loss", "said"), [(0.1, True), (0.0, False)])
def test_flats_whose_signal_lags_behind_their_exposure_are_said(loss, said):
    flats = [
        frame_statistics(recorded("flat", 6000.0 * t, t, 4, change=lambda dn: dn * (1 - loss * dn / 15000)))
        for t in (0.2, 0.5, 1.0, 2.0, 4.0)
    ]
    result = transfer_at([*flats, frame_statistics(recorded("dark", 0.0, 1.0))])
    notes = [q.note for q in result.quantities if q.name == "system gain"]
    assert all(("the signal per second changes by -" in n) == said for n in notes)


def test_flats_of_changing_light_are_not_called_bent():
    flats = [
        frame_statistics(recorded("flat", level, t, 4))
        for t, level in ((1.0, 9000.0), (2.0, 8800.0), (4.0, 9100.0), (8.0, 8900.0))
    ]
    result = transfer_at([*flats, frame_statistics(recorded("dark", 0.0, 1.0))])
    assert not any("per second" in q.note for q in result.quantities)


def test_read_noise_of_darks_far_longer_than_the_flats_is_said():
    flat = frame_statistics(recorded("flat", 2000.0))
    long, own, middle = (frame_statistics(recorded("dark", 6.0 * t, t)) for t in (100.0, 1.0, 20.0))
    assert faults([flat, long]).longer.startswith("the read noise is that of darks of 100 s")
    assert not faults([flat, long, own]).longer and not faults([flat, long, middle]).longer
    assert not faults([flat, own]).longer and not faults([long]).longer


@pytest.mark.parametrize("count", [2, 3, 8])
def test_the_table_of_darks_shows_the_noise_whatever_the_number_of_frames(count):
    darks = [frame_statistics(recorded("dark", 0.0, t, count)) for t in (1.0, 2.0)]
    head, *lines = dark_lines(darks)
    for line in lines:
        assert float(line[head.index("noise")]) == pytest.approx(GAIN * READ, abs=0.15)  # codes


def test_noisier_pixels_that_dark_noise_leaves_out_are_counted():
    scale = np.where(np.arange(SIZE[1]) < 10, 4.0, 1.0)
    for change, said in ((lambda dn: scale * dn, True), (None, False)):
        found = [
            frame_statistics(recorded(k, v, change=change)) for k, v in (("flat", 9000.0), ("dark", 0.0))
        ]
        notes = [q.note for q in transfer_at(found).quantities if q.name == "temporal dark noise"]
        assert any("are far noisier and set aside" in n for n in notes) == said


def test_noise_that_differs_between_parts_of_the_frame_is_said_and_no_noise_of_pixels():
    louder = np.where(np.arange(SIZE[1]) < SIZE[1] // 2, 2.0, 1.0)
    found = [
        frame_statistics(recorded(k, v, count=16, change=lambda dn: louder * dn))
        for k, v in (("flat", 9000.0), ("dark", 0.0))
    ]
    line = faults(found).uneven
    low, high = (float(v) for v in re.findall(r"[\d.]+", line)[:2])
    assert (low, high) == pytest.approx((GAIN * READ, 2 * GAIN * READ), rel=0.05)
    for estimator in (rts, heavy_tails, pixel_read_noise_map):
        assert estimator(found) == NotMeasurable(line)


@pytest.mark.parametrize("count", [2, 8])
def test_noise_of_pixels_lines_and_dead_parts_is_not_called_uneven(count):
    rng = np.random.default_rng(3)
    spread = np.exp(0.4 * rng.standard_normal(SIZE))
    spread[40:44] = 6.0
    _, dead = covered("corner")
    changes = (None, lambda dn: spread * dn, lambda dn: np.where(dead, 0.0, dn), np.zeros_like)
    for change in changes:
        found = [
            frame_statistics(recorded(k, v, count=count, change=change))
            for k, v in (("flat", 9000.0), ("dark", 0.0))
        ]
        assert not faults(without_unlit(found)).uneven and not faults(found).uneven
