"""A camera that sets its black level by the exposure is drawn with the levels that its darks had."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.discovery.search.dark_level import added_level
from cannoise_jax.discovery.search.model import baseline_model
from cannoise_jax.discovery.search.pedestal import with_pedestals
from cannoise_jax.mechanisms.pedestal import PEDESTAL
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.recordings.recording import CaptureSet
from tests.discovery.capture import capture_set

SIZE = (64, 64)


def clamped(by_site, seed=1):
    """Darks of which those of the longer exposure lie elsewhere, by so much at each site."""
    rows, columns = np.indices(SIZE)
    shift = np.asarray(by_site, float)[2 * (rows % 2) + columns % 2]
    return capture_set(
        seed,
        lambda rng: (
            lambda dn, signal, kind, t: dn + (shift if t > 0.05 else 0.0) + 0.1 * rng.standard_normal()
        ),
        kinds="df",
        size=SIZE,
    )


def levelled(capture):
    first = prepare_split(capture, split_recordings(capture))
    bare = baseline_model(capture, first)
    return bare, with_pedestals(bare, first)


def drawn_levels(model, seconds):
    dn = model.sample(jax.random.key(3), np.zeros(SIZE, np.float32), Settings(100.0, seconds, None, 64))
    mean = np.asarray(dn, float).mean(0)
    return np.array([mean[i::2, j::2].mean() for i in (0, 1) for j in (0, 1)])


def test_levels_are_those_of_the_darks_and_lie_between_in_between():
    shift = np.array([-6.0, 4.0, 3.0, -5.0])
    bare, model = levelled(clamped(shift))
    assert all(f.mechanism == "pedestal" for f in model.mechanisms) and len(model.mechanisms) == 2
    for seconds, share in ((0.01, 0.0), (0.001, 0.0), (0.1, 1.0), (5.0, 1.0), (0.055, 0.5)):
        np.testing.assert_allclose(drawn_levels(model, seconds), 200 + share * shift, atol=0.35)
    closed = np.asarray(model.expected(np.zeros(SIZE, np.float32), Settings(100.0, 0.1)))
    np.testing.assert_allclose(closed[0, :2], 200 + shift[:2], atol=0.35)
    np.testing.assert_allclose(drawn_levels(bare, 0.1), 200, atol=0.35)


@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(n, marks=pytest.mark.slow) for n in range(4, 12))]
)
def test_darks_that_lie_where_they_should_get_none(seed):
    assert not levelled(clamped(np.zeros(4), seed))[1].mechanisms


def test_one_exposure_or_several_gains_or_no_darks_get_none():
    capture = clamped(np.full(4, 9.0))
    one = tuple(r for r in capture.recordings if r.kind != "dark" or r.exposure_s < 0.05)
    flats = tuple(r for r in capture.recordings if r.kind != "dark")
    dark = next(r for r in capture.recordings if r.kind == "dark")
    gains = (*capture.recordings, dataclasses.replace(dark, iso=800.0))
    for some in (one, flats, gains):
        assert not levelled(CaptureSet("c", some, None))[1].mechanisms


def test_it_is_kept_in_a_file_and_files_without_newer_parameters_are_read(tmp_path):
    _, model = levelled(clamped(np.full(4, 9.0)))
    model = model.with_mechanism("odd_even_row_noise", sigma_dn=2.0)
    path = tmp_path / "sensor.json"
    model.save(path)
    read = SensorModel.load(path)
    assert [f.record for f in read.mechanisms].count(PEDESTAL) == 2
    np.testing.assert_array_equal(drawn_levels(read, 0.1), drawn_levels(model, 0.1))
    document = json.loads(path.read_text())
    for entry in document["mechanisms"]:
        for name in ("rows", "before"):
            entry["parameters"].pop(name, None)
    path.write_text(json.dumps(document))
    np.testing.assert_array_equal(drawn_levels(SensorModel.load(path), 0.1), drawn_levels(model, 0.1))


def test_charge_in_the_unit_of_a_gain_that_is_not_known_better_is_no_level():
    """Darks of a hundred codes of charge move by parts of a code with the gain of each site."""
    rate, gain = 900.0, 1.5
    capture = capture_set(
        4,
        lambda rng: (
            lambda dn, signal, kind, t: dn + gain * rng.poisson(rate * t * (kind == "dark"), dn.shape)
        ),
        kinds="df",
        size=SIZE,
        gain=gain,
    )
    first = prepare_split(capture, split_recordings(capture))
    bare, (baseline,) = baseline_model(capture, first), first.baselines
    for times, moved in ((1.0, False), (8.0, True)):
        away = 1 + times * np.array([1.0, -1.0, 1.0, -1.0]) * baseline.gain_stderr / gain
        shortest = np.asarray(bare.black_level) - gain * away * rate * 0.01
        model = dataclasses.replace(
            bare, gain_dn_per_e=np.array([gain * away], np.float32), black_level=np.float32(shortest)
        ).with_mechanism("dark_current", e_per_s=rate)
        added = with_pedestals(model, first).mechanisms[1:]
        assert bool(added) == moved, times


def test_hits_that_a_model_has_lower_no_level():
    """The mean charge of hits is in the pixels that are hit: the others lie where they did."""
    rate, charge = 40_000.0, 300.0

    def struck(rng):
        def change(dn, signal, kind, t):
            hit = (rng.random(SIZE) < rate * 1e-6 * t) * (kind == "dark")
            return dn + 1.5 * hit * rng.exponential(charge, SIZE)

        return change

    capture = capture_set(6, struck, kinds="df", size=SIZE)
    first = prepare_split(capture, split_recordings(capture))
    model = baseline_model(capture, first).with_mechanism("cosmic_rays", rate=10 * rate, charge_e=charge)
    drawn = model.expected(np.zeros(SIZE, np.float32), Settings(100.0, 0.1))
    assert float(np.mean(drawn)) > 200.0 + 10.0  # hits ten times too many are no reason for another level
    assert not any(f.record == PEDESTAL for f in with_pedestals(model, first).mechanisms)


def test_ordinary_pixels_keep_their_level_beside_hot_ones_in_the_model():
    """Few hot pixels, which the model has, lie far above all others: the level is of these."""
    heat = np.zeros(SIZE, np.float32)
    at = np.random.default_rng(7).choice(heat.size, 40, replace=False)
    heat.ravel()[at] = np.linspace(40, 300, 40)

    def hot(rng):
        return lambda dn, signal, kind, t: dn + (heat * t * 10 if kind == "dark" else 0.0)

    capture = capture_set(3, hot, kinds="df", size=SIZE)
    first = prepare_split(capture, split_recordings(capture))
    bare = baseline_model(capture, first)
    rate = heat * 10 / 1.5
    mean = float(rate[rate > 0].mean())
    model = bare.with_mechanism("hot_pixels", e_per_s=mean, fraction=0.01, maps={"heat": rate[None] / mean})
    assert not with_pedestals(model, first).mechanisms[1:]


@pytest.mark.parametrize("named", [True, False])
def test_what_code_zero_cuts_off_is_no_level(named):
    """Darks whose mean is lifted there are drawn as they are, whether or not a mechanism says so."""
    capture = capture_set(5, kinds="df", size=SIZE, gain=0.8, black=3.0)
    first = prepare_split(capture, split_recordings(capture))
    bare = baseline_model(capture, first)
    model = bare.with_mechanism("black_clipping", level_dn=-3.0) if named else bare
    assert not with_pedestals(model, first).mechanisms[named:]
    dark = next(s for s in first.stacks if s.recording.kind == "dark")
    np.testing.assert_allclose(added_level(model, bare, dark, Settings(100.0, 0.01)), 0, atol=1e-3)
