"""Noise along the scan is as strong at the end of a row as at its start."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.whole_scans import in_places
from cannoise_jax.discovery.search.name import UNKNOWN, Named
from cannoise_jax.discovery.search.steps import Step
from tests.discovery.capture import capture_set


def pink(exponent, sigma):
    def alter(rng):
        def change(dn, *_):
            frequency = np.arange(1, dn.size + 1) ** (-exponent / 2)  # of two frames, of which one is drawn
            modes = np.concatenate([[0], frequency * (rng.standard_normal((2, dn.size)).T @ [1, 1j])])
            series = np.fft.irfft(modes, 2 * dn.size)
            return dn + sigma * (series / series.std())[: dn.size].reshape(dn.shape)

        return change

    return alter


def settling(pixels, from_right):
    """From a level of its own at one end of every row."""

    def alter(rng):
        def change(dn, *_):
            fall = np.exp(-np.arange(dn.shape[1]) / pixels)
            fall = fall[::-1] if from_right else fall
            return dn + 3 * rng.standard_normal((dn.shape[0], 1)) * fall

        return change

    return alter


def step_of(alter, name="pink_noise"):
    capture = capture_set(5, alter, read=2.0, kinds="d")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    (signature,) = (s for s in prepared.signatures if s.name == "raster_slope")
    score = signature.score(prepared.fields)
    named = Named(score, signature, name, ((name, 1.0),), False)
    return Step(named, prepared.fields, score.log_p)


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.5])
@pytest.mark.parametrize("sigma", [0.6, 3.0])
def test_noise_along_the_scan_passes(exponent, sigma):
    step = step_of(pink(exponent, sigma))
    assert step.log_p < -10 and in_places(step) is None


@pytest.mark.parametrize("pixels", [9, 16])
@pytest.mark.parametrize("from_right", [False, True])
def test_rows_that_settle_are_no_noise_along_the_scan(pixels, from_right):
    step = step_of(settling(pixels, from_right))
    doubt = in_places(step)
    assert step.log_p < -10 and doubt is not None and doubt.left > 0.5
    assert ("columns 0 to" in doubt.against[0]) != from_right


def test_nothing_is_said_of_what_has_no_name():
    assert in_places(step_of(settling(9, False), UNKNOWN)) is None
