"""What calibrating refuses, or says of recordings, a diagnosis says of them too, in the same words."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.faults import (
    FaultWarning,
    fault_lines,
    faults_of,
    within_light,
    without_moving,
    without_moving_flats,
)
from cannoise_jax.discovery.report.document import document
from cannoise_jax.discovery.report.page import page
from cannoise_jax.physics.transfer.faults import Faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.rails import moved
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording
from cannoise_jax.recordings.usable import LeftOutWarning

from .capture import SIZE, capture_set

GAIN, READ = 0.8, 4.0


def recording(kind, light=None, black=200.0, stated=200.0, count=4):
    """Frames of a monochrome camera under one light, `[count, H, W]` or less, in electrons."""
    rng = np.random.default_rng([5, kind == "dark"])
    electrons = rng.poisson(np.broadcast_to(0.0 if light is None else light, (count, *SIZE)))
    noisy = black + GAIN * (electrons + READ * rng.standard_normal(electrons.shape))
    frames = np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)
    return Recording(frames, "MONO", (stated,) * 4, 4095.0, kind=kind, exposure_s=1.0, path=f"{kind}.h5")


def report_of(capture):
    with pytest.warns(FaultWarning) as said:
        found = diagnose(capture, compare=False)
    report = document(found, key=0, version="")
    assert [str(w.message) for w in said if w.category is FaultWarning] == report["faults"]
    return report, found


def test_darks_cut_off_at_zero_are_said_as_calibrating_refuses_them():
    capture = CaptureSet("c", (recording("flat", 2000.0, 0.0, 0.0), recording("dark", None, 0.0, 0.0)))
    with pytest.raises(BadInput) as refused:
        calibrate(capture)
    report, found = report_of(capture)
    assert report["faults"] == [str(refused.value)]
    (base,) = report["baseline"]
    assert base["gain_measured"] and not base["read_noise_measured"] and base["black_cut_off"]
    assert not any("read noise" in line for line in report["not_measured"])  # once is enough
    assert "black_clipping" in found.findings
    text = page(found, report)
    assert "dark.h5: darks are cut off at 0" in text.split("Gain and read noise")[0]


def test_a_gain_is_not_measured_where_noise_does_not_grow_with_the_light():
    """As of a bolometer: flats of three levels, all with the noise of the darks."""
    rng, shots = np.random.default_rng(6), (("dark", 0.0), ("flat", 300.0), ("flat", 900.0), ("flat", 1800.0))
    capture = CaptureSet(
        "c",
        tuple(
            Recording(
                np.rint(200 + light + 4 * rng.standard_normal((6, *SIZE))).astype(np.uint16),
                "MONO", (200.0,) * 4, 4095.0, kind=kind, exposure_s=1.0, path=f"{n}.h5",
            )
            for n, (kind, light) in enumerate(shots)
        ),
    )  # fmt: skip
    found = diagnose(capture, compare=False)
    report = document(found, key=0, version="")
    (base,) = report["baseline"]
    assert not base["shot_noise"] and not base["gain_measured"] and base["read_noise_measured"]
    assert "no shot noise" in page(found, report)


def test_a_fault_names_its_setting_where_there_are_several():
    wrong = Faults(unlit="the light stops", moves="the scene moves")
    assert fault_lines({100.0: wrong, 400.0: Faults()}) == [
        "the gain at ISO 100 was not measured: the scene moves",
        "ISO 100: the light stops",
    ]
    assert fault_lines({100.0: wrong})[1] == fault_lines({None: wrong})[1] == "the light stops"


def test_a_black_level_that_the_darks_contradict_is_said_and_found(caplog):
    capture = CaptureSet("c", (recording("flat", 2000.0, stated=500.0), recording("dark", stated=500.0)))
    calibrate(capture)
    report, found = report_of(capture)
    (line,) = report["faults"]
    assert line.startswith("darks are at 200 DN, 500 is stated as black level")
    assert caplog.messages == [f"c: {line}"]
    assert "bookkeeping" in found.findings
    assert report["baseline"][0]["black_dn"] == pytest.approx([200.0] * 4, abs=0.2)


def moving(count=4):
    x, y = np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0]))
    return np.stack([200 + 1500.0 * ((x + 3 * k) // 10 % 2) + 800.0 * (y // 12 % 2) for k in range(count)])


def test_scenes_that_move_are_refused_as_they_tell_calibrating_no_gain():
    capture = CaptureSet("c", (recording("scene", moving()), recording("dark")))
    transfers, _ = calibrate(capture)
    refused = {o.record for o in transfers[0].outcomes("system gain", "DN/e-")}
    with pytest.raises(BadInput, match="scene.h5: .*the scene or its light moves: record flats") as error:
        diagnose(capture, compare=False)
    assert str(error.value).removeprefix("scene.h5: ") in refused


@pytest.mark.parametrize(("pixels", "refused"), [(0.0, False), (0.25, True)])
def test_a_fine_scene_that_shakes_by_parts_of_a_pixel_is_refused(pixels, refused):
    """No two pixels apart change alike: the change follows the slopes of the scene."""
    rng = np.random.default_rng(8)
    # So much detail that noise is a third of how neighbours differ.
    waves = np.fft.rfft2(ndimage.gaussian_filter(rng.standard_normal(SIZE), 1.5, mode="wrap"))
    down, across = np.fft.fftfreq(SIZE[0])[:, None], np.fft.rfftfreq(SIZE[1])
    shown = [
        np.fft.irfft2(waves * np.exp(2j * np.pi * (dy * down + dx * across)), SIZE)
        for dy, dx in pixels * rng.standard_normal((4, 2))
    ]
    light = np.clip(1200 + 3000 * np.stack(shown), 100, 2500)
    capture = CaptureSet("c", (recording("scene", light), recording("dark")))
    if refused:
        with pytest.raises(BadInput, match="scene.h5: .*the scene or its light moves"):
            diagnose(capture, compare=False)
    else:
        assert not moved([frame_statistics(capture.recordings[0])], 0)


@pytest.mark.parametrize("count", [8, 16])
@pytest.mark.parametrize("other", ["moved", "dimmed", None])
def test_scenes_of_which_one_frame_is_another_tell_no_gain(count, other):
    """Of a texture in which no two pixels are alike."""
    light = np.random.default_rng(9).uniform(300, 2400, SIZE)
    shown = np.stack([light] * count)
    if other:
        shown[count - 3] = np.roll(light, (4, 3), (0, 1)) if other == "moved" else 0.6 * light
    said = moved([frame_statistics(recording("scene", shown, count=count))], 0)
    assert bool(said) == bool(other)


def test_scenes_that_move_beside_flats_are_left_out_and_others_stay():
    flat, dark = recording("flat", 2000.0), recording("dark")
    scene = recording("scene", moving())
    still = dataclasses.replace(recording("scene", moving(1)), path="still.h5")
    left, (line,) = without_moving(CaptureSet("c", (scene, flat, still, dark)))
    assert [r.path for r in left.recordings] == ["flat.h5", "still.h5", "dark.h5"]
    assert line.startswith("scene.h5: ") and line.endswith("the scene or its light moves: left out")
    known = dataclasses.replace(scene, clean=(GAIN * moving()[0] / 3895).astype(np.float32))
    for kept in ((scene, dark), (known, flat, dark)):
        left, lines = without_moving(CaptureSet("c", kept))
        assert len(left.recordings) == len(kept) and not lines


def test_flats_under_which_the_light_moves_are_left_out_where_something_else_is_there():
    """A flat whose light has waves of 10 %, which lie elsewhere in every frame."""
    rng, columns = np.random.default_rng(11), np.arange(SIZE[1])
    waves = np.stack([0.1 * np.sin((columns + shift) / 12) for shift in rng.uniform(0, 75, 8)])
    waved = recording("flat", 2000.0 * (1 + waves)[:, None], count=8)
    steady = dataclasses.replace(recording("flat", 2000.0), path="steady.h5")
    dark = recording("dark")

    def left(*recordings):
        capture = CaptureSet("c", recordings)
        return without_moving_flats(capture, faults_of(capture))

    kept, (line,) = left(waved, steady, dark)
    assert [r.path for r in kept.recordings] == ["steady.h5", "dark.h5"]
    assert line.startswith("flat.h5: ") and line.endswith("the light moves: left out")
    assert not left(steady, dark)[1] and not left(waved)[1]
    capture = CaptureSet("c", (waved, dark))
    with pytest.warns(LeftOutWarning, match="the light moves: left out"):
        found = diagnose(capture, compare=False)
    assert not found.findings


def test_two_gains_that_no_file_states_are_refused_by_both():
    own = recording("flat", 300.0), recording("dark")
    other = [
        dataclasses.replace(r, frames=(3.0 * (r.frames - 200.0) + 260).astype(np.uint16), exposure_s=4.0)
        for r in own
    ]
    capture = CaptureSet("c", (*own, *other))
    with pytest.raises(BadInput, match="of two gain settings that no file states") as refused:
        calibrate(capture)
    with pytest.raises(BadInput) as error:
        diagnose(capture, compare=False)
    assert str(error.value) == str(refused.value)


def test_scenes_with_references_that_move_are_said_and_may_move_with_them():
    light = moving()
    scene = recording("scene", light)
    known, followed = (
        dataclasses.replace(scene, clean=(GAIN * at / 3895).astype(np.float32)) for at in (light[0], light)
    )
    (wrong,) = faults_of(CaptureSet("c", (known,))).values()
    assert wrong.moves
    assert not faults_of(CaptureSet("c", (followed,)))


def test_flats_that_move_are_said_as_the_table_of_calibrating_does():
    capture = CaptureSet("c", (recording("flat", moving()), recording("dark")))
    transfers, _ = calibrate(capture)
    notes = {q.note for q in transfers[0].quantities if q.name == "system gain"}
    assert faults_of(capture)[None].doubted in notes


def test_sound_recordings_have_no_faults():
    for wrong in faults_of(capture_set(1)).values():
        assert not any(wrong)


def covered(dark):
    """A flat whose pixels of `dark` get no light, and darks."""
    light = np.where(dark, 0.0, 3000.0)
    return CaptureSet("c", (recording("flat", light, count=8), recording("dark", count=8)))


ROW, COLUMN = np.mgrid[: SIZE[0], : SIZE[1]]


@pytest.mark.parametrize(
    ("dark", "rows", "columns"),
    [
        (COLUMN >= 111, slice(0, 96), slice(0, 110)),
        ((ROW < 9) | (COLUMN < 14), slice(10, 96), slice(14, 128)),
        (np.hypot(ROW - 48, COLUMN - 64) > 60, None, None),
    ],
    ids=["overscan", "two edges", "image circle"],
)
def test_frames_are_cut_to_where_light_falls(dark, rows, columns):
    capture = covered(dark)
    cut, found = within_light(capture, faults_of(capture))
    flat = np.asarray(cut.recordings[0].frames).mean(0)
    assert flat.min() > 200 + 0.5 * GAIN * 3000 and all(n % 2 == 0 for n in flat.shape)
    if rows is not None:
        for r, whole in zip(cut.recordings, capture.recordings, strict=True):
            np.testing.assert_array_equal(np.asarray(r.frames), whole.frames[:, rows, columns])
    assert flat.size > 0.5 * np.sum(~dark)
    (line,) = fault_lines(found)
    assert "no light reaches" in line and "all frames are cut to rows" in line


def test_a_dead_block_within_the_frame_cuts_nothing_off():
    capture = covered((abs(ROW - 50) < 7) & (abs(COLUMN - 40) < 7))
    assert within_light(capture, faults_of(capture))[0] is capture
