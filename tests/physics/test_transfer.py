"""Photon transfer against known truth, against real recordings and against the EMVA 1288 reference code."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.mechanisms import ENTRIES
from cannoise_jax.physics.transfer.ends import rails
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable, variance_difference
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import find_mechanisms, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, photon_transfer
from cannoise_jax.physics.transfer.table import format_outcome, format_transfer
from cannoise_jax.recordings import BadInput, CaptureSet, Recording
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.packing import site
from tests.conftest import SIMULATION

BLACK, WHITE, GAIN, READ = 200.0, 16383.0, 2.5, 3.0


def recording(rng, electrons, frames=8, size=(96, 128), kind="dark", **more):
    """Frames of a camera with gain 2.5 DN/e- and read noise 3 e-; `electrons`: a number or [T, H, W]."""
    extra = more.pop("add", 0.0)
    white = more.pop("white_level", WHITE)
    mean = np.broadcast_to(electrons, (frames, *size))
    charge = rng.poisson(np.maximum(mean, 0)) + rng.normal(0, READ, (frames, *size))
    values = np.clip(np.rint(BLACK + GAIN * charge + extra), 0, white)
    black = (BLACK,) * 4
    return Recording(values.astype(np.uint16), "RGGB", black, white, camera="made", kind=kind, **more)


def transfer(*recordings):
    (result,) = photon_transfer(CaptureSet("made", recordings))
    return result


def holds(outcome, truth, slack=2.0):
    """Whether the truth lies within `slack` half-widths of a 90 % interval (2: missed once in 1000)."""
    assert isinstance(outcome, Estimate), outcome
    low, high = outcome.ci90
    return (
        outcome.value - slack * (outcome.value - low)
        <= truth
        <= outcome.value + slack * (high - outcome.value)
    )


def test_recovers_gain_and_read_noise_of_every_channel():
    rng = np.random.default_rng(1)
    levels = [recording(rng, mu, kind="flat", exposure_s=0.01) for mu in (200.0, 1000.0, 4000.0)]
    result = transfer(recording(rng, 0.0, 16, exposure_s=0.01), *levels)
    for gain in result.outcomes("system gain"):
        assert holds(gain, GAIN) and gain.stderr < 0.03
    for o in result.outcomes("temporal dark noise", "DN"):
        assert holds(o, READ * GAIN)
    assert all(holds(o, READ) for o in result.outcomes("temporal dark noise", "e-"))
    assert not isinstance(result.baseline, NotMeasurable)
    assert np.allclose(result.baseline.read_noise_e, READ, rtol=0.03)


@pytest.mark.parametrize(
    "trouble",
    ["lamp drift", "a sky that turns", "mains flicker", "fixed patterns", "hot pixels", "saturation"],
)
def test_gain_is_not_biased_by(trouble):
    rng = np.random.default_rng(2)
    shape, size = (12, 96, 128), (96, 128)
    mean, add = np.full(shape, 2000.0), np.zeros(size)
    bias = recording(rng, 0.0, 16, exposure_s=0.01)
    if trouble == "lamp drift":
        mean *= 1 - 0.03 * np.exp(-np.arange(12))[:, None, None]
    elif trouble == "a sky that turns":
        lean = rng.uniform(-0.04, 0.04, (2, 12, 1, 1))
        y, x = np.linspace(-1, 1, 96)[:, None], np.linspace(-1, 1, 128)
        mean *= (1 + lean[0] * x + lean[1] * y) * (1 - 0.2 * x**2)
    elif trouble == "mains flicker":
        phase = rng.uniform(0, 6.28, (12, 1, 1))
        mean *= 1 + 0.15 * np.cos(np.arange(96)[None, :, None] / 9.0 + phase)
    elif trouble == "fixed patterns":
        mean *= (1 + 0.02 * rng.normal(size=size)) * np.linspace(0.8, 1.2, 128)
        add = 40.0 * rng.normal(size=size)
    elif trouble == "hot pixels":
        mean *= np.where(rng.random(size) < 0.003, 6.0, 1.0)
        add = np.where(rng.random(shape) < 0.5, 800.0, 0.0) * (rng.random(size) < 0.002)  # telegraph pixels
    else:
        mean = mean * np.where(np.arange(128) < 16, 10.0, 1.0)
    result = transfer(bias, recording(rng, mean, 12, kind="flat", add=add, exposure_s=0.01))
    for gain in result.outcomes("system gain"):
        assert abs(gain.value / GAIN - 1) < 0.02


def test_coarse_codes_are_taken_out_of_the_noise():
    rng = np.random.default_rng(3)

    def shifted(r):
        return replace(r, frames=np.clip(np.rint(r.frames / 8.0) * 8, 0, WHITE).astype(np.uint16))

    result = transfer(shifted(recording(rng, 0.0, 16)), shifted(recording(rng, 3000.0, kind="flat")))
    assert result.baseline.code_step == 8
    assert all(abs(o.value / (READ * GAIN) - 1) < 0.03 for o in result.outcomes("temporal dark noise", "DN"))


def test_patterns_split_into_rows_columns_and_pixels():
    rng = np.random.default_rng(4)
    size = (128, 128)
    columns, pixels = 1.2 * rng.normal(size=(1, 128)), 2.0 * rng.normal(size=size)
    temporal_rows = 3.0 * rng.normal(size=(16, 128, 1))
    dark = recording(rng, 0.0, 16, size, add=columns + pixels + temporal_rows)
    response = 1 + 0.01 * rng.normal(size=size)
    flat = recording(rng, 4000.0 * response, 16, size, kind="flat")
    result = transfer(dark, flat)
    truth = {"DSNU1288, columns": 1.2, "DSNU1288, pixels": 2.0, "PRNU1288, pixels": 1.0}
    for name, value in truth.items():
        assert np.isclose(np.mean([o.value for o in result.outcomes(name)]), value, rtol=0.12), name
    # Temporal row noise leaves 3 / sqrt(16) DN in the average of the frames; none of it is a fixed pattern.
    assert all(o.ci90[0] < 0.4 for o in result.outcomes("DSNU1288, rows"))
    assert np.mean([o.value for o in result.outcomes("DSNU1288, rows")]) < 0.5
    (rows,) = result.outcomes("row noise")
    assert holds(rows, temporal_rows.std())


def test_dark_current_and_the_clamp_that_hides_it():
    rng = np.random.default_rng(5)
    times = (0.1, 10.0, 30.0, 60.0)
    flat = recording(rng, 3000.0, kind="flat", exposure_s=0.1)
    free = [recording(rng, 2.0 * t, exposure_s=t) for t in times]
    clamped = [
        replace(r, frames=r.frames - np.uint16(round(GAIN * 2.0 * t)))
        for r, t in zip(free, times, strict=True)
    ]
    plain = transfer(flat, *free)
    assert all(abs(o.value / 2.0 - 1) < 0.05 for o in plain.outcomes("dark current, by mean"))
    assert all(abs(o.value / 2.0 - 1) < 0.1 for o in plain.outcomes("dark current, by variance"))
    hidden = transfer(flat, *clamped)
    assert all(abs(o.value / 2.0 - 1) < 0.1 for o in hidden.outcomes("dark current, by variance"))
    notes = [q.note for q in hidden.quantities if q.name == "dark current, by mean"]
    assert all("clamped" in n for n in notes)


def test_scenes_with_repeated_frames_give_the_baseline():
    rng = np.random.default_rng(6)
    scene = 300.0 * np.exp(np.add.outer(np.sin(np.arange(192) / 20), np.cos(np.arange(256) / 15)))
    result = transfer(recording(rng, scene, 10, (192, 256), kind="scene"))
    for gain, read in zip(
        result.outcomes("system gain"), result.outcomes("temporal dark noise", "DN"), strict=False
    ):
        assert abs(gain.value / GAIN - 1) < 0.04
        assert abs(read.value / (READ * GAIN) - 1) < 0.25


def test_low_light_scene_is_not_flattened_by_the_noise_of_the_mean():
    rng = np.random.default_rng(7)
    scene = rng.uniform(2.0, 12.0, (256, 256))
    result = transfer(recording(rng, scene, 4, (256, 256), kind="scene", white_level=1023.0))
    gains = [o.value for o in result.outcomes("system gain")]
    assert abs(np.mean(gains) / GAIN - 1) < 0.1  # without the correction about 35 % low


def test_what_is_missing_is_named():
    rng = np.random.default_rng(8)
    only_darks = transfer(recording(rng, 0.0))
    assert isinstance(only_darks.baseline, NotMeasurable) and "light" in only_darks.baseline.record
    assert all(isinstance(o, NotMeasurable) for o in only_darks.outcomes("PRNU1288"))
    assert isinstance(only_darks.outcomes("temporal dark noise", "DN")[0], Estimate)
    single = transfer(recording(rng, 1000.0, 1, kind="flat"))
    assert isinstance(single.outcomes("system gain")[0], NotMeasurable)
    text = format_transfer(only_darks)
    assert "Not measured, for want of these recordings" in text and "saturates" in text


def test_sizes_that_differ_are_refused_in_one_line():
    rng = np.random.default_rng(9)
    with pytest.raises(BadInput, match="size") as error:
        transfer(recording(rng, 0.0), recording(rng, 0.0, size=(64, 64)))
    assert "\n" not in str(error.value)


def test_statistics_match_plain_numpy_and_do_not_depend_on_chunks(monkeypatch):
    rng = np.random.default_rng(10)
    r = recording(rng, 5.0, 7, (32, 40))
    whole = frame_statistics(r)
    monkeypatch.setattr("cannoise_jax.physics.transfer.frames._CHUNK_BYTES", 1)
    parts = frame_statistics(r)
    assert np.array_equal(whole.variance, parts.variance) and np.array_equal(whole.row_means, parts.row_means)
    y = r.frames.astype(float)[:, ::2, 1::2]
    y = y - y.mean(2, keepdims=True)
    assert np.allclose(site(whole.variance, 1), y.var(0, ddof=1) / (1 - 1 / 20))


def test_rails_are_pile_ups_only():
    rng = np.random.default_rng(11)
    free = np.bincount(np.rint(rng.normal(100, 9, 20000)).astype(int), minlength=1 << 16)
    cut = np.bincount(np.clip(np.rint(rng.normal(100, 9, 20000)), 97, 103).astype(int), minlength=1 << 16)
    assert np.isnan(rails(free, 1.0, 1023.0)).all()
    assert rails(cut, 1.0, 1023.0) == (97.0, 103.0)


def test_interval_of_a_variance_difference_covers_near_zero():
    rng = np.random.default_rng(14)
    for truth in (0.0, 0.1, 1.0):
        hits = 0
        for _ in range(400):
            first = (truth + 1) * rng.chisquare(30) / 30
            low, high = variance_difference(first, 30, rng.chisquare(200) / 200, 200).ci90
            hits += low <= truth <= high
        assert 340 <= hits <= 380


def test_agrees_with_the_emva_1288_reference_code(monkeypatch, tables):
    pytest.importorskip("emva1288", reason="optional: pip install emva1288")
    if not hasattr(np, "asfarray"):  # the reference code was written for numpy 1
        monkeypatch.setattr(np, "asfarray", lambda a: np.asarray(a, float), raising=False)
    from emva1288.process.data import Data1288
    from emva1288.process.results import Results1288
    from emva1288.process.routines import get_int_imgs

    rng = np.random.default_rng(15)
    size, means = (128, 160), (500.0, 1500.0, 2500.0, 3500.0)
    response, offset = 1 + 0.008 * rng.normal(size=size), 4.0 * rng.normal(size=size)
    dark = recording(rng, 0.0, 16, size, exposure_s=0.01, add=offset, white_level=65535.0)
    flats = [
        recording(rng, mu * response, 16, size, kind="flat", exposure_s=0.01, add=offset, white_level=65535.0)
        for mu in means
    ]

    def temporal(r):
        pair = get_int_imgs(list(r.frames[:2].astype(np.int64)))
        return {"sum": pair["sum"].sum(), "pvar": pair["pvar"].sum(), "dmean": pair["dmean"]}

    photons = {0.0: dark, **dict(zip(means, flats, strict=True))}
    spatial = {0.0: get_int_imgs(list(dark.frames)), means[1]: get_int_imgs(list(flats[1].frames))}
    data = {
        "height": size[0], "width": size[1],
        "temporal": {10.0: {p: temporal(r) for p, r in photons.items()}}, "spatial": {10.0: spatial},
    }  # fmt: skip
    reference = Results1288(Data1288(data).data, loglevel=50)
    ours = transfer(dark, *flats)
    gain, noise, dsnu, prnu = (
        np.mean([o.value for o in ours.outcomes(*name)])
        for name in (
            ("system gain",),
            ("temporal dark noise", "e-"),
            ("DSNU1288", "e-"),
            ("PRNU1288",),
        )
    )
    # A sensor without colours is one channel, as the reference code knows it.
    alone = of_all_pixels(transfer(*(replace(r, cfa="MONO") for r in (dark, *flats))))
    for name, other, most in (
        (("system gain",), reference.K, 0.02),
        (("temporal dark noise", "e-"), reference.sigma_d, 0.03),
        (("DSNU1288", "e-"), reference.DSNU1288, 0.04),
        (("PRNU1288",), reference.PRNU1288, 0.04),
    ):
        (outcome,) = alone.outcomes(*name)
        assert outcome.value == pytest.approx(other, rel=most), name
    for name, value, other, most in (
        ("system gain, DN/e-", gain, reference.K, 0.02),
        ("temporal dark noise, e-", noise, reference.sigma_d, 0.03),
        ("DSNU, e-", dsnu, reference.DSNU1288, 0.04),
        ("PRNU, %", prnu, reference.PRNU1288, 0.04),
    ):
        assert value == pytest.approx(other, rel=most), name
        row = (name, f"{value:.4g}", f"{other:.4g}", f"{100 * (value / other - 1):+.1f} %")
        tables.add("emva1288_agreement", ("quantity", "here", "emva1288", "difference"), [row], SIMULATION)
    assert gain == pytest.approx(GAIN, rel=0.01) and noise == pytest.approx(READ, rel=0.02)


BY_HAND = {
    "typical pixel noise": 9.3,
    "pixels above 2 x typical": 0.29,
    "pixels above 3 x typical": 0.10,
    "excess kurtosis": 1.49,
    "excess kurtosis, clipped": 0.39,
    "row noise": 1.53,
    "row noise over the share of white noise": 33.0,
    "correlation of next rows": 0.48,
    "correlation of pixels (0, 1)": -0.031,
    "correlation of pixels (0, 2)": 0.029,
    "correlation of pixels (1, 0)": 0.012,
    "correlation of pixels (1, 1)": -0.015,
    "fixed pattern": 0.65,
}
"""Measured by hand on the real camera, in DN, per cent or 1."""
HAND_COLUMNS = ("quantity (DN, % or 1)", "by hand", "the same, corrected", "measured (90 % interval)")


def test_real_camera_matches_what_was_measured_by_hand(real_data, tables):
    (result,) = photon_transfer(load_capture_set(real_data / "asi178"))
    # By hand means of 256 rows were taken out: 1/255 of the correlation down a column, too.
    by_hand = dict(BY_HAND)
    by_hand["correlation of pixels (1, 0)"] += 1 / 255
    # The median of what 15 frames show of Gaussian noise lies 2.4 % below it.
    by_hand["typical pixel noise"] /= np.sqrt(stats.chi2.median(14) / 14)
    for name, value in by_hand.items():
        (found,) = result.outcomes(name)
        rounding = 0.5 * 10.0 ** -len(f"{BY_HAND[name]:g}".partition(".")[2])
        slack = max(0.02 * abs(value), (found.ci90[1] - found.ci90[0]) / 2) + rounding
        assert abs(found.value - value) <= slack, (name, found)
        low, high = found.ci90
        row = (name, f"{BY_HAND[name]:g}", f"{value:.3g}", f"{found.value:.4g} ({low:.4g} to {high:.4g})")
        tables.add("photon_transfer", HAND_COLUMNS, [row], SIMULATION)
    for gain in result.outcomes("system gain"):
        assert 4.21 * 0.98 < gain.value < 4.24 * 1.02
    prnu = [o.value for o in result.outcomes("PRNU1288, pixels")]
    gains = [o.value for o in result.outcomes("system gain")]
    ranges = (("system gain, DN/e-", "4.21–4.24", gains), ("PRNU, pixels, %", "0.36–0.51", prnu))
    measured = [f"{min(of):.4g}–{max(of):.4g}" for _, _, of in ranges]
    rows = [(name, hand, hand, said) for (name, hand, _), said in zip(ranges, measured, strict=True)]
    tables.add("photon_transfer", HAND_COLUMNS, rows, SIMULATION, gain=measured[0], gain_hand="4.21–4.24")
    assert abs(min(prnu) - 0.36) < 0.008 and abs(max(prnu) - 0.51) < 0.011
    # A fixed row pattern of 0.37 DN would be what temporal row noise leaves in the average of 15 frames.
    (rows,), (profile,) = (
        result.outcomes("fixed pattern, whole rows"),
        result.outcomes("spread of row means of the average"),
    )
    assert rows.ci90[1] < 0.3 and abs(profile.value - 1.53 / np.sqrt(15)) < 0.03
    assert all(isinstance(o, NotMeasurable) for o in result.outcomes("saturation level"))
    notes = [q.note for q in result.quantities if q.name == "dark current, by mean"]
    assert all("clamped" in n for n in notes)


@pytest.mark.parametrize("read, level, pattern", [(0.3, 100.0, 0.0), (0.3, 100.5, 0.0), (0.25, 100.3, 0.5)])
def test_noise_below_a_code_is_measured_through_the_rounding(read, level, pattern):
    rng = np.random.default_rng(5)
    offsets = level + pattern * rng.standard_normal((64, 64))
    frames = np.round(offsets + read * rng.standard_normal((40, 64, 64))).astype(np.uint16)
    dark = Recording(frames, "RGGB", (100.0,) * 4, 4095.0, "quiet", "dark", exposure_s=0.01)
    (result,) = photon_transfer(CaptureSet("quiet", (dark,)))
    for found in result.outcomes("temporal dark noise", "DN"):
        assert isinstance(found, Estimate)
        assert found.value == pytest.approx(read, rel=0.05) and found.stderr < 0.02


def test_recordings_with_and_without_an_iso_make_one_model():
    rng = np.random.default_rng(3)
    plan = [(kind, mu, iso) for iso in (None, 100.0) for kind, mu in (("dark", 0.0), ("flat", 1000.0))]
    recordings = [recording(rng, mu, 4, (48, 64), kind, exposure_s=0.01, iso=iso) for kind, mu, iso in plan]
    model = sensor_model(photon_transfer(CaptureSet("made", tuple(recordings))), [])
    # Settings of a model ascend; the one that states no ISO stands below those that do.
    assert np.ravel(model.iso).tolist() == [50.0, 100.0]
    np.testing.assert_allclose(np.asarray(model.gain_dn_per_e), GAIN, rtol=0.1)


@pytest.mark.parametrize("sigmas", [1.0, 3.0])
def test_flats_at_the_highest_code_do_not_tell_the_gain(sigmas):
    """Of pixels that never touch it the upper end of the noise is lost."""
    rng = np.random.default_rng(3)
    electrons = 1500.0
    white = np.floor(BLACK + GAIN * (electrons + sigmas * np.sqrt(electrons + READ**2)))
    dark = recording(rng, 0.0, white_level=white)
    near = recording(rng, electrons, kind="flat", white_level=white)
    assert isinstance(transfer(near, dark).baseline, NotMeasurable)
    # Beside a dimmer one they do no harm.
    dim = recording(rng, 700.0, kind="flat", white_level=white)
    for outcome in transfer(near, dim, dark).outcomes("system gain"):
        assert isinstance(outcome, Estimate) and outcome.value == pytest.approx(GAIN, rel=0.06)


def test_light_that_drifts_leaves_the_gain():
    rng = np.random.default_rng(4)
    levels = 1000.0 * 1.25 ** np.arange(6)
    flat = recording(rng, np.broadcast_to(levels[:, None, None], (6, 96, 128)), frames=6, kind="flat")
    gains = [o.value for o in transfer(flat, recording(rng, 0.0)).outcomes("system gain")]
    # The harmonic mean of the light is 0.87 of the mean.
    assert np.mean(gains) == pytest.approx(GAIN, rel=0.04)


def test_the_gain_of_a_model_that_bends_is_that_of_small_signals():
    rng, loss = np.random.default_rng(8), 0.2
    span = WHITE - BLACK

    def bent(linear, frames, **more):
        charge = rng.poisson(linear / GAIN, (frames, 96, 128)).astype(float)
        charge *= 1 - loss * GAIN * charge / span
        values = np.rint(BLACK + GAIN * (charge + rng.normal(0, READ, charge.shape)))
        return Recording(values.astype(np.uint16), "RGGB", (BLACK,) * 4, WHITE, camera="made", **more)

    exposures = (0.02, 0.1, 0.25, 0.5)
    lit = [bent(0.9 * span * t / 0.5, 4, kind="flat", exposure_s=t) for t in exposures]
    dark = [bent(0.0, 8, kind="dark", exposure_s=t) for t in exposures]
    result = transfer(*dark, *lit)
    model = sensor_model([result], find_mechanisms(result.statistics, result.baseline, ENTRIES))
    assert [f.record.id for f in model.mechanisms] == ["nonlinearity"]
    assert np.mean(result.baseline.gain) < 0.95 * GAIN
    assert np.asarray(model.gain_dn_per_e) == pytest.approx(GAIN, rel=0.03)
    assert np.asarray(model.read_noise_e) == pytest.approx(READ, rel=0.05)


def test_numbers_that_round_to_zero_have_no_sign():
    assert format_outcome(Estimate(-0.2, 12.0, (-19.4, 19.0))) == "0 [-19, 19]"
    assert format_outcome(Estimate(-0.0, 0.0, (-0.0, -0.0))) == "0"


def test_what_one_channel_lacks_is_said_of_that_channel():
    """Blue alone saturates: the others' saturation is what was not recorded."""
    rng, light = np.random.default_rng(7), np.ones((96, 128))
    light[1::2, 1::2] = 3.0
    flats = [recording(rng, e * light, kind="flat", white_level=4095.0) for e in (300.0, 1000.0)]
    captures = CaptureSet("c", (*flats, recording(rng, 0.0, white_level=4095.0)))
    said = format_transfer(photon_transfer(captures)[0])
    assert "saturation level of R, Gr, Gb: no pixel reached its end" in said


def test_pixels_whose_noise_is_below_a_code_are_not_said_to_be_noisier():
    rng = np.random.default_rng(3)
    frames = [np.rint(20 + 0.05 * rng.standard_normal((96, 128)) + 0.24 * rng.standard_normal((6, 96, 128)))]
    frames += [np.rint(20 + 0.12 * rng.poisson(e, (6, 96, 128))) for e in (1000, 4000)]
    made = [
        Recording(f.astype(np.uint16), "MONO", (20.0,) * 4, 1023.0, kind=k, exposure_s=0.01, code_step=1.0)
        for f, k in zip(frames, ("dark", "flat", "flat"), strict=True)
    ]
    assert "far noisier" not in format_transfer(photon_transfer(CaptureSet("c", tuple(made)))[0])


@pytest.mark.parametrize(("kind", "most"), [pytest.param("flat", 14, marks=pytest.mark.slow), ("dark", 17)])
def test_memory_of_a_pass_is_a_few_arrays_of_a_frame(kind, most):
    """Of the size of one frame in float64: frames may have tens of megapixels."""
    frames = np.random.default_rng(2).normal(300, 9, (2, 1000, 1600)).astype(np.uint16)
    taken = Recording(frames, "RGGB", (200.0,) * 4, 4095.0, kind=kind, exposure_s=1.0)
    tracemalloc.start()
    frame_statistics(taken)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < most * 8 * frames[0].size


def test_the_channel_that_leaves_a_camera_without_gain_is_named():
    rng, light = np.random.default_rng(7), np.ones((96, 128))
    light[1::2, 1::2] = 3.0
    flat = recording(rng, 1000.0 * light, kind="flat", white_level=4095.0)
    found = transfer(flat, recording(rng, 0.0, white_level=4095.0)).baseline
    assert isinstance(found, NotMeasurable) and found.record.startswith("of B: values of all flats pile up")
