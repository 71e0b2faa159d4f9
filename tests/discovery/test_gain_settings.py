"""Several gain settings: what comes before the gain has one strength, quoted at the lowest setting."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax import Settings
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings, splits_of
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.fields import native, referred

SIZE = (64, 96)
BLACK, READ = 500.0, 2.0
GAINS = {100.0: 0.5, 400.0: 2.0, 1600.0: 8.0}
ROWS, PIXELS, CURRENT = 0.8, 0.6, 0.5
"""Row noise and offsets of pixels, e-, dark current, e-/s."""


BEHIND = 1.6
"""Row noise and offsets of columns that are added behind the gain, DN."""


def camera(seed=0, before=1.0, behind=0.0, pixels=0.0):
    """Biases, darks and flats at three gain settings in plain NumPy, with so much of what is added before the
    gain, and behind it; pixels: offsets of theirs behind it, DN."""
    rng = np.random.default_rng(seed)
    offsets = before * PIXELS * rng.standard_normal(SIZE)
    uneven = CURRENT * rng.gamma(4.0, 0.25, SIZE)
    columns = behind * BEHIND * rng.standard_normal((1, SIZE[1]))
    columns = columns + pixels * rng.standard_normal(SIZE) if pixels else columns
    out = []
    for iso, gain in GAINS.items():
        shots = (("bias", 1e-3, 0.0), ("dark", 20.0, 0.0), ("flat", 0.01, 400.0), ("flat", 0.01, 1200.0))
        for kind, seconds, light in shots:
            charge = rng.poisson(light + before * uneven * seconds, (8, *SIZE)) + offsets
            charge = charge + READ * rng.standard_normal(charge.shape)
            charge = charge + before * ROWS * rng.standard_normal((8, SIZE[0], 1))
            added = columns + behind * BEHIND * rng.standard_normal((8, SIZE[0], 1)) if behind else columns
            codes = np.clip(np.round(BLACK + gain * charge + added), 0, 16383).astype(np.uint16)
            out.append(
                Recording(codes, "RGGB", (BLACK,) * 4, 16383.0, kind=kind, exposure_s=seconds, iso=iso)
            )
    return CaptureSet("camera", tuple(out))


@pytest.fixture(scope="module")
def found():
    return diagnose(camera(), compare=False)


def test_strengths_hold_at_the_lowest_setting(found):
    scores = {s.named.mechanism: s.named.score for s in found.fitted.steps}
    assert scores["row_noise"].amplitude == pytest.approx(0.5 * ROWS, rel=0.1)
    assert scores["dsnu"].amplitude == pytest.approx(0.5 * PIXELS, rel=0.1)
    assert scores["dark_current"].amplitude == pytest.approx(CURRENT, rel=0.1)


def test_the_camera_model_has_them_at_every_setting(found):
    """Row noise, DN, of draws without light."""
    for iso, gain in GAINS.items():
        frames = np.asarray(
            found.model.sample(jax.random.key(1), jnp.zeros(SIZE), Settings(iso, 1e-3, frames=16))
        )
        rows = frames[:, :, ::2].mean(2)
        moving = (rows - rows.mean(0) - rows.mean(1, keepdims=True)).std() * np.sqrt(16 / 15)
        pixels = np.hypot(gain * READ, 0.3) / np.sqrt(SIZE[1] / 2)
        assert np.sqrt(moving**2 - pixels**2) == pytest.approx(gain * ROWS, rel=0.2)


def test_so_has_it_what_grows_with_the_exposure(found):
    """Offsets of pixels of long darks beyond those of biases, DN, of draws."""
    for iso, gain in GAINS.items():
        dark, bias = (
            np.asarray(found.model.sample(jax.random.key(2), jnp.zeros(SIZE), Settings(iso, s, frames=32)))
            for s in (20.0, 1e-3)
        )
        more = (dark.mean(0) - bias.mean(0)).var() - (dark.var(0) + bias.var(0)).mean() / 31
        assert np.sqrt(more) == pytest.approx(gain * 20.0 * CURRENT / 2, rel=0.2)


def test_units_there_and_back_are_the_same():
    capture = camera(1)
    for f in prepare(capture, all_frames(split_recordings(capture)), False).fields:
        assert f.unit == pytest.approx(GAINS[capture.recordings[f.number].iso] / 0.5, rel=0.03)
        back = referred(native(f), f.unit)
        for name in ("mean", "signal", "sigma", "gain", "step"):
            assert np.allclose(getattr(back, name), getattr(f, name), rtol=1e-5)
        assert np.array_equal(back.contrasts, f.contrasts) and native(f).step == pytest.approx(1.0)


@pytest.mark.slow
def test_frames_held_back_are_in_the_units_of_those_that_look():
    splits = splits_of(camera(2))
    units = {f.number: f.unit for f in splits.looking.fields}
    for other in (splits.held_back, splits.together):
        assert {f.number: f.unit for f in other.fields} == units


@pytest.fixture(scope="module")
def behind():
    return diagnose(camera(3, before=0.0, behind=1.0), compare=False)


@pytest.mark.slow
@pytest.mark.parametrize("seed", (6, 9, 11))
def test_strong_columns_are_no_gains_of_columns(seed):
    """The smooth surface of a flat takes up nothing of what the darks show of columns."""
    fitted = diagnose(camera(seed, before=0.0, behind=1.0), compare=False).fitted
    assert "column_gain" not in {s.named.mechanism for s in fitted.steps}


def test_what_is_added_behind_the_gain_is_the_same_number_of_codes(behind):
    found = {s.named.mechanism: s.named for s in behind.fitted.steps}
    for mechanism in ("row_noise", "column_fpn"):
        assert found[mechanism].signature.axes.scales == "codes"
        assert found[mechanism].score.amplitude == pytest.approx(BEHIND, rel=0.2)
    assert not {"row_pink_noise", "column_noise", "column_gain", "dsnu"} & set(found)


def test_the_camera_model_adds_it_behind_the_gain(behind):
    """Row noise and offsets of columns, DN, of draws without light."""
    for iso, gain in GAINS.items():
        frames = np.asarray(
            behind.model.sample(jax.random.key(1), jnp.zeros(SIZE), Settings(iso, 1e-3, frames=16))
        )
        columns = frames.mean((0, 1))
        pixels = np.hypot(gain * READ, 0.3)
        assert np.sqrt(columns.var() - pixels**2 / 16 / SIZE[0]) == pytest.approx(BEHIND, rel=0.2)
        rows = frames[:, :, ::2].mean(2)
        moving = (rows - rows.mean(0) - rows.mean(1, keepdims=True)).std() * np.sqrt(16 / 15)
        assert np.sqrt(moving**2 - pixels**2 / (SIZE[1] / 2)) == pytest.approx(BEHIND, rel=0.25)


def test_frames_held_back_at_every_gain_confirm_both(found, behind):
    """Frames are scored as they were recorded, whatever units the findings are in."""
    for result in (found, behind):
        proofs = dict(zip((s.named.mechanism for s in result.fitted.steps), result.proofs, strict=True))
        for mechanism in {"row_noise", "dsnu", "column_fpn"} & set(proofs):
            assert proofs[mechanism].basis == "likelihood" and proofs[mechanism].confirmed


@pytest.mark.slow
def test_frames_held_back_at_one_gain_alone_are_looked_at():
    """The other gain has recordings of two frames only, all of which look."""
    capture = camera(4, before=1.0, behind=1.0)
    few = [r for r in capture.recordings if r.iso == 100.0]
    pairs = [
        dataclasses.replace(r, frames=r.frames[:2])
        for r in capture.recordings
        if r.iso == 1600.0 and r.kind in ("bias", "flat")
    ]
    mixed = CaptureSet("camera", (*few, *pairs[:2]))
    assert {
        r.iso for r, (_, held) in zip(mixed.recordings, split_recordings(mixed), strict=True) if held
    } == {100.0}
    result = diagnose(mixed, compare=False)
    assert result.fitted.steps and len(result.proofs) == len(result.fitted.steps)


@pytest.mark.slow
def test_offsets_of_pixels_behind_the_gain_are_the_same_number_of_codes():
    """As a map before the gain they would be too weak at one gain and too strong at another."""
    result = diagnose(camera(5, before=0.0, pixels=1.2), compare=False)
    (step,) = (s for s in result.fitted.steps if s.named.mechanism == "dsnu")
    assert step.named.signature.axes.scales == "codes"
    assert step.named.score.amplitude == pytest.approx(1.2, rel=0.05)
    for iso, gain in GAINS.items():
        frames = result.model.sample(jax.random.key(1), jnp.zeros(SIZE), Settings(iso, 1e-3, frames=16))
        noise = np.hypot(gain * READ, 0.3)
        spread = np.sqrt(np.var(np.mean(np.asarray(frames, float), 0)) - noise**2 / 16)
        assert spread == pytest.approx(1.2, rel=0.1 if gain < 8 else 0.4)
