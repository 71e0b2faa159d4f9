"""Recordings on which numbers would be wrong: cut off, mistaken for others, at odds with what is stated."""

import dataclasses

import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable
from cannoise_jax.physics.transfer.estimators.light import saturation
from cannoise_jax.physics.transfer.estimators.maps import prnu
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, photon_transfer
from cannoise_jax.physics.transfer.rails import contradicted_black, cut_off
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording
from cannoise_jax.recordings.usable import usable

SIZE, WHITE, GAIN, PRNU = (96, 128), 4095.0, 0.8, 0.006
PATTERN = 1 + PRNU * np.random.default_rng(9).standard_normal(SIZE)


def recording(kind, electrons=0.0, black=200.0, stated=200.0, count=6, shade=None, seed=0, top=WHITE):
    rng = np.random.default_rng([seed, int(np.max(electrons)), kind == "dark"])
    light = electrons * PATTERN * (np.ones(SIZE) if shade is None else shade)
    e = rng.poisson(np.broadcast_to(light, (count, *SIZE))) + 4.0 * rng.standard_normal((count, *SIZE))
    frames = np.clip(np.rint(black + GAIN * e), 0, top).astype(np.uint16)
    return Recording(frames, "MONO", (stated,) * 4, WHITE, kind=kind, exposure_s=1.0, path=f"{kind}.h5")


def prnu_of(*recordings):
    (transfer,) = photon_transfer(CaptureSet("c", recordings))
    (outcome,) = of_all_pixels(transfer).outcomes("PRNU1288")
    return outcome, transfer


@pytest.mark.parametrize("stated", [20.0, 170.0, 230.0, 500.0])
def test_prnu_does_not_depend_on_a_black_level_that_the_darks_contradict(stated):
    flat, dark = recording("flat", 2000.0, stated=stated), recording("dark", stated=stated)
    outcome, transfer = prnu_of(flat, dark)
    assert outcome.value == pytest.approx(100 * PRNU, rel=0.06)
    assert prnu(transfer.statistics)["sigma"].value == pytest.approx(PRNU, rel=0.06)
    note = contradicted_black([frame_statistics(dark)])
    assert note.startswith(f"darks are at 200 DN, {stated:g} is stated")


def test_levels_within_the_noise_of_the_darks_and_dark_charge_contradict_nothing():
    near = [frame_statistics(recording("dark", stated=204.0))]
    assert contradicted_black(near) == ""
    charged = [frame_statistics(recording("dark")), frame_statistics(recording("dark", 300.0))]
    assert contradicted_black(charged) == ""


def test_flats_near_their_end_show_no_prnu_and_dimmer_ones_do():
    y, x = np.mgrid[-1 : 1 : SIZE[0] * 1j, -1 : 1 : SIZE[1] * 1j]
    dark = recording("dark")
    partly = recording("flat", 5500.0, shade=1 - 0.3 * (x**2 + y**2))
    wholly = recording("flat", 3400.0, top=3000)
    for flat in (partly, wholly):
        outcome, _ = prnu_of(flat, dark)
        assert isinstance(outcome, NotMeasurable) and "dimmer" in outcome.record
    outcome, _ = prnu_of(partly, recording("flat", 1000.0), dark)
    assert isinstance(outcome, Estimate) and outcome.value == pytest.approx(100 * PRNU, rel=0.1)


def test_flats_of_two_lights_with_one_hot_pixel_near_the_end_tell_the_gain():
    """Rows are scaled to one light, which charge that the light did not bring is not."""
    frames = np.concatenate([recording("flat", e, count=3, seed=2).frames for e in (2000.0, 700.0)])
    frames[:, 40, 60] = np.clip(frames[:, 40, 60].astype(int) + 2400, 0, 4000)
    flat = dataclasses.replace(recording("flat", 2000.0), frames=frames)
    (transfer,) = photon_transfer(CaptureSet("c", (flat, recording("dark"))))
    (gain,) = of_all_pixels(transfer).outcomes("system gain")
    assert isinstance(gain, Estimate) and gain.value == pytest.approx(GAIN, rel=0.04)


def test_darks_cut_off_at_zero_are_refused_and_dead_columns_are_not():
    flat, cut = recording("flat", 2000.0, black=0.0, stated=0.0), recording("dark", black=0.0, stated=0.0)
    with pytest.raises(BadInput, match=r"dark.h5: darks are cut off at 0 \(5. %.*raise the camera's offset"):
        calibrate(CaptureSet("c", (flat, cut)))
    whole = recording("dark", black=12.0, stated=12.0)
    whole.frames[:, :, :5] = 0
    assert cut_off([frame_statistics(whole)]) == ""


def drawn(level, sigma, count=8, seed=7):
    noisy = level + sigma * np.random.default_rng(seed).standard_normal((count, *SIZE))
    frames = np.clip(np.rint(noisy), 0, None).astype(np.uint16)
    return Recording(frames, "MONO", (level,) * 4, 4095.0, kind="dark", exposure_s=1.0, path="dark.h5")


@pytest.mark.parametrize(
    "level, sigma", [(2.0, 0.8), pytest.param(1.2, 0.4, marks=pytest.mark.slow), (60.0, 20.0), (12.0, 4.0)]
)
def test_darks_near_zero_whose_noise_ends_above_it_are_not_cut_off(level, sigma):
    """Noise of a code holds many a 0 that is no end of it; of many frames most pixels touch 0 once."""
    dark = drawn(level, sigma, count=40)
    assert cut_off([frame_statistics(dark)]) == ""
    flat = recording("flat", 2000.0, black=level, stated=level)
    (transfer,) = photon_transfer(CaptureSet("c", (flat, dark)))
    (read,) = of_all_pixels(transfer).outcomes("temporal dark noise", "DN")
    assert isinstance(read, Estimate) and read.value == pytest.approx(sigma, rel=0.03)


@pytest.mark.parametrize(
    "level, sigma", [(0.0, 1.0), (1.0, 1.0), (2.0, 2.0), (0.0, 5.0), (8.0, 4.0), (40.0, 20.0)]
)
def test_darks_whose_noise_ends_below_zero_are_cut_off_for_table_and_refusal_alike(level, sigma):
    dark = drawn(level, sigma)
    assert "darks are cut off at 0" in cut_off([frame_statistics(dark)])
    (transfer,) = photon_transfer(CaptureSet("c", (dark,)))
    (read,) = of_all_pixels(transfer).outcomes("temporal dark noise", "DN")
    assert isinstance(read, NotMeasurable) and "cut off" in read.record


def test_scenes_that_move_tell_no_gain_and_those_that_stand_still_do():
    rng = np.random.default_rng(3)
    scene = 800 + 1500 * np.kron(rng.random((6, 8)), np.ones((16, 16)))
    moved = np.stack([np.roll(scene, 5 * k, (0, 1)) for k in range(4)])
    upright = np.stack([np.roll(np.tile(scene[:1], (SIZE[0], 1)), 5 * k, 1) for k in range(4)])
    for light, moves in ((moved, True), (upright, True), (np.stack([scene] * 4), False)):
        frames = np.rint(200 + GAIN * (rng.poisson(light) + 4 * rng.standard_normal(light.shape)))
        own = Recording(frames.astype(np.uint16), "MONO", (200.0,) * 4, WHITE, kind="scene", path="s.h5")
        (transfer,) = photon_transfer(CaptureSet("c", (own, recording("dark"))))
        (gain,) = of_all_pixels(transfer).outcomes("system gain")
        if moves:
            assert isinstance(gain, NotMeasurable) and "the scene or its light moves" in gain.record
        else:
            assert isinstance(gain, Estimate) and gain.value == pytest.approx(GAIN, rel=0.05)


def test_noise_below_a_code_and_flats_of_no_sure_slope_are_named_as_what_they_are():
    rng = np.random.default_rng(4)
    quiet, flat = recording("dark"), recording("flat", 2000.0)
    quiet.frames[...] = np.rint(200.37 + 0.1 * rng.standard_normal(quiet.frames.shape))
    (transfer,) = photon_transfer(CaptureSet("c", (flat, quiet)))
    (gain,) = of_all_pixels(transfer).outcomes("system gain")
    assert isinstance(gain, Estimate) or "below a code" in gain.record
    loud = recording("dark")
    loud.frames[...] = np.clip(np.rint(200 + 40 * rng.standard_normal(loud.frames.shape)), 0, None)
    (transfer,) = photon_transfer(CaptureSet("c", (recording("flat", 100.0), loud)))
    (gain,) = of_all_pixels(transfer).outcomes("system gain")
    assert isinstance(gain, NotMeasurable) and "does not surely grow" in gain.record


def test_a_dark_with_a_saturated_part_is_left_out():
    dark = recording("dark")
    dark.frames[4, :, 70:] = int(WHITE)
    dark.frames[:, 5, 5:9] = int(WHITE)  # hot pixels
    kept, lines = usable(CaptureSet("c", (dark,)))
    assert kept.recordings[0].count == 5
    assert lines[0].startswith("dark.h5: frame 5: 45 % of its pixels are at the white level")


def test_flats_darker_than_the_darks_are_refused():
    swapped = CaptureSet("c", (recording("flat"), recording("dark", 2000.0)))
    with pytest.raises(BadInput, match=r"flat.h5: the brightest flat, 200 DN.*wrong way round"):
        usable(swapped)
    sound = CaptureSet("c", (recording("flat", 2000.0), recording("dark")))
    assert usable(sound)[0].recordings == sound.recordings


def test_a_flat_that_is_not_above_black_has_no_full_well():
    base = Baseline(
        gain=np.full(4, GAIN),
        read_noise=np.full(4, 40.0),
        black_level=np.full(4, 2200.0),
        gain_stderr=np.full(4, 0.01),
        read_stderr=np.full(4, 0.1),
        white_level=WHITE,
        code_step=1.0,
    )
    assert isinstance(saturation([frame_statistics(recording("flat"))], base), NotMeasurable)


def test_the_gain_beside_darks_that_are_cut_off_is_that_of_the_flats():
    """What code 0 cuts off of the noise of a dark is not missing in the light."""
    rng = np.random.default_rng(4)
    gain, sigma, size = 0.15, 1.65, (120, 160)

    def stack(kind, light, count=4):
        noisy = gain * rng.poisson(light / gain, (count, *size)) + sigma * rng.standard_normal((count, *size))
        frames = np.clip(np.rint(noisy), 0, None).astype(np.uint16)
        return Recording(frames, "MONO", (0.0,) * 4, 1023.0, kind=kind, exposure_s=0.01)

    flats = [stack("flat", light) for light in (140.0, 280.0, 560.0)]
    (transfer,) = photon_transfer(CaptureSet("c", (*flats, stack("dark", 0.0))))
    transfer = of_all_pixels(transfer)
    (found,) = transfer.outcomes("system gain")
    assert isinstance(found, Estimate) and abs(found.value - gain) < 4 * found.stderr < 0.01
    (read,) = transfer.outcomes("temporal dark noise", "DN")
    assert isinstance(read, Estimate) and read.ci90[0] < sigma < read.ci90[1]
    (rows,) = transfer.outcomes("temporal dark noise, rows included", "DN")
    assert isinstance(rows, NotMeasurable) and "cut off" in rows.record
