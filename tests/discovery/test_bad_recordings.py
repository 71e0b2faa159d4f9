"""Recordings that are odd, or strong beyond what is met: a report, or one clear line."""

import dataclasses
from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from cannoise_jax import diagnose
from cannoise_jax.discovery.compare.run import compare_bank
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, prepare_split, split_recordings
from cannoise_jax.discovery.report.outcome import baseline, not_measured, unnamed_read
from cannoise_jax.discovery.search.declare import registered
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.discovery.search.locate import locate
from cannoise_jax.discovery.search.model import baseline_model
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import BadInput, CaptureSet
from cannoise_jax.recordings.usable import LeftOutWarning
from tests.discovery.capture import capture_set, offset_map, response_map

SIZE = (64, 64)


def found(capture):
    first = prepare_split(capture, split_recordings(capture))
    fitted = stepwise(
        first.fields, first.signatures, frozenset(e.id for e in registered(())), float(np.log(0.01))
    )
    return {s.named.mechanism: s.named.score.amplitude for s in fitted.steps}


def with_frames(capture, number, change):
    """The set with the frames of one recording replaced."""
    recordings = list(capture.recordings)
    r = recordings[number]
    recordings[number] = dataclasses.replace(r, frames=change(np.asarray(r.frames)))
    return CaptureSet(capture.camera, tuple(recordings))


def of_first(capture, **fields):
    """The set with fields of its first recording replaced."""
    first, *rest = capture.recordings
    return CaptureSet(capture.camera, (dataclasses.replace(first, **fields), *rest))


@pytest.mark.parametrize("more, said", [({"without": "dsnu"}, "without is the text 'dsnu'"),
                                        ({"mechanisms": [3]}, "mechanisms holds a int")])  # fmt: skip
def test_names_that_are_none_are_refused_in_one_line(more, said):
    with pytest.raises(TypeError, match=said):
        diagnose(capture_set(1, kinds="d"), **more)


def test_frames_of_another_shape_and_what_is_no_list_are_refused_in_one_line():
    capture = capture_set(1, kinds="d")
    for frames in (np.asarray(capture.recordings[0].frames)[0], np.uint16(3)):
        with pytest.raises(BadInput, match=r"frames have shape .*: expected \[frames, rows, columns\]"):
            diagnose(of_first(capture, frames=frames))
    with pytest.raises(TypeError, match="is a single Recording: give a tuple"):
        diagnose(CaptureSet("c", capture.recordings[0]))


def test_a_white_level_within_the_noise_of_the_darks_is_refused():
    capture = capture_set(1, kinds="d")
    level = float(np.median(capture.recordings[0].frames))
    with pytest.raises(BadInput, match="most pixels of the darks reach the white level"):
        diagnose(of_first(capture, white_level=level + 3))


@pytest.mark.parametrize("alpha", ("x", None, True))
def test_an_alpha_that_is_no_number_is_refused_by_name(alpha):
    with pytest.raises(TypeError, match="^alpha is .*between 0 and 1"):
        diagnose(capture_set(1, kinds="d"), alpha=alpha)


@pytest.mark.parametrize("level", (200.0, -3.0))
def test_a_noise_free_image_in_dn_is_refused(level):
    capture = capture_set(1, kinds="df")
    size = capture.recordings[0].size
    capture = of_first(capture, clean=np.full(size, level, np.float32), reference="independent")
    with pytest.raises(BadInput, match="not normalised"):
        diagnose(capture)


@pytest.mark.parametrize("fields, said", [({"camera": "other"}, "several cameras"),
                                          ({"cfa": "BGGR"}, "several colour orders")])  # fmt: skip
def test_recordings_of_two_sensors_are_refused(fields, said):
    with pytest.raises(BadInput, match=said):
        diagnose(of_first(capture_set(1, kinds="df"), **fields))


def test_frames_of_two_sizes_are_refused():
    capture = capture_set(1, kinds="df")
    small = capture.recordings[0].frames[:, :32, :32]
    with pytest.raises(BadInput, match=r"frames of several sizes \(32 x 32, \d+ x \d+ pixels\)"):
        diagnose(of_first(capture, frames=small))


def test_single_frames_calibrate_nothing():
    single = capture_set(1, kinds="df", frames=1)
    with pytest.raises(BadInput, match="every recording is of one frame"):
        silent = [dataclasses.replace(r, shot=None, read=None) for r in single.recordings]
        diagnose(CaptureSet(single.camera, tuple(silent)))


def test_what_the_baseline_lacks_is_said():
    """Flats whose values pile up at the highest code tell no gain, darks alone neither; flats alone no read
    noise."""
    whole = diagnose(capture_set(2, kinds="df", frames=4, size=SIZE), compare=False)
    assert not_measured(whole) == []
    multiplied = tuple(dataclasses.replace(r, em_gain=200.0) for r in whole.capture.recordings)
    held = dataclasses.replace(whole, capture=dataclasses.replace(whole.capture, recordings=multiplied))
    (line,) = not_measured(held)
    assert line.startswith("the files state an electron multiplying gain of 200")
    assert (
        {b["gain_measured"] for b in baseline(whole)}
        == {b["read_noise_measured"] for b in baseline(whole)}
        == {True}
    )
    darks = not_measured(diagnose(capture_set(2, kinds="d", frames=4, size=SIZE), compare=False))
    assert len(darks) == 1 and "was not measured, that of the files stands" in darks[0]
    capture = capture_set(2, kinds="f", frames=4, size=SIZE)
    one = CaptureSet(capture.camera, capture.recordings[-1:])
    lit = not_measured(diagnose(one, compare=False))
    assert any("read noise at ISO 100 was not measured" in line for line in lit)


@pytest.mark.parametrize("value", ["text", None, [[1, 2], [3]]])
def test_simulators_that_return_no_array_are_refused_in_one_line(value):
    with pytest.raises(BadInput, match="simulator: .*it must return") as caught:
        diagnose(capture_set(1, kinds="fd"), lambda key, clean, settings: value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("verb", [diagnose, partial(compare_bank, simulator="poisson-gaussian")])
def test_calls_with_what_is_no_capture_set_or_key_are_refused_in_one_line(verb):
    capture = capture_set(1, kinds="d")
    for given, key, error, said in (
        (list(capture.recordings), None, TypeError, "capture is a list: expected a CaptureSet"),
        (capture.recordings[0], None, TypeError, "capture is a Recording: expected a CaptureSet"),
        (CaptureSet("X", ("dark.h5",)), None, TypeError, "capture.recordings holds a str"),
        (CaptureSet("X", ()), None, BadInput, "X: holds no recordings"),
        (of_first(capture, frames=None), None, BadInput, "frames is a NoneType: give an array"),
        (of_first(capture, clean=0.5), None, BadInput, "clean is a float: give an array"),
        (of_first(capture, kind=None), None, BadInput, "kind is missing: use one of"),
        (capture, 3, TypeError, "key is of type int: expected a key of JAX"),
        (capture, jax.random.split(jax.random.key(0)), TypeError, "expected one key"),
    ):
        with pytest.raises(error) as caught:
            verb(given, key=key)
        assert said in str(caught.value) and "\n" not in str(caught.value)


def test_the_report_gives_no_iso_where_no_file_states_one():
    capture = capture_set(1, kinds="d")
    for iso, told in ((None, None), (0.0, 0.0), (400.0, 400.0)):
        recordings = tuple(dataclasses.replace(r, iso=iso) for r in capture.recordings)
        prepared = prepare_split(unstated := CaptureSet("X", recordings), split_recordings(unstated))
        model = baseline_model(unstated, prepared)
        (row,) = baseline(SimpleNamespace(model=model, first=prepared, simulator="a model"))
        assert row["iso"] == told


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("axis", [0, 1])
def test_strong_offsets_of_lines_are_not_taken_for_full_pixels(seed, axis):
    """The few offsets that 64 lines draw scatter the variance of a level; the shot noise is all there."""

    def alter(rng):
        return lambda dn, signal, kind, exposure: (
            dn + 100.0 * rng.standard_normal((dn.shape[axis],)).reshape((-1, 1) if axis == 0 else (1, -1))
        )

    capture = capture_set(seed, alter, size=SIZE, black=1000.0)
    prepared = prepare_split(capture, split_recordings(capture))
    assert not any(level.full for level in prepared.baselines[0].levels)
    assert all(f.usable.mean() > 0.99 for f in prepared.fields)


def test_a_flat_of_full_pixels_is_left_aside():
    capture = capture_set(13, kinds="df", size=SIZE)
    full = with_frames(capture, len(capture.recordings) - 1, lambda x: np.full_like(x, 16383))
    assert found(full) == {}


@pytest.mark.parametrize(
    "change, says",
    [
        (lambda x: np.zeros_like(x), "one value"),
        (lambda x: np.repeat(x[:1], len(x), 0), "repeats one frame"),
        (lambda x: x[:, :48], "give recordings of one size"),
    ],
)
def test_recordings_without_noise_or_of_another_size_are_refused_in_one_line(change, says):
    capture = with_frames(capture_set(13, kinds="df", size=SIZE), 1, change)
    with pytest.raises(BadInput, match=says) as refused:
        prepare_split(capture, split_recordings(capture))
    assert "\n" not in str(refused.value)


def test_frames_without_noise_are_left_out_of_a_diagnosis_with_a_warning():
    def repeated(frames):
        return np.concatenate([frames[:5], frames[2:3], np.zeros_like(frames[:2])])

    capture, drawn = with_frames(capture_set(13, kinds="d", size=SIZE), 1, repeated), []

    def simulator(key, clean, settings):
        drawn.append(settings.frames)
        if settings.exposure_s == capture.recordings[1].exposure_s:
            raise BadInput("enough")
        return jax.random.normal(key, (settings.frames, *SIZE)) + 200

    with pytest.warns(LeftOutWarning) as said, pytest.raises(BadInput, match="enough"):
        diagnose(capture, simulator)
    assert drawn[-1] == 5
    lines = [str(w.message) for w in said if w.category is LeftOutWarning]
    assert len(lines) == 2 and "a copy of frame 3" in lines[0] and "every pixel is 0" in lines[1]


def test_recordings_that_are_all_at_a_rail_are_refused():
    capture = capture_set(13, kinds="f", size=SIZE)
    for n in range(len(capture.recordings)):
        capture = with_frames(capture, n, lambda x: np.full_like(x, 16383))
    with pytest.raises(BadInput, match="at a rail"):
        prepare_split(capture, split_recordings(capture))


def test_odd_sizes_are_judged():
    assert found(capture_set(14, kinds="df", size=(47, 63))) == {}


def test_read_noise_far_below_a_code_is_no_finding():
    assert found(capture_set(7, kinds="df", size=SIZE, gain=0.1)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("drift", [0.2])
def test_strong_drift_of_the_lamp_is_named(drift):
    def alter(rng):
        return lambda dn, signal, kind, t: dn + signal * drift * rng.standard_normal()

    assert list(found(capture_set(15, alter, kinds="df", size=SIZE)))[0] == "illumination_drift"


@pytest.mark.parametrize(
    "mechanism, alter, strength",
    [pytest.param("dsnu", offset_map, 50.0, marks=pytest.mark.slow), ("prnu", response_map, 0.05)],
)
def test_maps_far_above_the_noise_are_measured(mechanism, alter, strength, monkeypatch):
    monkeypatch.setattr("tests.discovery.capture.SIZE", SIZE)
    amplitudes = found(capture_set(16, alter(strength), kinds="df", size=SIZE))
    assert list(amplitudes)[0] == mechanism
    assert amplitudes[mechanism] == pytest.approx(strength, rel=0.05)


def test_frames_held_back_one_by_one_are_not_taken_for_full_pixels():
    """A flat whose only held-back frame is its own mean as well: its noise is no drift of the lamp."""
    capture = capture_set(11, kinds="sdf", size=(64, 64), frames=4)
    unseen = prepare_split(capture, split_recordings(capture), held_back=True)
    assert {len(s.contrasts) for s in unseen.stacks} == {1}
    assert not any(level.full for level in unseen.baselines[0].levels)


def test_a_gain_setting_of_no_number_has_the_same_one_in_every_split():
    whole = capture_set(2, kinds="df", size=(64, 64))
    few = dataclasses.replace(whole.recordings[-1], iso=0.0, frames=whole.recordings[-1].frames[:1])
    capture = CaptureSet(whole.camera, (*whole.recordings, few))
    splits = split_recordings(capture)
    numbers = [prepare_split(capture, splits, held_back=back).isos for back in (False, True)]
    assert numbers[0] == numbers[1] == {0.0: 50.0, 100.0: 100.0}


@pytest.mark.parametrize("read", [0.3, pytest.param(0.5, marks=pytest.mark.slow)])
def test_noise_below_a_code_is_neither_full_wells_nor_hot_pixels(read):
    capture = capture_set(5, kinds="df", size=(64, 96), gain=0.05, read=read / 0.05, black=5.0)
    assert not found(capture)


def test_flats_that_noise_clips_at_the_white_level_are_not_full_wells():
    whole = capture_set(6, kinds="df", size=(64, 96), gain=0.05, read=30.0)
    lit = [r for r in whole.recordings if r.kind == "flat"]
    white = float(np.mean(lit[-1].frames)) + 1.0 * float(np.std(lit[-1].frames))
    clipped = tuple(
        dataclasses.replace(r, frames=np.minimum(r.frames, int(white)), white_level=float(int(white)))
        for r in whole.recordings
    )
    assert "saturation" not in found(CaptureSet(whole.camera, clipped))


def test_pixels_that_hardly_ever_move_are_diagnosed():
    """Read noise of a fifth of a code: darks of which most pixels hold one value."""
    found(capture_set(11, gain=1.5, read=0.2 / 1.5, size=(64, 96)))


@pytest.mark.parametrize(
    ("name", "point", "variance"),
    [
        ("unknown_tails", Point("readout", "signal", "pixel", "redrawn", distribution="tukey_lambda"), 4.0),
        ("unknown_rows", Point("readout", "signal", "row", "redrawn"), 0.0),
        ("named", Point("readout", "signal", "pixel", "redrawn"), 0.0),
    ],
)
def test_noise_of_pixels_without_a_name_is_read_noise(name, point, variance):
    model = SensorModel.poisson_gaussian(1.5, 3.0, 200.0, 16383.0, "RGGB")
    shape = {"tukey_lambda": 0.3} if "tails" in name else {}
    more = unnamed_read(model.with_mechanism(name, point=point, sigma_dn=2.0, **shape))
    np.testing.assert_allclose(more, np.full((1, 4), variance), rtol=1e-4)


def test_a_flat_of_which_every_pixel_is_full_now_and_then_is_not_looked_at():
    """It has no pixel that is never full: statistics of none are no numbers."""
    capture = capture_set(4, kinds="df", size=(64, 96))
    *others, last = capture.recordings
    frames = np.array(last.frames)
    frames[np.arange(64 * 96).reshape(64, 96) % len(frames), *np.indices((64, 96))] = int(last.white_level)
    capture = dataclasses.replace(capture, recordings=(*others, dataclasses.replace(last, frames=frames)))
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    assert [f.number for f in prepared.fields] == list(range(len(others)))
    scores = locate(prepared.fields, prepared.signatures).scores
    assert np.isfinite([s.evidence for s in scores.values()]).all()
