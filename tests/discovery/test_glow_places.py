"""A glow beside what looks like it: charge of pixels, hot ones, a bias of no exposure, steps in offset."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.heat import above_neighbours
from cannoise_jax.signatures.taps import Taps
from tests.discovery.capture import SIZE, capture_set
from tests.discovery.looks import white

Y, X = np.indices(SIZE)
GLOW = np.exp(-np.hypot(Y - SIZE[0], X - SIZE[1]) / 30)


def with_bias(made: CaptureSet) -> CaptureSet:
    """The shorter darks as a bias of no exposure."""
    shortest = min(r.exposure_s for r in made.recordings if r.kind == "dark")
    changed = (
        dataclasses.replace(r, exposure_s=0.0) if r.kind == "dark" and r.exposure_s == shortest else r
        for r in made.recordings
    )
    return dataclasses.replace(made, recordings=tuple(changed))


def warm(height, *, offsets=0.0, hot=0.0):
    """Dark charge of the longer darks alone: a glow, single hot pixels, and offsets of all darks."""

    def alter(rng):
        charge = height * GLOW + rng.exponential(1.0, SIZE) + 150 * (rng.random(SIZE) < hot)
        gain = 1.5

        def change(dn, signal, kind, exposure):
            more = gain * rng.poisson(charge) if kind == "dark" and exposure > 0.05 else 0.0
            return dn + more + offsets * (kind == "dark")

        return change

    return alter


@pytest.mark.slow
def test_a_glow_grows_from_a_bias_of_no_exposure():
    found = diagnose(with_bias(capture_set(90, warm(60.0, hot=0.003), kinds="df")), compare=False)
    steps = {s.named.mechanism: s.named.score for s in found.fitted.steps}
    assert steps["amp_glow"].payload.longest == pytest.approx(0.1)
    assert steps["amp_glow"].amplitude == pytest.approx(1.5 * 60 * np.sqrt(np.mean(GLOW**2)), rel=0.2)
    # Pixels of the corner are high, and not hot.
    assert steps["hot_pixels"].parameters["fraction"][0] == pytest.approx(0.003, rel=0.6)


@pytest.mark.slow
def test_a_step_in_offset_is_no_glow():
    step = Taps(np.array([[-2.0], [2.0]])).image(SIZE)
    found = diagnose(with_bias(capture_set(91, warm(0.0, offsets=step), kinds="df")), compare=False)
    assert "amplifier_mismatch" in found.findings and "amp_glow" not in found.findings


def test_levels_around_are_taken_only_where_they_differ():
    fields = white(np.random.default_rng(3))
    before = [f for f in fields if not f.lit][0]
    sums = above_neighbours(fields, "additive")
    shown = [f for f in fields if not f.lit and f.static is not None]
    plain = sum(np.sqrt(f.frames) * f.static * f.weight for f in shown)
    assert np.abs(sums.score - plain).max() < 0.2 * np.abs(plain).std()
    fall = 40 * np.exp(-np.hypot(*np.indices(before.mean.shape)) / 20)
    raised = tuple(f if f.lit else f._replace(static=(f.static + fall).astype(np.float32)) for f in fields)
    z = above_neighbours(raised, "additive")
    root = np.sqrt(z.information)
    around = sum(np.sqrt(f.frames) * fall * f.weight for f in shown)
    assert np.mean(z.score > 5 * root) < 0.1 * np.mean(plain + around > 5 * root)
