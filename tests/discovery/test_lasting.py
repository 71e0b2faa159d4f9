"""A pattern that stays is in every recording; what follows the signal is none of places."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.claims import by_level, lasting, whatever_exposure
from cannoise_jax.discovery.search.name import Named
from cannoise_jax.discovery.search.steps import Step
from tests.discovery.capture import capture_set

SIGMA = 1.5


@pytest.mark.parametrize(
    "stays", [pytest.param("in all recordings", marks=pytest.mark.slow), "in each by itself"]
)
def test_rows_that_differ_from_recording_to_recording_are_no_fixed_pattern(stays):
    """Means of rows of equal variance in every recording, the same ones or others."""
    rng = np.random.default_rng(8)
    rows = rng.standard_normal((96, 1))
    own: dict[tuple, np.ndarray] = {}

    def alter(rng):
        def change(dn, signal, kind, t):
            new = rows if stays == "in all recordings" else rng.standard_normal((96, 1))
            return dn + 0.5 * SIGMA * own.setdefault((t, float(signal.mean())), new)

        return change

    capture = capture_set(3, alter, kinds="df", frames=6)
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    signature = next(s for s in prepared.signatures if s.name == "row_additive_static")
    score = signature.score(prepared.fields)
    assert score is not None and score.log_p < -20
    named = Named(score, signature, "row_fpn", (("row_fpn", 1.0),), False)
    found = lasting(Step(named, prepared.fields, score.log_p))
    assert (found is None) == (stays == "in all recordings")
    if found is not None:
        assert found.left > 0.6 and "in common" in found.against[0]


@pytest.mark.parametrize("flats", [pytest.param("as the darks", marks=pytest.mark.slow), "of their own"])
def test_columns_that_darks_share_and_flats_have_not_are_no_fixed_pattern(flats):
    """Darks of one level cannot tell offsets of columns from errors of their converters, which are another
    one's at another level."""
    rng = np.random.default_rng(9)
    own = {"dark": rng.standard_normal((1, 128))}

    def alter(rng):
        def change(dn, signal, kind, t):
            kind = "dark" if flats == "as the darks" else f"{kind} {signal.mean():.0f}"
            kind = "dark" if kind.startswith("dark") else kind
            return dn + SIGMA * own.setdefault(kind, rng.standard_normal((1, 128)))

        return change

    step = named_map(capture_set(3, alter, kinds="df", frames=6), "column_additive_static", "column_fpn")
    found = lasting(step)
    assert step.log_p < -20 and (found is None) == (flats == "as the darks")
    if found is not None:
        assert found.left > 0.6 and "darks and flats" in found.against[0]


def named_map(capture, name, mechanism):
    """A finding of one signature in all frames, under a name."""
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    signature = next(s for s in prepared.signatures if s.name == name)
    score = signature.score(prepared.fields)
    assert score is not None
    return Step(Named(score, signature, mechanism, ((mechanism, 1.0),), False), prepared.fields, score.log_p)


def test_what_rare_values_of_one_sign_lift_all_pixels_by_is_no_map():
    """The mean of a recording is that of most values: the few lift the means of pixels above it, everywhere
    and always, so that all recordings have that in common."""

    def lifted(rng):
        return lambda dn, signal, kind, t: dn + 100 * (rng.random(dn.shape) < 0.003)

    step = named_map(capture_set(3, lifted, kinds="df", frames=6), "pixel_additive_static", "dsnu")
    assert step.log_p < -5
    found = lasting(step)
    assert found is not None and "in common" in found.against[0]


def remembered_pixels(rng):
    """Noise of pixels of which half is that of the frame before, in one long dark."""
    last = rng.standard_normal((96, 128))

    def alter(dn, signal, kind, t):
        nonlocal last
        if kind == "dark" and t > 0.05:
            last = 0.6 * last + 0.8 * rng.standard_normal(dn.shape)
            dn = dn + 3 * last
        return dn

    return alter


def thermal_pixels(rng):
    """Pixels of unlike dark current, of exponential law."""
    rate = 10 * np.random.default_rng(2).exponential(1.0, (96, 128))
    return lambda dn, signal, kind, t: dn + rate * t / 0.1 * (kind == "dark")


@pytest.mark.parametrize(("alter", "stays"), [(thermal_pixels, True), (remembered_pixels, False)])
def test_what_grows_with_the_exposure_grows_in_every_recording(alter, stays):
    capture = capture_set(6, alter, kinds="df", frames=6)
    # Another one of the longer exposure, so that two recordings tell.
    more = capture_set(7, alter, kinds="d", frames=6).recordings[1]
    again = dataclasses.replace(more, path="9_dark.h5")
    capture = dataclasses.replace(capture, recordings=(*capture.recordings, again))
    found = lasting(named_map(capture, "pixel_thermal_static", "dsnu"))
    assert (found is None) == stays


@pytest.mark.parametrize(
    "strength", [0.12, pytest.param(0.3, marks=pytest.mark.slow), pytest.param(1.0, marks=pytest.mark.slow)]
)
def test_maps_that_stay_keep_their_name(strength):
    """Ten draws each, from just seen to as strong as the noise: none is doubted."""
    for seed in range(10):
        fixed = strength * 4.5 * np.random.default_rng(seed).standard_normal((96, 128))

        def alter(rng, fixed=fixed):
            return lambda dn, signal, kind, t: dn + fixed

        capture = capture_set(seed, alter, kinds="d", frames=5)
        assert lasting(named_map(capture, "pixel_additive_static", "dsnu")) is None


def wavy(rng):
    """A converter whose codes are off by a wave over the signal."""
    return lambda dn, signal, kind, t: dn + 12 * np.sin(2 * np.pi * (dn - 200) / 700) * (kind == "scene")


def wrong_light(rng):
    """References whose pixels are wrong, each by itself."""
    own: dict[float, np.ndarray] = {}

    def alter(dn, signal, kind, t):
        if kind != "scene":
            return dn
        return dn + own.setdefault(float(signal.mean()), 12 * rng.standard_normal(dn.shape))

    return alter


@pytest.mark.parametrize(("alter", "of_places"), [(wrong_light, True), (wavy, False)])
def test_what_follows_the_signal_is_no_error_of_single_pixels_of_a_reference(alter, of_places):
    step = named_map(capture_set(5, alter), "scene_static", "reference_error")
    assert step.log_p < -20
    found = by_level(step)
    assert (found is None) == of_places
    if found is not None:
        assert found.left > 0.5 and "signal" in found.against[0]


def test_darks_say_nothing_of_sensitivities():
    """One flat, and darks whose level grows, more in pixels that are less sensitive."""
    rng = np.random.default_rng(9)
    shape = rng.standard_normal((96, 128))
    gains, offsets = 0.01 * shape, SIGMA * (8 - 2 * shape)

    def alter(rng):
        return lambda dn, signal, kind, t: dn + gains * signal + offsets * t / 0.1 * (kind == "dark")

    capture = capture_set(4, alter, kinds="df", frames=6, size=(96, 128))
    capture = dataclasses.replace(capture, recordings=(*capture.recordings[:2], capture.recordings[-1]))
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    signature = next(s for s in prepared.signatures if s.name == "pixel_relative_static")
    score = signature.score(prepared.fields)
    assert score is not None and score.log_p < -20
    named = Named(score, signature, "prnu", (("prnu", 1.0),), False)
    assert lasting(Step(named, prepared.fields, score.log_p)) is None


@pytest.mark.parametrize("law", ["of the exposure", "of the frame", "of both"])
def test_hits_that_every_exposure_has_alike_are_none_of_particles(law):
    """Two adjoining pixels a hit; of both: particles that hit a slow read-out too."""

    def alter(rng):
        def change(dn, signal, kind, t):
            number = {"of the exposure": 400 * t, "of the frame": 20, "of both": 8 + 250 * t}[law]
            for _ in range(rng.poisson(number if kind == "dark" else 0)):
                y, x = rng.integers(0, 95), rng.integers(0, 127)
                dn[y, x : x + 2] += 200
            return dn

        return change

    step = named_map(capture_set(5, alter, kinds="d", frames=8), "hits", "cosmic_rays")
    assert step.log_p < -20
    found = whatever_exposure(step)
    assert (found is None) == (law != "of the frame")
    if found is not None:
        assert "short darks" in found.against[0]
