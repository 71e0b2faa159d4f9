"""bin/simulate: recordings that carry their truth, and one line for what cannot be used."""

import numpy as np
import pytest

from cannoise_jax.commands.simulate import main
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.recordings.native import read_recording
from cannoise_jax.recordings.recording import BadInput, gain_of_iso, iso_of_gain


@pytest.fixture
def sensor(tmp_path):
    path = tmp_path / "sensor.json"
    model = SensorModel.poisson_gaussian(
        [[0.5], [2.0]], [[3.0], [2.0]], 64, 1023, "GRBG", iso=(100, 400), camera="bench camera"
    )
    write_sensor(path, model.with_mechanism("row_noise", sigma_dn=0.5))
    return str(path)


def test_a_flat_is_a_recording_with_its_truth(sensor, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = [
        "--sensor",
        sensor,
        "--clean",
        "flat:0.2",
        "--size",
        "32x48",
        "--frames",
        "8",
        "--iso",
        "400",
    ]
    assert main([*arguments, "--exposure", "0.02", "--out", str(out)]) == 0
    assert "8 frames of 32 x 48, GRBG, bench camera" in capsys.readouterr().out
    recording = read_recording(out / "flat_0.2_iso400_0.02s.h5")
    frames = np.asarray(recording.frames[:], np.float64)
    assert frames.shape == (8, 32, 48)
    assert (recording.kind, recording.iso, recording.exposure_s) == ("flat", 400.0, 0.02)
    signal = 0.2 * (1023 - 64)
    assert frames.mean() == pytest.approx(64 + signal, rel=0.01)
    variance = (recording.shot[0] * 0.2 + recording.read[0]) * (1023 - 64) ** 2
    assert variance == pytest.approx(2.0 * signal + (2.0 * 2.0) ** 2, rel=1e-4)
    assert frames.var() == pytest.approx(variance, rel=0.1)


def test_the_light_of_the_recordings_may_stay_away(sensor, tmp_path):
    """A lamp that flickered over the flats of a camera is none of the camera."""
    lit = tmp_path / "lit.json"
    write_sensor(lit, SensorModel.load(sensor).with_mechanism("flicker", amplitude=0.5, frequency=0.1))
    frames = []
    for number, flags in enumerate(([str(lit)], [str(lit), "--steady-light"], [sensor])):
        out = tmp_path / str(number)
        flat = ["--clean", "flat:0.5", "--size", "32x32", "--out", str(out)]
        assert main(["--sensor", *flags, *flat]) == 0
        frames.append(np.asarray(read_recording(out / "flat_0.5_iso100_0.01s.h5").frames[:]))
    assert np.array_equal(frames[1], frames[2]) and not np.array_equal(frames[0], frames[2])


def test_a_setting_whose_noise_no_camera_has_is_refused_by_its_flag(sensor, tmp_path, capsys):
    """And not by a field of the file that would be written."""
    out = tmp_path / "out"
    common = ["--sensor", sensor, "--clean", "dark", "--size", "16x16", "--out", str(out)]
    for flags in (["--iso", "1234567"], ["--gain", "90"]):
        assert main([*common, *flags]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(
            f"bin/simulate: {' '.join(flags)}: the noise of bench camera would there be wider"
        )
        assert "ISO 100 to 400" in line and not out.exists()


def test_a_folder_gives_one_recording_per_picture_and_seeds_repeat(sensor, tmp_path):
    from skimage.io import imsave

    pictures = tmp_path / "pictures"
    pictures.mkdir()
    ramp = np.linspace(0, 0.5, 24 * 32, dtype=np.float32).reshape(24, 32)
    np.save(pictures / "ramp.npy", ramp)
    imsave(pictures / "colour.png", np.full((24, 32, 3), (255, 128, 0), np.uint8), check_contrast=False)
    for out in ("first", "second"):
        arguments = [
            "--sensor",
            sensor,
            "--clean",
            str(pictures),
            "--frames",
            "2",
            "--out",
            str(tmp_path / out),
        ]
        assert main(arguments) == 0
    first, second = (read_recording(tmp_path / out / "ramp_iso100_0.01s.h5") for out in ("first", "second"))
    np.testing.assert_array_equal(first.frames[:], second.frames[:])
    np.testing.assert_allclose(first.clean, ramp)
    colour = read_recording(tmp_path / "first" / "colour_iso100_0.01s.h5")
    # GRBG: red is the second site, blue the third; an sRGB code of 128 is 0.216 in linear light.
    np.testing.assert_allclose(colour.clean[0, 1], 1.0)
    np.testing.assert_allclose(colour.clean[1, 0], 0.0)
    np.testing.assert_allclose(colour.clean[0, 0], 0.2159, atol=1e-3)


def test_a_calibrated_unit_gives_frames_of_its_own_size_and_another_unit_any(tmp_path, capsys):
    model = SensorModel.poisson_gaussian(2.0, 3.0, 100, 4095).with_mechanism("dsnu", sigma_dn=5.0)
    write_sensor(tmp_path / "unit.json", model.with_maps((24, 40)))
    dark = [
        "--sensor",
        str(tmp_path / "unit.json"),
        "--clean",
        "dark",
        "--out",
        str(tmp_path / "out"),
        "--force",
    ]
    assert main(dark) == 0 and read_recording(tmp_path / "out" / "dark_iso100_0.01s.h5").size == (24, 40)
    assert main([*dark, "--size", "32x32"]) == 2
    assert "another unit" in capsys.readouterr().err
    elsewhere = tmp_path / "elsewhere"
    assert main([*dark, "--size", "32x32", "--out", str(elsewhere)]) == 2
    assert "another unit" in capsys.readouterr().err and not elsewhere.exists()
    assert main([*dark, "--size", "32x32", "--unit", "3"]) == 0
    assert (tmp_path / "out" / "dark_iso100_0.01s_unit3.h5").exists()


def test_several_settings_lie_side_by_side(sensor, tmp_path):
    out = tmp_path / "out"
    dark = ["--sensor", sensor, "--clean", "dark", "--size", "32x32", "--out", str(out)]
    for more in (["--exposure", "10"], ["--exposure", "0.5"], ["--iso", "400"], ["--temperature", "-5"]):
        assert main([*dark, *more]) == 0
    assert main([*dark, "--gain", "6"]) == 0
    assert sorted(p.name for p in out.iterdir()) == [
        "dark_gain6dB_0.01s.h5",
        "dark_iso100_0.01s_-5C.h5", "dark_iso100_0.5s.h5", "dark_iso100_10s.h5", "dark_iso400_0.01s.h5",
    ]  # fmt: skip
    of_gain = read_recording(out / "dark_gain6dB_0.01s.h5")
    assert (of_gain.gain_db, of_gain.iso) == (6.0, pytest.approx(199.526, abs=1e-3))
    assert read_recording(out / "dark_iso100_10s.h5").exposure_s == 10.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--clean", "dark"], "give --sensor and --clean"),
        (["--sensor", "absent.json", "--clean", "dark"], "absent.json: cannot be read"),
        (["--sensor", "SENSOR", "--clean", "flat:bright"], "flat:LEVEL"),
        (["--sensor", "SENSOR", "--clean", "flat:1.5"], "flat:LEVEL"),
        (["--sensor", "SENSOR", "--clean", "nowhere.png"], "no such file"),
        (["--sensor", "SENSOR", "--clean", "dark", "--frames", "0"], "from 1 to"),
        (["--sensor", "SENSOR", "--clean", "dark", "--frames", "99999999"], "from 1 to"),
        (["--sensor", "SENSOR", "--clean", "flat:0.3", "--size", "33x33"], "even sizes"),
        (["--sensor", "preset:toaster", "--clean", "dark"], "toaster"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, message, sensor, tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*(sensor if a == "SENSOR" else a for a in arguments), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("bin/simulate: ") and said.count("\n") == 1 and message in said
    assert not out.exists()


@pytest.mark.parametrize(
    ("flag", "value", "words"),
    [
        *(
            ("--exposure", v, "a time in seconds, 0 or 1e-09 to 1e+06")
            for v in ("inf", "-1", "1e9", "1e-320", "soon")
        ),
        *(("--iso", v, "a number above 0, at most 1e+09") for v in ("0", "inf", "nan", "2e9", "1e-320")),
        *(("--gain", v, "a gain in dB, at most 200") for v in ("inf", "nan", "-201", "loud")),
        *(
            ("--temperature", v, "degrees Celsius, -273.15 to 150")
            for v in ("nan", "inf", "-300", "1000", "1e-320")
        ),
        *(
            (flag, v, "a whole number from 0 to 4294967295")
            for flag in ("--seed", "--unit")
            for v in ("-1", "1" + 30 * "0", "1.5")
        ),
    ],
)
def test_settings_that_no_camera_has_are_one_line_and_status_2(flag, value, words, sensor, tmp_path, capsys):
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as ended:
        main(["--sensor", str(sensor), "--clean", "dark", f"{flag}={value}", "--out", str(out)])
    said = capsys.readouterr().err
    assert ended.value.code == 2 and not out.exists()
    assert said.startswith(f"bin/simulate: argument {flag}: ") and said.count("\n") == 1
    assert f"give {words}" in said


def test_pictures_that_cannot_be_used(sensor, tmp_path, capsys):
    bad = tmp_path / "bad.npy"
    for values, message in (
        (np.full((4, 4), np.nan), "finite"),
        (np.zeros(5), "shape"),
        (np.full((4, 4), 9.0), "from 0"),
        (np.zeros((4, 4), complex), "complex"),
        (np.zeros((5, 4)), "even sizes"),
    ):
        np.save(bad, values)
        assert main(["--sensor", sensor, "--clean", str(bad), "--out", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err
    np.save(bad, np.array([{"a": 1}], dtype=object))
    assert main(["--sensor", sensor, "--clean", str(bad), "--out", str(tmp_path / "out")]) == 2
    bad.write_bytes(b"")
    assert main(["--sensor", sensor, "--clean", str(bad), "--out", str(tmp_path / "out")]) == 2
    (tmp_path / "broken.png").write_bytes(b"not a picture")
    assert (
        main(["--sensor", sensor, "--clean", str(tmp_path / "broken.png"), "--out", str(tmp_path / "o")]) == 2
    )
    assert "cannot be read as a picture" in capsys.readouterr().err


def test_nothing_is_written_over(sensor, tmp_path, capsys):
    out = tmp_path / "out"
    flat = ["--sensor", sensor, "--clean", "flat:0.2", "--size", "32x32", "--out", str(out)]
    assert main(flat) == 0
    before = (out / "flat_0.2_iso100_0.01s.h5").read_bytes()
    assert main([*flat, "--seed", "5"]) == 2
    assert "exists" in capsys.readouterr().err and (out / "flat_0.2_iso100_0.01s.h5").read_bytes() == before
    assert main([*flat, "--seed", "5", "--force"]) == 0
    assert (out / "flat_0.2_iso100_0.01s.h5").read_bytes() != before


def test_catalogue_needs_a_place(tmp_path, capsys):
    (tmp_path / "page.html").write_text("precious")
    assert main(["--catalogue", "--out", str(tmp_path / "page.html" / "page.html")]) == 2
    assert "page.html: is a file: name a folder for page.html" in capsys.readouterr().err
    assert main(["--catalogue", "--out", str(tmp_path / "page.html")]) == 2
    assert "--force" in capsys.readouterr().err and (tmp_path / "page.html").read_text() == "precious"


def test_catalogue_entry_has_its_pictures_and_words():
    from cannoise_jax.mechanisms import MECHANISMS, catalogue

    entry = catalogue.said_of(MECHANISMS["row_noise"])
    assert all(len(entry[name]) > 2000 for name in ("picture", "signature")) and entry["equation"]
    assert "darks" in entry["needs"] and "readout" in entry["place"] and "gain^1" in entry["scales"]


def test_a_full_disk_leaves_no_folder(tmp_path, monkeypatch, capsys):
    def full(path, recording, tell):
        raise BadInput(f"{path}: cannot be written: no space left on the disk")

    monkeypatch.setattr("cannoise_jax.recordings.native.write_recording", full)
    out = tmp_path / "a" / "b"
    arguments = ["--sensor", "preset:sony_a7s2", "--clean", "dark", "--size", "16x16", "--out", str(out)]
    assert main(arguments) == 2 and "no space" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_recordings_of_two_calls_have_no_noise_in_common(sensor, tmp_path):
    """By default too: a flat and darks of several exposures are made by calls of their own."""
    for clean, exposure in (("dark", "0.1"), ("dark", "0.2"), ("flat:0.5", "0.1")):
        arguments = ["--clean", clean, "--exposure", exposure, "--size", "64x64", "--frames", "2"]
        assert main(["--sensor", sensor, "--out", str(tmp_path / "out"), *arguments]) == 0
    paths = sorted((tmp_path / "out").glob("*.h5"))
    assert len(paths) == 3
    changes = [np.diff(read_recording(p).frames[:].astype(float), axis=0).ravel() for p in paths]
    shared = np.corrcoef(changes)[np.triu_indices(3, 1)]
    assert np.abs(shared).max() < 5 / np.sqrt(changes[0].size)


def test_a_camera_that_counts_its_gain_in_decibels_is_asked_in_them(tmp_path, capsys):
    model = SensorModel.poisson_gaussian(0.8, 3.0, 500, 65535, "MONO", iso=iso_of_gain(10.0), camera="c")
    write_sensor(tmp_path / "sensor.json", model)
    dark = ["--sensor", str(tmp_path / "sensor.json"), "--clean", "dark", "--size", "32x32", "--out"]
    assert main([*dark, str(tmp_path / "out")]) == 0
    stored = read_recording(tmp_path / "out" / "dark_gain10dB_0.01s.h5")
    assert stored.gain_db == 10.0 and stored.iso == pytest.approx(316.228, abs=1e-3)
    assert main([*dark, str(tmp_path / "out"), "--iso", "1e9"]) == 2
    assert "gains of 10 to 10 dB (--gain)" in capsys.readouterr().err


def test_only_what_stands_for_a_gain_in_tenths_of_decibels_is_told_as_one():
    for tenths in range(1, 600):
        if tenths % 200:
            assert gain_of_iso(np.float32(iso_of_gain(tenths / 10))) == tenths / 10
    for iso in (50.0, 100.0, 125.0, 316.0, 3200.0, 316.3):
        assert gain_of_iso(iso) is None
