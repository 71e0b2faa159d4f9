"""Cameras whose black level is another one at every gain."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.discovery.search.model import baseline_model
from cannoise_jax.physics.core import registry
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import black_at
from cannoise_jax.physics.transfer.maps import without_charge
from cannoise_jax.recordings.recording import CaptureSet
from tests.discovery.capture import capture_set

SIZE = (64, 64)
LEVELS = {100.0: 200.0, 800.0: 460.0}


def two_gains(stated=None):
    """Darks and flats at two gains, stated at the levels that they have or at `stated` by ISO."""
    out = []
    for n, (iso, black) in enumerate(LEVELS.items()):
        capture = capture_set(
            5 + n, lambda rng, up=black - 200.0: lambda dn, *_: dn + up, kinds="df", size=SIZE
        )
        said = (stated or LEVELS)[iso]
        out += [
            dataclasses.replace(r, iso=iso, path=f"{n}{r.path}", black_level=(said,) * 4)
            for r in capture.recordings
        ]
    return CaptureSet("c", tuple(out), None)


def test_each_gain_is_drawn_at_its_own_level():
    capture = two_gains()
    model = baseline_model(capture, prepare_split(capture, split_recordings(capture)))
    for iso, black in LEVELS.items():
        drawn = model.sample(jax.random.key(1), np.zeros(SIZE, np.float32), Settings(iso, 0.01, None, 8))
        assert float(np.mean(np.asarray(drawn, float))) == pytest.approx(black, abs=0.5)
        closed = np.asarray(model.expected(np.zeros(SIZE, np.float32), Settings(iso)))
        np.testing.assert_allclose(closed, black, atol=0.5)
        # Of clean light the signal is what lies between that level and white.
        lit = np.asarray(model.expected(np.full(SIZE, 0.25, np.float32), Settings(iso)))
        white = float(np.asarray(model.white_level))
        np.testing.assert_allclose(lit, black + 0.25 * (white - black), rtol=1e-3)


@pytest.mark.filterwarnings("ignore::cannoise_jax.physics.core.sensor.ExtrapolationWarning")
def test_levels_by_gain_are_kept_in_a_file(tmp_path):
    blacks = np.array([[100.0, 101, 102, 103], [300, 301, 302, 303]])
    model = SensorModel.poisson_gaussian([0.5, 4.0], [3.0, 2.0], blacks, 4095.0, iso=(100.0, 800.0))
    model.save(tmp_path / "sensor.json")
    read = SensorModel.load(tmp_path / "sensor.json")
    np.testing.assert_array_equal(read.black_beyond, [[0] * 4, [200] * 4])
    for iso, level in ((100.0, 100.0), (450.0, 200.0), (1600.0, 300.0)):
        assert float(read.expected(np.zeros((4, 4), np.float32), Settings(iso))[0, 0]) == pytest.approx(level)
    same = SensorModel.poisson_gaussian([0.5, 4.0], [3.0, 2.0], 100.0, 4095.0, iso=(100.0, 800.0))
    same.save(tmp_path / "same.json")
    assert "black_level" not in (tmp_path / "same.json").read_text().split('"baseline"')[1]


def test_levels_of_another_number_of_gains_are_refused():
    with pytest.raises(ValueError, match="black levels"):
        SensorModel.poisson_gaussian([0.5, 4.0], [3.0, 2.0], np.full((3, 4), 9.0), iso=(100.0, 800.0))


@pytest.mark.parametrize(("stated", "off"), [(None, None), ({100.0: 200.0, 800.0: 440.0}, 20.0)])
def test_a_level_is_judged_against_what_is_stated_at_its_gain(stated, off):
    capture = two_gains(stated)
    first = prepare_split(capture, split_recordings(capture))
    signature = next(s for s in first.signatures if s.name == "black_level")
    score = signature.score(first.fields)
    if off is None:
        assert score.log_p > np.log(1e-3)
    else:
        assert score.amplitude == pytest.approx(off, abs=0.5) and score.log_p < np.log(1e-6)


@pytest.mark.parametrize("charge", [pytest.param(0.0, marks=pytest.mark.slow), 100.0])
def test_the_charge_of_the_darks_is_left_out_of_the_level_of_every_gain(charge):
    """Levels of 100 and 300 DN, measured on darks of a second that hold 100 electrons, or none."""
    measured = np.array([[100.0] * 4, [300.0] * 4]) + charge * np.array([[0.5], [4.0]])
    model = SensorModel.poisson_gaussian(
        [0.5, 4.0], np.sqrt([9.0 + charge, 4.0 + charge]), measured, 65535.0, iso=(100.0, 800.0)
    )
    if charge:
        law = dataclasses.replace(registry.mechanism("dark_current").scaling, doubling_c=None)
        model = model.with_mechanism("dark_current", scaling=law, e_per_s=charge)
    bare = without_charge(model, [1.0, 1.0], SIZE)
    for iso, level, read, n in ((100.0, 100.0, 3.0, 0), (800.0, 300.0, 2.0, 1)):
        assert np.asarray(black_at(bare, iso)) == pytest.approx([level] * 4, abs=0.1)
        assert np.asarray(bare.read_noise_e)[n] == pytest.approx([read] * 4, rel=0.01)


def test_long_darks_alone_at_one_gain_are_no_wrong_level():
    """What they collect is known from the other gain."""

    def warm(rng):
        return lambda dn, signal, kind, t: dn + 1.5 * rng.poisson(300.0 * t, dn.shape)

    first = capture_set(8, warm, kinds="df", size=SIZE)
    long = next(r for r in first.recordings if r.kind == "dark" and r.exposure_s > 0.05)
    other = [long, *(r for r in first.recordings if r.kind == "flat")]
    more = [dataclasses.replace(r, iso=200.0, path=f"b{r.path}") for r in other]
    capture = CaptureSet("c", (*first.recordings, *more), None)
    prepared = prepare_split(capture, split_recordings(capture))
    score = next(s for s in prepared.signatures if s.name == "black_level").score(prepared.fields)
    assert score.log_p > np.log(1e-4)
