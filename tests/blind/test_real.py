"""What is done to real recordings does what it says, on made-up ones."""

import numpy as np

from cannoise_jax.blind.effects import effect
from cannoise_jax.blind.real import crop, described, halves, injected, permuted
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE = (64, 96)


def capture(rng, row_sigma=3.0):
    pattern = 10 * rng.standard_normal(SIZE)
    frames = 1000 + pattern + row_sigma * rng.standard_normal((12, SIZE[0], 1))
    frames = frames + 6 * rng.standard_normal((12, *SIZE))
    codes = (np.rint(frames / 4) * 4).astype(np.uint16)
    dark = Recording(codes, "RGGB", (1000.0,) * 4, 65532.0, kind="dark", exposure_s=0.1, path="dark.h5")
    return CaptureSet("made up", (dark,))


def test_permuting_keeps_each_pixels_values_and_breaks_the_rows():
    rng = np.random.default_rng(0)
    before = capture(rng)
    after = permuted(before, rng)
    a, b = before.recordings[0].frames, after.recordings[0].frames
    assert np.array_equal(np.sort(a, 0), np.sort(b, 0)) and not np.array_equal(a, b)

    def rows(frames):
        residual = frames - frames.mean(0)
        return residual.mean(2).std()

    white = 4 * np.sqrt((36 + 9 + 16 / 12) / SIZE[1]) / 4
    assert rows(a) > 2.5 and abs(rows(b) / (white * np.sqrt(11 / 12)) - 1) < 0.15


def test_an_effect_below_the_step_gets_into_the_codes_and_no_effect_changes_nothing():
    rng = np.random.default_rng(1)
    before = capture(rng, 0.0)
    camera = described(before, 2.0, 6.0, 4.0, unit=3)
    same = injected(before, camera, effect("column_noise", 1e-12), rng)
    assert np.array_equal(same.recordings[0].frames, before.recordings[0].frames)
    after = injected(before, camera, effect("column_fpn", 1.0), rng).recordings[0].frames.astype(float)
    assert np.all(after % 4 == 0)
    moved = (after - before.recordings[0].frames).mean((0, 1))
    drawn = effect("column_fpn", 1.0)
    assert abs(moved.std() - 1) < 0.25 and drawn.stage == "analog"


def test_crops_keep_the_mosaic_and_held_back_frames_are_others():
    rng = np.random.default_rng(2)
    whole = capture(rng)
    part = crop(whole, (32, 40)).recordings[0].frames
    assert part.shape == (12, 32, 40)
    found = [
        (y, x)
        for y in range(33)
        for x in range(57)
        if np.array_equal(whole.recordings[0].frames[0, y : y + 32, x : x + 40], part[0])
    ]
    assert len(found) == 1 and found[0][0] % 2 == 0 and found[0][1] % 2 == 0
    assert not crop(whole, (32, 40), longest=0.01).recordings
    first, last = halves(whole)
    assert first.recordings[0].count == 7 and last.recordings[0].count == 5
    joined = np.concatenate([first.recordings[0].frames, last.recordings[0].frames])
    assert np.array_equal(joined, whole.recordings[0].frames)
