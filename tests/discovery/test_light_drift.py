"""A lamp that drifts in brightness and in colour, told from one lit recording beside darks."""

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.discovery.search.declare import registered
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.discovery.search.model import extended_model
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.recordings.recording import CaptureSet
from tests.discovery.capture import capture_set

SIZE = (64, 96)


def lamp(common, colour):
    """Factors of the light, new in every frame: one for all, and one for each colour, the greens alike."""

    def alter(rng):
        def change(dn, signal, kind, exposure):
            red, green, blue = rng.standard_normal(3)
            site = np.array([red, green, green, blue])[
                2 * (np.arange(SIZE[0])[:, None] % 2) + np.arange(SIZE[1])[None] % 2
            ]
            return dn + signal * (common * rng.standard_normal() + colour * site)

        return change

    return alter


def prepared(alter, flats=1):
    """Darks and flats of so many levels, and the frames of them that look."""
    whole = capture_set(4, alter, kinds="df", size=SIZE, frames=16)
    lit = [r for r in whole.recordings if r.kind == "flat"][-flats:]
    capture = CaptureSet(whole.camera, (*(r for r in whole.recordings if r.kind == "dark"), *lit))
    return capture, prepare_split(capture, split_recordings(capture))


def looked_at(alter, flats=1):
    """What is found in them."""
    capture, first = prepared(alter, flats)
    fitted = stepwise(first.fields, first.signatures, frozenset(e.id for e in registered()), np.log(0.01))
    return capture, first, fitted


def names(fitted):
    return {s.named.signature.name for s in fitted.steps}


@pytest.mark.parametrize("flats", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_drift_of_brightness_is_named_and_none_of_the_offset(flats):
    _, _, fitted = looked_at(lamp(0.01, 0.0), flats)
    assert [s.named.mechanism for s in fitted.steps] == ["illumination_drift"]
    assert fitted.steps[0].named.score.amplitude == pytest.approx(0.01, rel=0.5)


def test_drift_of_colour_is_found_beside_that_of_brightness_and_simulated():
    capture, first, fitted = looked_at(lamp(0.02, 0.005))
    assert names(fitted) == {"frame_relative", "site_relative_redrawn"}
    model = extended_model(capture, first, fitted.steps)
    drawn = np.asarray(
        model.sample(jax.random.key(0), np.full(SIZE, 0.6, np.float32), Settings(100.0, 0.01, None, 200)),
        float,
    )
    sites = np.stack([drawn[:, i::2, j::2].mean((1, 2)) for i in (0, 1) for j in (0, 1)], 1) / drawn.mean()
    apart = {s.named.signature.name: s.named.score.amplitude for s in fitted.steps}
    between = (sites - sites.mean(1, keepdims=True)).std() / np.sqrt(3 / 4)
    assert between == pytest.approx(apart["site_relative_redrawn"], rel=0.1)
    assert sites.mean(1).std() == pytest.approx(
        np.hypot(apart["frame_relative"], apart["site_relative_redrawn"] / 2), rel=0.15
    )


@pytest.mark.slow
def test_steady_light_has_no_drift():
    assert not looked_at(None)[2].steps


def test_offsets_that_drift_in_the_dark_are_none_of_the_light():
    _, _, fitted = looked_at(lambda rng: lambda dn, signal, kind, t: dn + 1.5 * rng.standard_normal())
    assert [s.named.mechanism for s in fitted.steps] == ["offset_drift"]


def sky(rng):
    """Light that leans to another side in every frame."""
    y, x = (np.linspace(-1, 1, n) for n in SIZE)

    def change(dn, signal, kind, exposure):
        down, across = 0.03 * rng.uniform(-1, 1, 2)
        return dn + signal * (down * y[:, None] + across * x)

    return change


def test_light_that_leans_leaves_the_gain():
    plain, leaning = (prepared(alter)[1].baselines[0].gain for alter in (lamp(0.0, 0.0), sky))
    assert np.mean(leaning) == pytest.approx(np.mean(plain), rel=0.025)
