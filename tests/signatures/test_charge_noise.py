"""Dark charge that differs from pixel to pixel brings noise that does: no read noise of pixels, no jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.charge_noise import by_charge, own_charge, steadied
from cannoise_jax.signatures.fields import refit
from cannoise_jax.signatures.noisy_lines import spread_of_lines
from cannoise_jax.signatures.pixels import spread_score
from tests.discovery.looks import SIGNATURES, white

SIZE = (96, 128)
GAIN, READ, BLACK = 4.0, 2.0, 400.0
_RNG = np.random.default_rng


def camera(seed, heat, jumps=0.0):
    """Bias, two exposures of darks and a flat in plain NumPy. heat: e-/s of every pixel; jumps: share of the
    pixels that jump by 12 e-."""
    rng = _RNG(seed)
    jumping = rng.random(SIZE) < jumps
    out = []
    shots = (("bias", 0.0, 0.0), ("dark", 10.0, 0.0), ("dark", 60.0, 0.0), ("flat", 0.1, 2000.0))
    for kind, seconds, light in shots:
        size = (12, *SIZE)
        charge = rng.poisson(heat * seconds + light, size) + READ * rng.standard_normal(size)
        charge = charge + jumping * 12.0 * (rng.random(size) < 0.4)
        codes = np.clip(np.round(BLACK + GAIN * charge), 0, 65535).astype(np.uint16)
        out.append(Recording(codes, "MONO", (BLACK,) * 4, 65535.0, kind=kind, exposure_s=seconds))
    return CaptureSet("camera", tuple(out))


def fields_of(capture):
    return prepare(capture, all_frames(split_recordings(capture)), False).fields


def uneven(seed):
    return 0.3 * np.exp(0.5 * _RNG(seed).standard_normal(SIZE))


def test_the_charge_of_each_pixel_comes_back_and_that_of_none_is_nothing():
    heat = uneven(1)
    charge = own_charge(fields_of(camera(1, heat)))
    away = heat - heat.mean()
    assert np.corrcoef(charge.ravel(), away.ravel())[0, 1] > 0.9
    assert np.polyfit(charge.ravel(), away.ravel(), 1)[0] == pytest.approx(1.0, abs=0.1)
    assert not own_charge(fields_of(camera(2, np.full(SIZE, 0.3)))).any()


def test_noise_in_units_of_each_pixels_own_is_alike():
    """Variance of the darks over what a pixel's charge makes it, in classes of that charge."""
    fields = fields_of(camera(3, uneven(3)))
    charge = own_charge(fields)
    dark = max((f for f in fields if f.kind == "dark"), key=lambda f: f.exposure_s)
    power = np.mean(dark.contrasts**2, 0) / by_charge(dark, charge)
    order = np.array_split(np.argsort(charge.ravel()), 5)
    classes = [power.ravel()[part].mean() for part in order]
    assert np.ptp(classes) < 0.12
    raw = [np.mean(dark.contrasts**2, 0).ravel()[part].mean() for part in order]
    assert np.ptp(raw) > 0.5


def test_it_is_no_spread_of_the_read_noise():
    for seed in range(3):
        score = spread_score(fields_of(camera(10 + seed, uneven(20 + seed))))
        assert score.amplitude < 0.04


def test_fixed_offsets_are_no_charge():
    capture = camera(4, np.full(SIZE, 0.01))
    offsets = np.round(40 * _RNG(5).standard_normal(SIZE))
    moved = tuple(
        Recording(
            np.clip(r.frames + offsets, 0, 65535).astype(np.uint16), r.cfa, r.black_level, r.white_level,
            kind=r.kind, exposure_s=r.exposure_s,
        )
        for r in capture.recordings
    )  # fmt: skip
    charge = own_charge(fields_of(CaptureSet("camera", moved)))
    assert np.std(charge) < 0.02


@pytest.mark.slow
def test_pixels_that_jump_are_told_beside_hot_ones_and_an_uneven_dark_current():
    heat = uneven(6)
    hot = _RNG(7).random(SIZE) < 0.004
    heat[hot] += 5 + _RNG(8).exponential(20, hot.sum())
    found = diagnose(camera(9, heat, jumps=0.012), compare=False)
    names = {f.named.mechanism: f.named.score for f in found.fitted.steps}
    assert {"hot_pixels", "rts", "dsnu"} <= set(names)
    assert "pixel_read_noise_map" not in names
    assert names["rts"].parameters["fraction"][0] == pytest.approx(0.012, abs=0.006)


def test_offsets_of_columns_make_no_column_louder_when_charge_is_taken_out_first():
    """A map that grows with the exposure is taken out before the offsets of columns are known."""
    capture = camera(14, uneven(14))
    offsets = np.round(30 * _RNG(15).standard_normal((1, SIZE[1])))
    moved = tuple(replace(r, frames=(r.frames + offsets).astype(np.uint16)) for r in capture.recordings)
    fields = fields_of(CaptureSet("camera", moved))
    for name in ("pixel_thermal_static", "column_additive_static"):
        fields = refit(SIGNATURES[name].absorb(fields, SIGNATURES[name].score(fields)))
    assert spread_of_lines(fields, axis="column").log_p > np.log(1e-3)


def test_the_noise_of_a_glow_stays_known_where_pixels_have_charge_of_their_own():
    """Mean square of the contrasts in the light of a glow and off it, in units of the noise."""
    rng = _RNG(9)
    down, across = np.mgrid[: SIZE[0], : SIZE[1]]
    glow = 400.0 * np.exp(-np.hypot(down, across) / 20)
    rate, seconds, read = uneven(9), 60.0, 16.0
    own = GAIN**2 * rate * seconds
    (field,) = white(rng, kinds=("dark",), frames=12, size=SIZE)
    known = read + own.mean() + glow
    values = rng.standard_normal((11, *SIZE)) * np.sqrt((read + own + glow) / known)
    field = field._replace(
        sigma=np.sqrt(known).astype(np.float32),
        shot=(glow / known).astype(np.float32),
        gain=np.full(4, GAIN),
        exposure_s=seconds,
        contrasts=values.astype(np.float32),
    )
    (after,) = steadied((field,), rate, np.ones(SIZE, bool), np.zeros(SIZE))
    power, near = np.mean(after.contrasts**2, 0), glow > 100
    assert power[near].mean() == pytest.approx(1.0, abs=0.05)
    assert power[~near].mean() == pytest.approx(1.0, abs=0.05)


def long_tailed(seed):
    """Log-normal currents of which a twentieth of the pixels has most of the variance."""
    return 0.08 * np.exp(1.1 * _RNG(seed).standard_normal(SIZE))


def without_map(capture):
    """The fields with the map of what pixels collect taken out, which is all that differs."""
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    thermal = next(s for s in prepared.signatures if s.name == "pixel_thermal_static")
    found = thermal.score(prepared.fields)
    return thermal.absorb(prepared.fields, found)


def test_pixels_far_out_of_a_map_have_the_noise_of_their_charge_too():
    """Variance of the longest dark over what it is taken to be, from the darkest pixels to the hottest. Noise
    of none of their own had the hottest 24 times too loud, and all others a fifth of what they were."""
    heat = long_tailed(30)
    fields = without_map(camera(31, heat))
    dark = max((f for f in fields if f.kind == "dark"), key=lambda f: f.exposure_s)
    assert dark.answers.apart["exposure"].mean() > 5e-4
    power = np.mean(dark.contrasts**2, 0).ravel()
    order = np.argsort(heat.ravel())
    parts = [*np.array_split(order, 5), order[-120:]]
    assert [power[p].mean() for p in parts] == pytest.approx([1.0] * 6, abs=0.12)
    assert not np.any(own_charge(fields)[dark.answers.apart["exposure"]])  # not counted a second time


@pytest.mark.parametrize(
    "heat", [long_tailed, uneven, lambda seed: 0.2 * (1 + 0.1 * _RNG(seed).random(SIZE))]
)
def test_doubt_about_charge_is_no_spread_of_the_read_noise_and_hides_none(heat):
    """Of long tails, of the middle, and of next to none: what is beyond chance, in standard deviations."""
    scores = [spread_score(without_map(camera(40 + seed, heat(50 + seed)))) for seed in range(4)]
    assert abs(np.mean([s.where["z"] for s in scores])) < 1.3


def test_one_hit_is_no_charge_of_a_pixel():
    capture = camera(32, long_tailed(33))
    long = capture.recordings[2]
    frames = np.array(long.frames)
    hit = _RNG(34).permutation(np.arange(frames[0].size))[:40]
    frames[3].ravel()[hit] += 6000
    moved = (*capture.recordings[:2], replace(long, frames=frames), *capture.recordings[3:])
    fields = without_map(CaptureSet("camera", moved))
    dark = max((f for f in fields if f.kind == "dark"), key=lambda f: f.exposure_s)
    assert np.median(np.max(np.abs(dark.contrasts), 0).ravel()[hit]) > 20
