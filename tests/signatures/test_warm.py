"""A sensor that warms up while its darks are taken: by how much, and that nothing else is seen of it."""

import dataclasses

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.signatures import warm
from cannoise_jax.signatures.handed import Asked
from tests.discovery.beyond_camera import SIZE, frames_of, rejects, scores

FRAMES = 10
RISE = np.linspace(-3.0, 3.0, FRAMES)


def ramp(spread, rate=20.0, kelvin=RISE):
    """Dark charge, e-/s, whose pixels differ by a log-normal law, of frames of these temperatures."""
    own = rate * np.exp(spread * np.random.default_rng(4).standard_normal(SIZE))

    def add(e, rng, kind, seconds):
        change = 2 ** (kelvin / 6.3) if kind == "dark" else np.ones(len(e))
        return e + seconds * own * change[: len(e), None, None]

    return add


def captured(seed, mean=None, charge=None):
    return frames_of(seed, mean=mean, charge=charge, scenes=0, frames=FRAMES)


@pytest.mark.parametrize("spread", [0.5, pytest.param(0.1, marks=pytest.mark.slow), 0.03])
def test_a_steady_rise_has_its_size_however_little_the_pixels_differ(spread):
    """The contrasts hold the whole change, and where the map hardly shows the mean moves with the noise."""
    capture = captured(31, ramp(spread))
    found, fields, signatures = scores(capture)
    longest = splits_of(capture).frames[2][0]
    charge = 2 ** (RISE[longest] / 6.3)
    true = np.std(charge, ddof=1) / np.mean(charge)
    change = found["warm"].amplitude / (warm.DOUBLING_C / np.log(2))
    assert rejects(found["warm"]) and change == pytest.approx(true, rel=0.2 if spread > 0.05 else 0.4)
    left = warm.without_warmth(fields, found["warm"])
    again = signatures["warm"].score(left)
    assert again is None or not rejects(again)
    for f in left:
        if f.kind == "dark":
            near = f.contrasts[:, f.usable].clip(-8, 8)
            shared = near @ near.T / near.shape[1]
            assert np.allclose(shared / np.trace(shared) * len(shared), np.eye(len(shared)), atol=0.01)


@pytest.mark.slow
def test_frames_of_one_temperature_are_not_warm_by_their_offsets():
    """Beside a map of the dark current, whose pixels have more noise: an offset is less of it in these."""

    def offsets(e, rng, kind, seconds):
        return e + (kind == "dark") * 4 * rng.standard_normal((len(e), 1, 1))

    found = diagnose(captured(32, ramp(0.5, kelvin=np.zeros(FRAMES)), offsets), compare=False)
    assert "offset_drift" in found.findings and "temperature_drift" not in found.findings


@pytest.mark.slow
def test_nothing_else_is_found_of_a_sensor_that_warms_up():
    found = diagnose(captured(33, ramp(0.4)), compare=False)
    assert set(found.findings) <= {"temperature_drift", "dsnu", "dark_current", "hot_pixels"}
    assert {"temperature_drift", "dark_current"} <= set(found.findings)


@pytest.mark.parametrize("pixels", [1, 2])
def test_few_pixels_that_jump_are_no_warmth(pixels):
    """What a single one tells has no others to be held against, and two that agree may do so by chance."""
    capture = captured(34)
    jumps = np.random.default_rng(5).uniform(0, 4000, (len(capture.recordings), FRAMES))
    for r, added in zip(capture.recordings, jumps, strict=True):
        if r.kind == "dark":
            r.frames[:, 40, 50 : 50 + 20 * pixels : 20] += (added * (r.exposure_s > 1)).astype(np.uint16)[
                :, None
            ]
    fields = splits_of(capture).looking.fields
    score = warm.warm_score(fields)
    assert score is None or not rejects(score)


def test_offsets_of_frames_stay_where_one_exposure_shows_a_map_that_moves():
    """What whole frames share may then be a pedestal's, and is left for it."""

    def offsets(e, rng, kind, seconds):
        return e + 6 * rng.standard_normal((len(e), 1, 1))

    capture = captured(35, ramp(0.5), offsets)
    longest = max(r.exposure_s for r in capture.recordings if r.kind == "dark")
    kept = tuple(r for r in capture.recordings if r.kind != "dark" or r.exposure_s == longest)
    for part, held in ((capture, False), (dataclasses.replace(capture, recordings=kept), True)):
        first = splits_of(part).looking
        signatures = {s.name: s for s in first.signatures}
        looked = warm.warm_score(first.fields)
        assert looked is not None and looked.payload.thermal != held
        left = signatures["frame_additive"].score(warm.without_warmth(first.fields, looked))
        assert rejects(left) == held and ("frame_additive" not in signatures["warm"].hides(looked)) == held


def test_no_limit_in_kelvin_stands_where_no_dark_current_is_told():
    found, fields, signatures = scores(captured(35, ramp(0.5)))
    longest = max(f.exposure_s for f in fields if f.kind == "dark")
    of_one = tuple(f for f in fields if f.kind != "dark" or f.exposure_s == longest)
    several, one = (
        signatures["warm"].detectable(Asked((looked,), -10.0, 1.0, 1.0), found["warm"], "temperature_drift")
        for looked in (fields, of_one)
    )
    assert np.isfinite(several) and not np.isfinite(one)
