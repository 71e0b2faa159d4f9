import h5py
import numpy as np
import pytest
import scipy.io

from cannoise_jax.recordings.load import load_capture_set, load_recording
from cannoise_jax.recordings.packing import pack
from cannoise_jax.recordings.recording import BadInput, normalise
from cannoise_jax.recordings.sidd import load_sidd, read_sidd, scene_id

SIZE = (12, 20)
LETTERS = {"R": 0, "G": 1, "B": 2}
PROFILE = (1e-3, 1e-6, 2e-3, 2e-6, 3e-3, 3e-6)


def unknown_tags(cfa, profile):
    """A MATLAB struct array of tags: the two that are wanted between two others."""
    tags = [(33421, [2, 2]), (33422, [LETTERS[c] for c in cfa]), (50931, "x"), (51041, list(profile))]
    array = np.zeros((len(tags), 1), dtype=[("ID", object), ("Offset", object), ("Value", object)])
    for i, (number, value) in enumerate(tags):
        value = np.array(value, np.float64) if not isinstance(value, str) else value
        array[i, 0] = (np.uint16(number), np.uint32(7), value)
    return array


def write_instance(
    root,
    number=1,
    scene="001",
    camera="S6",
    cfa="GRBG",
    codes=None,
    black=(60, 61, 62, 63),
    white=1023,
    iso=800,
    nested=False,
    metadata=True,
    truth=True,
):
    folder = root / f"{number:04d}_{scene}_{camera}_{iso:05d}_00050_3200_N"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(number)
    codes = rng.integers(70, white, (2, *SIZE)) if codes is None else codes
    height, width = codes.shape[1:]
    level = np.tile(np.array(black, float).reshape(2, 2), (height // 2, width // 2))
    for t, name in enumerate(("010", "011")):
        x = ((codes[t] - level) / (white - level)).clip(0, 1).astype(np.float32)
        for kind, image in (("NOISY", x), ("GT", 0.5 * x)):
            if kind == "GT" and not truth:
                continue
            with h5py.File(folder / f"{number:04d}_{kind}_RAW_{name}.MAT", "w", userblock_size=512) as file:
                file["x"] = image.T  # as MATLAB's columns-first arrays appear in HDF5
        if metadata:
            about = {"Make": "samsung", "BlackLevel": np.array(black, float), "WhiteLevel": float(white)}
            if nested:  # as of the iPhone: a preview on top, the mosaic in a sub-directory, ISO in Exif
                about |= {"ISOSpeedRatings": np.array([]), "DigitalCamera": {"ISOSpeedRatings": float(iso)}}
                sub = np.empty((1, 1), object)
                sub[0, 0] = {"UnknownTags": unknown_tags(cfa, PROFILE)}
                about |= {"SubIFDs": sub, "UnknownTags": unknown_tags(cfa, PROFILE)[2:3]}
            else:
                about |= {"ISOSpeedRatings": float(iso), "UnknownTags": unknown_tags(cfa, PROFILE)}
            about["ExposureTime"] = 0.02
            scipy.io.savemat(folder / f"{number:04d}_METADATA_RAW_{name}.MAT", {"metadata": about})
    return folder, codes


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("camera, cfa", [("S6", "GRBG"), ("GP", "BGGR"), ("IP", "RGGB")])
def test_everything_that_an_instance_holds(tmp_path, camera, cfa, nested):
    folder, codes = write_instance(tmp_path, camera=camera, cfa=cfa, nested=nested)
    recording = read_sidd(folder)
    assert recording.camera == camera and recording.cfa == cfa
    assert recording.black_level == (60, 61, 62, 63) and recording.white_level == 1023
    np.testing.assert_array_equal(np.asarray(recording.frames), codes)  # orientation and codes, exactly
    assert recording.frames.dtype == np.uint16 and recording.frames.shape == (2, *SIZE)
    black = recording.black_map()
    clean = 0.5 * (codes - black) / (1023 - black)
    np.testing.assert_allclose(recording.clean[:], clean, atol=1e-6)
    assert recording.clean.dtype == np.float32
    assert recording.reference == "burst_mean" and recording.reference_frames == 150
    assert recording.iso == 800 and recording.exposure_s == pytest.approx(0.02)
    plane = ["RGB".index(c) for c in cfa]
    assert recording.shot == tuple(PROFILE[2 * p] for p in plane)
    assert recording.read == tuple(PROFILE[2 * p + 1] for p in plane)
    assert recording.code_step is None  # on codes, so to be detected
    assert scene_id(recording) == "001"


def test_pixels_are_read_when_indexed(tmp_path):
    recording = read_sidd(write_instance(tmp_path)[0])
    whole = np.asarray(recording.frames)
    np.testing.assert_array_equal(recording.frames[1], whole[1])
    np.testing.assert_array_equal(recording.frames[-1:], whole[-1:])
    np.testing.assert_array_equal(recording.frames[0:2, 2:6, 4:8], whole[:, 2:6, 4:8])
    np.testing.assert_array_equal(recording.frames[0, 3], whole[0, 3])
    assert recording.frames[2:].shape == (0, *SIZE)
    assert pack(recording.frames[:1], recording.cfa).shape == (1, SIZE[0] // 2, SIZE[1] // 2, 4)


def test_values_off_the_codes_are_stored_without_claims(tmp_path):
    codes = np.random.default_rng(1).uniform(70, 1000, (2, *SIZE))
    folder, _ = write_instance(tmp_path, codes=codes)
    recording = read_sidd(folder)
    assert recording.code_step == 0 and recording.white_level == 65535 and recording.black_level == (0,) * 4
    black = np.tile(np.reshape((60, 61, 62, 63), (2, 2)), (SIZE[0] // 2, SIZE[1] // 2))
    expected = (codes - black) / (1023 - black)
    np.testing.assert_allclose(normalise(recording.frames[:], recording), expected, atol=0.51 / 65535)
    assert recording.shot is not None  # coefficients are of normalised values: they still hold


def test_clipped_values_keep_the_codes(tmp_path):
    codes = np.random.default_rng(2).integers(0, 1100, (2, *SIZE))  # below black and above white
    recording = read_sidd(write_instance(tmp_path, codes=codes, black=(60.0, 60.0, 60.0, 60.0))[0])
    np.testing.assert_array_equal(recording.frames[:], codes.clip(60, 1023))


def test_a_later_frame_off_the_codes_is_noticed(tmp_path):
    codes = np.random.default_rng(3).integers(70, 1000, (2, *SIZE)) + np.array([0, 0.3])[:, None, None]
    recording = read_sidd(write_instance(tmp_path, codes=codes)[0])
    assert recording.frames[0].max() < 1023
    with pytest.raises(BadInput, match="NOISY_RAW_011.MAT: values are not the codes"):
        recording.frames[1]


def test_without_metadata_the_name_and_the_published_table_serve(tmp_path):
    recording = load_recording(write_instance(tmp_path, metadata=False, truth=False)[0])
    assert recording.cfa == "GRBG" and recording.iso == 800 and recording.exposure_s == 0.02
    assert recording.code_step == 0 and recording.shot is None and recording.clean is None
    unknown, _ = write_instance(tmp_path, number=2, camera="XX", metadata=False)
    with pytest.raises(BadInput, match="cfa is missing: set it with --cfa"):
        read_sidd(unknown)
    assert read_sidd(unknown, cfa="RGGB").camera == "XX"


def test_a_colour_order_that_contradicts_the_table_is_warned_of(tmp_path, caplog):
    assert read_sidd(write_instance(tmp_path, cfa="GBRG")[0]).cfa == "GBRG"
    assert "metadata say GBRG, the data set's table GRBG for S6" in caplog.text


def test_the_whole_set_by_camera(tmp_path):
    for number, camera, cfa, scene in (
        (3, "G4", "BGGR", "003"),
        (1, "IP", "RGGB", "001"),
        (2, "G4", "BGGR", "008"),
    ):
        write_instance(tmp_path / "Data", number, scene, camera, cfa)
    captures = load_sidd(tmp_path)
    assert [c.camera for c in captures] == ["IP", "G4"]
    assert [scene_id(r) for r in captures[1].recordings] == ["008", "003"]
    with pytest.raises(BadInput, match="2 cameras"):
        load_capture_set(tmp_path / "Data")
    assert load_capture_set(tmp_path / "Data", camera="any").camera == "any"
    with pytest.raises(BadInput, match="holds no SIDD folders"):
        load_sidd(tmp_path / "Data" / "0001_001_IP_00800_00050_3200_N" / "none")


def rewrite(folder, name, values):
    path = folder / name
    path.unlink()
    with h5py.File(path, "w") as file:
        file["x"] = values


FIRST = "0001_NOISY_RAW_010.MAT"
BROKEN = {
    "holds 2 NaN": lambda f: rewrite(f, FIRST, np.where(np.arange(240).reshape(20, 12) < 2, np.nan, 0.5)),
    "expected 0 to 1": lambda f: rewrite(f, FIRST, np.full((20, 12), 1.5)),
    "expected rows x columns": lambda f: rewrite(f, FIRST, np.zeros(3)),
    "not a readable MATLAB v7.3": lambda f: (f / FIRST).write_bytes(b"MATLAB 5.0 MAT-file"),
    "not a readable MATLAB v5": lambda f: (f / "0001_METADATA_RAW_010.MAT").write_bytes(b"short"),
    "holds no 0001_NOISY": lambda f: [p.unlink() for p in f.glob("*NOISY*")],
    "2 noisy images but 1 noise-free": lambda f: (f / "0001_GT_RAW_010.MAT").unlink(),
}


@pytest.mark.parametrize("message", BROKEN)
def test_broken_folders(tmp_path, message):
    folder, _ = write_instance(tmp_path)
    BROKEN[message](folder)
    with pytest.raises(BadInput, match=message) as caught:
        read_sidd(folder)
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


def test_images_of_different_sizes(tmp_path):
    folder, _ = write_instance(tmp_path)
    rewrite(folder, "0001_GT_RAW_011.MAT", np.zeros((20, 14), np.float32))
    with pytest.raises(BadInput, match="GT_RAW_011.MAT: 14 x 20 pixels"):
        read_sidd(folder).clean[1]


def test_a_folder_that_is_none(tmp_path):
    with pytest.raises(BadInput, match="not a SIDD folder"):
        load_recording(tmp_path)
