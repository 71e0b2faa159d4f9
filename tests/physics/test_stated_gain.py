"""A header's gain is checked against the measured one, and never used."""

import dataclasses

import numpy as np
import pytest

from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.physics.transfer.stated_gain import gain_note
from cannoise_jax.physics.transfer.table import format_transfer
from cannoise_jax.recordings.recording import CaptureSet, Recording

GAIN = 0.5  # DN/e-, so 2 e-/DN


def made(kind, electrons, seed, egain):
    rng = np.random.default_rng(seed)
    values = 200 + GAIN * (rng.poisson(electrons, (8, 64, 64)) + rng.normal(0, 5, (8, 64, 64)))
    frames = np.rint(values).astype(np.uint16)
    return Recording(frames, "MONO", (200.0,) * 4, 65535.0, kind=kind, exposure_s=1.0, egain=egain)


def result(egain):
    return photon_transfer(CaptureSet("c", (made("dark", 0, 1, egain), made("flat", 20000, 2, egain))))[0]


@pytest.mark.parametrize(
    ("egain", "words"), [(2.0, "they agree"), (1.0, "disagree beyond the error (+"), (2.6, "(-")]
)
def test_a_stated_gain_is_judged_by_the_error_of_the_measured_one(egain, words):
    (note,) = [n for n in format_transfer(result(egain)).splitlines() if n.startswith("the files state")]
    assert words in note and f"{egain:g} e-/DN" in note


def test_what_is_stated_is_not_used_and_nothing_is_said_of_nothing():
    assert "the files state" not in format_transfer(result(None))
    assert gain_note([made("dark", 0, 1, 2.0)], [], []) is None
    told, untold = result(7.0).baseline, result(None).baseline
    np.testing.assert_equal(dataclasses.asdict(told), dataclasses.asdict(untold))


def test_several_gains_at_one_setting_are_said():
    both = [made("flat", 100, 1, 2.0), made("flat", 100, 2, 3.0)]
    assert "several gains, 2, 3 e-/DN" in gain_note(both, [0.5], [0.01])


def test_what_is_stated_has_its_rounding():
    """2.0 is said of anything from 1.95 to 2.05."""
    lit = [made("flat", 100, 1, 2.0)]
    assert "they agree" in gain_note(lit, [1 / 2.045], [1e-9]) and "disagree" in gain_note(
        lit, [1 / 2.06], [1e-9]
    )
