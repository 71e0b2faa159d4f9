"""Flats of many exposures, each with darks of its own, as EMVA 1288 has them recorded."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED, MECHANISMS
from cannoise_jax.physics.transfer.black import black_at, of_one_dark, reference_dark
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import find_mechanisms
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, transfer_at
from cannoise_jax.recordings.recording import Recording, per_channel

GAIN, READ, BLACK, LIGHT = 0.4, 5.0, 60.0, 9000.0
PRNU = 0.01
RESPONSE = 1 + PRNU * np.random.default_rng(0).standard_normal((72, 96))


def taken(seed, kind, seconds, rate, light=LIGHT, frames=4):
    """A linear camera under one steady light, e-/s, with a dark current of `rate` e-/s."""
    rng, size = np.random.default_rng(seed), (frames, 72, 96)
    lit = light if kind == "flat" else 0.0
    charge = rng.poisson(np.broadcast_to((lit * RESPONSE + rate) * seconds, size)) + rng.normal(0, READ, size)
    codes = np.clip(np.rint(BLACK + GAIN * charge), 0, 4095).astype(np.uint16)
    return Recording(
        codes, "MONO", per_channel(BLACK), 4095.0, kind=kind, exposure_s=None if kind == "bias" else seconds
    )


def series(times, rate, bias=False, zero=False, frames=4):
    plan = [(kind, t) for kind in ("flat", "dark") for t in times]
    plan += [("bias", 0.0)] * bias + [("dark", 0.0)] * zero
    return [
        frame_statistics(taken(n, kind, t, rate, frames=6 if kind == "bias" else frames))
        for n, (kind, t) in enumerate(plan)
    ]


@pytest.mark.parametrize(
    ("times", "rate", "more"),
    [
        pytest.param((0.03, 0.06, 0.09), 500.0, {}, marks=pytest.mark.slow),
        pytest.param(tuple(0.015 * n for n in range(1, 9)), 60.0, {"frames": 2}, marks=pytest.mark.slow),
        pytest.param((0.02, 0.05, 0.1), 400.0, {"bias": True}, marks=pytest.mark.slow),
        ((0.05, 0.1, 0.2), 300.0, {"zero": True}),
    ],
    ids=["three", "emva", "bias", "zero"],
)
def test_a_linear_camera_is_linear_and_its_gain_right(times, rate, more):
    transfer = of_all_pixels(transfer_at(series(times, rate, **more)))
    base = transfer.baseline
    assert np.mean(base.gain) == pytest.approx(GAIN, rel=0.015)
    first = 0.0 if {"bias", "zero"} & set(more) else times[0]
    assert np.mean(base.black_level) == pytest.approx(BLACK + GAIN * rate * first, abs=0.15)
    assert np.mean(base.read_noise_e) == pytest.approx(np.hypot(READ, np.sqrt(rate * first)), rel=0.03)
    found = {f.mechanism: f for f in find_mechanisms(transfer.statistics, base, LISTED)}
    assert found["nonlinearity"].measured is None
    loss = found["nonlinearity"].estimates["loss"]
    assert abs(loss.value) < 4 * loss.stderr and loss.stderr < 0.02
    assert found["dark_current"].estimates["e_per_s"].value == pytest.approx(rate, rel=0.1)
    # Noise of the dark charge, which stays in the flats, is no sensitivity.
    low, high = found["prnu"].estimates["sigma"].ci90
    assert low - 0.002 < PRNU < high + 0.002
    for s in (s for s in transfer.statistics if s.recording.kind == "flat"):
        assert np.mean(s.level[:4]) + np.mean(s.recording.black_level) - np.mean(base.black_level) == (
            pytest.approx(GAIN * LIGHT * s.recording.exposure_s, rel=0.01)
        )


def test_what_the_dark_charge_adds_is_said_beside_black_level_and_read_noise():
    shown = of_all_pixels(transfer_at(series((0.06, 0.12, 0.24), 400.0)))
    notes = {(q.name, q.unit): q.note for q in shown.quantities}
    level, noise = notes["black level", "DN"], notes["temporal dark noise", "DN"]
    assert "at 0.06 s, 2" in level and float(level.split("without ")[1].split()[0]) == pytest.approx(
        60, abs=0.1
    )
    assert float(noise.split("without ")[1].split()[0]) == pytest.approx(READ, rel=0.05)


def test_the_reference_is_the_shortest_dark_and_flats_between_darks_are_told_by_both():
    statistics = series((0.1, 0.4), 200.0)
    statistics.append(frame_statistics(taken(9, "flat", 0.25, 200.0)))
    dark = reference_dark(statistics)
    assert dark is not None and dark.recording.exposure_s == 0.1
    between = black_at(statistics, 0.25)
    assert between.certain and between.excess is not None
    assert np.mean(between.level) == pytest.approx(BLACK + GAIN * 200 * 0.25, abs=0.2)
    assert np.mean(between.excess) == pytest.approx(GAIN**2 * 200 * 0.15, rel=0.1)
    again = of_one_dark(of_one_dark(statistics))
    for one, two in zip(of_one_dark(statistics), again, strict=True):
        np.testing.assert_array_equal(one.mean, two.mean)


def test_darks_below_a_tenth_of_a_second_that_do_not_rise_count_as_one():
    statistics = [frame_statistics(taken(n, "dark", t, 0.0)) for n, t in enumerate((0.001, 0.05))]
    more = frame_statistics(taken(5, "dark", 0.05, 0.0, frames=12))
    assert reference_dark([*statistics, more]) is more
    flat = frame_statistics(taken(7, "flat", 0.02, 0.0))
    assert black_at([*statistics, more, flat], 0.02).level == per_channel(more.frame_means.mean(0))


def test_without_known_exposures_nothing_is_taken_out():
    statistics = [frame_statistics(dataclasses.replace(taken(n, k, 0.1, 50.0), exposure_s=None))
                  for n, k in enumerate(("flat", "dark"))]  # fmt: skip
    assert of_one_dark(statistics) == statistics
    assert not isinstance(transfer_at(statistics).baseline, str)
    assert MECHANISMS["dark_current"].estimator.measure(statistics) is not None
