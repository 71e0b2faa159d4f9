import numpy as np
import pytest
from astropy.io import fits

from cannoise_jax.recordings.load import load_recording
from cannoise_jax.recordings.recording import BadInput

FRAMES = np.random.default_rng(0).integers(0, 65536, (4, 6, 10)).astype(np.uint16)
LEVELS = {"black_level": 100, "white_level": 65535}


def write(path, data, compress=False, **keywords):
    header = fits.Header({name.replace("_", "-"): value for name, value in keywords.items()})
    if compress:
        fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(data, header)]).writeto(path)
    else:
        fits.PrimaryHDU(data, header).writeto(path)
    return path


@pytest.mark.parametrize("compress", [False, True])
def test_a_cube_of_unsigned_frames(tmp_path, compress):
    path = write(
        tmp_path / ("a.fits.fz" if compress else "a.fits"),
        FRAMES,
        compress,
        BAYERPAT="GRBG",
        EXPTIME=2.5,
        GAIN=120,
        CCD_TEMP=-10.5,
        INSTRUME="ZWO ASI178MC",
        IMAGETYP="Dark Frame",
        SATURATE=65535.0,
    )
    recording = load_recording(path, black_level=1368)
    np.testing.assert_array_equal(np.asarray(recording.frames), FRAMES)
    assert recording.frames.dtype == np.uint16 and recording.frames[1:3].dtype == np.uint16
    np.testing.assert_array_equal(recording.frames[1:3, 2:4, 1:], FRAMES[1:3, 2:4, 1:])
    np.testing.assert_array_equal(recording.frames[-1], FRAMES[-1])
    assert recording.cfa == "GRBG" and recording.white_level == 65535 and recording.kind == "dark"
    assert (recording.exposure_s, recording.iso, recording.temperature_c) == (
        2.5,
        pytest.approx(100 * 10**0.6),
        -10.5,
    )
    assert recording.gain_db == 12
    assert recording.camera == "ZWO ASI178MC" and recording.black_level == (1368,) * 4


def test_a_single_frame_and_eight_bits(tmp_path):
    one = load_recording(write(tmp_path / "a.fit", FRAMES[0], ISO=800, EXPOSURE=0.1), cfa="MONO", **LEVELS)
    np.testing.assert_array_equal(one.frames[:], FRAMES[:1])
    np.testing.assert_array_equal(one.frames[0, 1:3], FRAMES[0, 1:3])
    assert one.iso == 800 and one.exposure_s == 0.1 and one.kind == "scene" and one.camera == tmp_path.name
    eight = load_recording(write(tmp_path / "b.fts", (FRAMES[0] >> 8).astype(np.uint8)), cfa="MONO", **LEVELS)
    np.testing.assert_array_equal(eight.frames[0], FRAMES[0] >> 8)
    assert eight.frames[:].dtype == np.uint16


@pytest.mark.parametrize(
    "offsets, cfa", [((0, 0), "RGGB"), ((1, 0), "GRBG"), ((0, 1), "GBRG"), ((1, 1), "BGGR")]
)
def test_offsets_of_the_colour_order(tmp_path, offsets, cfa):
    path = write(tmp_path / "a.fits", FRAMES, BAYERPAT="RGGB", XBAYROFF=offsets[0], YBAYROFF=offsets[1])
    assert load_recording(path, **LEVELS).cfa == cfa


def test_files_that_run_bottom_up_are_turned(tmp_path):
    path = write(tmp_path / "a.fits", FRAMES, BAYERPAT="RGGB", ROWORDER="BOTTOM-UP")
    recording = load_recording(path, **LEVELS)
    np.testing.assert_array_equal(recording.frames[:], FRAMES[:, ::-1])
    np.testing.assert_array_equal(recording.frames[2, 1:4, 3], FRAMES[2, ::-1][1:4, 3])


BAD = {
    "floating-point values that are no whole numbers": (FRAMES.astype(np.float32) + 0.5, {}),
    "negative values": (FRAMES.astype(np.int16), {}),
    "values up to .*: sums of frames": (FRAMES.astype(np.int32) * 100, {}),
    r"calibrated values \(CALSTAT BDF\)": (FRAMES, {"CALSTAT": "BDF"}),
    r"calibrated values \(BUNIT electron\)": (FRAMES, {"BUNIT": "electron"}),
    r"image has shape \(3, 6, 10\)": (FRAMES[:3], {"CTYPE3": "RGB"}),
    r"image has shape \(2, 2, 6, 10\)": (FRAMES.reshape(2, 2, 6, 10), {}),
    "odd size": (FRAMES[:, :5], {"BAYERPAT": "RGGB"}),
    "unknown CFA 'TRUE'": (FRAMES, {"BAYERPAT": "TRUE"}),
}


@pytest.mark.parametrize("message", BAD)
def test_what_is_no_raw_frame_is_refused_in_one_line(tmp_path, message):
    data, keywords = BAD[message]
    path = write(tmp_path / "a.fits", data, **keywords)
    with pytest.raises(BadInput, match=message) as caught:
        load_recording(path, **LEVELS)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "keywords, known",
    [
        ({"CCD_TEMP": "n/a", "EXPTIME": "long", "GAIN": -1}, (None, None, None)),
        ({"CCD_TEMP": -999.0, "EXPTIME": -1.0, "EXPOSURE": 2.0, "ISO": "auto", "GAIN": 120}, (None, 2, None)),
        ({"CCD_TEMP": "-10.5", "EXPTIME": 0.0, "GAIN": 0}, (-10.5, 0, None)),
    ],
)
def test_optional_keywords_that_say_nothing_count_as_not_stated(tmp_path, keywords, known):
    recording = load_recording(write(tmp_path / "a.fits", FRAMES, BAYERPAT="RGGB", **keywords), **LEVELS)
    assert (recording.temperature_c, recording.exposure_s, recording.iso) == known


def test_rescaled_values(tmp_path):
    hdu = fits.PrimaryHDU(FRAMES.astype(np.int16))
    hdu.header["BSCALE"], hdu.header["BZERO"] = 0.5, 32768
    hdu.writeto(tmp_path / "a.fits")
    with pytest.raises(BadInput, match="BSCALE 0.5"):
        load_recording(tmp_path / "a.fits", cfa="MONO", **LEVELS)


def test_missing_metadata_names_its_flag(tmp_path):
    path = write(tmp_path / "a.fits", FRAMES)
    for given, flag in (
        ({}, "--cfa"),
        ({"cfa": "MONO"}, "--black-level"),
        ({"cfa": "MONO", "black_level": 1}, "--white"),
    ):
        with pytest.raises(BadInput, match=flag):
            load_recording(path, **given)


def test_broken_files(tmp_path):
    path = write(tmp_path / "a.fits", FRAMES, BAYERPAT="RGGB")
    whole = path.read_bytes()
    for content in (b"", b"SIMPLE", whole[:100], whole[:2880], whole[:-1000]):
        path.write_bytes(content)
        with pytest.raises(BadInput, match="not a readable FITS|holds no image") as caught:
            np.asarray(load_recording(path, **LEVELS).frames)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    fits.PrimaryHDU().writeto(path, overwrite=True)
    with pytest.raises(BadInput, match="holds no image"):
        load_recording(path)
