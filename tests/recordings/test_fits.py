import bz2
import gzip

import numpy as np
import pytest
from astropy.io import fits

from cannoise_jax.recordings.fits import open_fits
from cannoise_jax.recordings.load import load_recording
from cannoise_jax.recordings.recording import BadInput

FRAMES = np.random.default_rng(0).integers(0, 65536, (4, 6, 10)).astype(np.uint16)
LEVELS = {"black_level": 100, "white_level": 65535}


def write(path, data, compress=False, **keywords):
    header = fits.Header()
    header.update({name.replace("_", "-"): value for name, value in keywords.items()})
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
    "X-Trans mosaic": (FRAMES, {"BAYERPAT": "GGRGGB"}),
    "1 value is NaN": (np.where(np.arange(FRAMES.size).reshape(FRAMES.shape) == 7, np.nan, 5.0), {}),
    "unknown CFA 'TRUE'": (FRAMES, {"BAYERPAT": "TRUE"}),
}


def test_frames_that_a_header_counts_are_no_average(tmp_path):
    path = write(tmp_path / "a.fits", FRAMES, BAYERPAT="RGGB", NFRAMES=len(FRAMES))
    assert load_recording(path, **LEVELS).count == len(FRAMES)
    path = write(tmp_path / "b.fits", FRAMES, BAYERPAT="RGGB", NFRAMES=len(FRAMES), NCOMBINE=12)
    with pytest.raises(BadInput, match="an average or sum of frames"):
        load_recording(path, **LEVELS)


@pytest.mark.parametrize("scale", [0, 10])
def test_what_was_compressed_with_loss_is_refused(tmp_path, scale):
    data = np.random.default_rng(1).integers(90, 120, (64, 64)).astype(np.int16)
    packed = fits.CompImageHDU(data, compression_type="HCOMPRESS_1", hcomp_scale=scale)
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "a.fits.fz")
    if scale:
        with pytest.raises(BadInput, match=r"compressed with loss \(HCOMPRESS, SCALE 10\)"):
            load_recording(tmp_path / "a.fits.fz", cfa="MONO", **LEVELS)
    else:
        read = load_recording(tmp_path / "a.fits.fz", cfa="MONO", **LEVELS)
        np.testing.assert_array_equal(np.asarray(read.frames)[0], data)


@pytest.mark.parametrize("message", BAD)
def test_what_is_no_raw_frame_is_refused_in_one_line(tmp_path, message):
    data, keywords = BAD[message]
    path = write(tmp_path / "a.fits", data, **keywords)
    with pytest.raises(BadInput, match=message) as caught:
        load_recording(path, **LEVELS)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_an_order_that_is_stated_does_not_make_other_colours_of_a_header(tmp_path):
    path = write(tmp_path / "a.fits", FRAMES, BAYERPAT="GGRGGB")
    with pytest.raises(BadInput, match="X-Trans mosaic"):
        load_recording(path, **LEVELS | {"cfa": "RGGB"})


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


@pytest.mark.parametrize(
    "keywords, seconds",
    [
        ({"EXPTIME": (1000.0, "[ms] exposure time")}, 1),
        ({"EXPTIME": (1000.0, "[s] exposure time")}, 1000),
        ({"EXPOSURE": (2500, "Exposure time (us)")}, 0.0025),
        ({"EXPOSURE": (2, "[min]")}, 120),
        ({"EXPOSURE": (4, "Exposure in milliseconds")}, 0.004),
        ({"EXPTIME": (4, "Total exposure, millisecond resolution")}, 4),
        ({"EXPOINUS": (20000, "Exposure time in us")}, 0.02),
        ({"EXPOINUS": 20000}, 0.02),
        ({"EXPTIME": "0,5"}, 0.5),
        ({"EXPTIME": "500 ms"}, 0.5),
        ({"EXPTIME": "1,500"}, None),  # thousands, or not
    ],
)
def test_exposures_have_the_unit_that_their_card_states(tmp_path, caplog, keywords, seconds):
    recording = load_recording(write(tmp_path / "a.fits", FRAMES, BAYERPAT="RGGB", **keywords), **LEVELS)
    assert recording.exposure_s == (seconds if seconds is None else pytest.approx(seconds))
    assert ("no time: not used" in caplog.text) == (seconds is None)


def test_units_are_kept_where_the_image_is_an_extension_and_exposures_are_compared_in_seconds(
    tmp_path, caplog
):
    header = fits.Header()
    header.update({"EXPTIME": (500.0, "[ms] exposure"), "EXPOSURE": 0.5, "CCD-TEMP": "-10,5"})
    for number, first in enumerate((fits.PrimaryHDU(header=header), fits.PrimaryHDU())):
        image = fits.ImageHDU(FRAMES, header if number else None)
        fits.HDUList([first, image]).writeto(path := tmp_path / f"{number}.fits")
        recording = load_recording(path, cfa="MONO", **LEVELS)
        assert (recording.exposure_s, recording.temperature_c) == (0.5, -10.5)
    assert "contradict" not in caplog.text


def test_rescaled_values(tmp_path):
    hdu = fits.PrimaryHDU(FRAMES.astype(np.int16))
    hdu.header["BSCALE"], hdu.header["BZERO"] = 0.5, 32768
    hdu.writeto(tmp_path / "a.fits")
    with pytest.raises(BadInput, match="BSCALE 0.5"):
        load_recording(tmp_path / "a.fits", cfa="MONO", **LEVELS)


@pytest.mark.parametrize("bits", [-32, -64])
def test_floating_point_values_with_the_zero_of_integers(tmp_path, bits):
    """Read by the letter, a BZERO that was left over would lift every value by 32768."""
    write(tmp_path / "a.fits", FRAMES.astype(f"f{-bits // 8}"))
    content = bytearray((tmp_path / "a.fits").read_bytes())
    end = next(at for at in range(0, 2880, 80) if content[at : at + 8] == b"END     ")
    content[end : end + 160] = b"BZERO   =              32768.0".ljust(80) + b"END".ljust(80)
    (tmp_path / "a.fits").write_bytes(content)
    with pytest.raises(BadInput, match="floating-point values with BZERO 32768"):
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
    for content in (b"", b"SIMPLE", whole[:100], whole[:2880], whole[:3000]):
        path.write_bytes(content)
        with pytest.raises(BadInput, match="not a readable FITS|holds no image") as caught:
            np.asarray(load_recording(path, **LEVELS).frames)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    fits.PrimaryHDU().writeto(path, overwrite=True)
    with pytest.raises(BadInput, match="holds no image"):
        load_recording(path)


def test_overscan_is_cut_and_becomes_the_black_level(tmp_path):
    data = np.random.default_rng(1).normal(500, 3, (12, 20)).round().astype(np.uint16)
    data[:, 16:] = 101
    more = {"BIASSEC": "[17:20,1:12]", "TRIMSEC": "[2:16,1:12]", "BAYERPAT": "RGGB"}
    recording = load_recording(write(tmp_path / "a.fits", data, **more), white_level=65535, cfa="MONO")
    np.testing.assert_array_equal(recording.frames[0], data[:, 1:16])
    assert recording.black_level == (101,) * 4
    even = write(tmp_path / "b.fits", data, **{**more, "TRIMSEC": "[2:15,1:12]"})
    assert load_recording(even, white_level=65535).cfa == "GRBG"  # one column further into the mosaic
    del more["TRIMSEC"]
    with pytest.raises(BadInput, match="no TRIMSEC or DATASEC"):
        load_recording(write(tmp_path / "c.fits", data, **more), white_level=65535)


def test_a_picture_section_alone_is_cut_and_sections_of_another_frame_are_said(tmp_path, caplog):
    data = np.random.default_rng(1).normal(500, 3, (12, 20)).round().astype(np.uint16)
    cut = load_recording(write(tmp_path / "a.fits", data, TRIMSEC="[3:16,1:12]"), cfa="MONO", **LEVELS)
    np.testing.assert_array_equal(cut.frames[0], data[:, 2:16])
    assert not caplog.text
    stale = {"BIASSEC": "[17:2000,1:12]", "TRIMSEC": "[16:2,1:0]"}
    whole = load_recording(write(tmp_path / "b.fits", data, **stale), cfa="MONO", **LEVELS)
    assert whole.size == (12, 20)
    assert "BIASSEC [17:2000,1:12], TRIMSEC [16:2,1:0]: no part of 12 x 20 pixels: not used" in caplog.text


def amplifiers(path, whole, detsec=True, gap=0):
    """Two amplifiers side by side, the right one read from its far end, each with two columns of overscan."""
    hdus = [fits.PrimaryHDU()]
    hdus[0].header["INSTRUME"] = "Acme Twin"
    for n, (columns, place) in enumerate(((slice(0, 6), "[1:6,1:8]"), (slice(6, 12), "[12:7,1:8]"))):
        data = whole[:, columns][:, :: -1 if n else 1]
        data = np.concatenate([data, np.full((8, 2), 90 + 4 * n)], 1).astype(np.uint16)
        hdu = fits.ImageHDU(data, name=f"AMP{n}")
        hdu.header["DATASEC"], hdu.header["BIASSEC"] = "[1:6,1:8]", "[7:8,1:8]"
        if detsec:
            hdu.header["DETSEC"] = place.replace("12:7", f"{12 + gap}:{7 + gap}")
        hdus.append(hdu)
    fits.HDUList(hdus).writeto(path)
    return path


def test_amplifiers_are_put_where_they_lie(tmp_path):
    whole = np.random.default_rng(2).integers(100, 60000, (8, 12)).astype(np.uint16)
    recording = load_recording(amplifiers(tmp_path / "a.fits", whole), cfa="MONO", white_level=65535)
    np.testing.assert_array_equal(recording.frames[:], whole[None])
    np.testing.assert_array_equal(recording.frames[0, 2:4, 5:9], whole[2:4, 5:9])
    assert recording.camera == "Acme Twin" and recording.black_level == (92,) * 4
    for gains, said in (((1.5, 1.55), False), ((1.5, 2.5), True)):
        for n, gain in enumerate(gains):
            fits.setval(tmp_path / "a.fits", "GAIN", value=gain, ext=n + 1)
        doubt = open_fits(tmp_path / "a.fits").about["doubt"]
        assert (doubt is not None and "state gains of 1.5, 2.5 e-/DN" in doubt) == said
    with pytest.raises(BadInput, match="holds 2 images .AMP0, AMP1. and no DETSEC"):
        load_recording(amplifiers(tmp_path / "b.fits", whole, detsec=False), cfa="MONO", white_level=65535)
    with pytest.raises(BadInput, match="overlap or leave gaps"):
        load_recording(amplifiers(tmp_path / "c.fits", whole, gap=2), cfa="MONO", white_level=65535)


@pytest.mark.parametrize(
    ("camera", "gain", "expected"),
    [
        ("ZWO ASI294MC Pro", 0, (100, 0, None, None)),
        ("ZWO ASI294MC Pro", 200, (1000, 20, None, None)),
        ("Poseidon-C (Player One)", 60, (10**0.3 * 100, 6, None, None)),
        ("QHY268M", 56, (None, None, 56, None)),
        ("SBIG STL-1001", 1.6, (None, None, None, 1.6)),
    ],
)
def test_a_gain_is_no_iso(tmp_path, camera, gain, expected):
    opened = open_fits(write(tmp_path / "a.fits", FRAMES[0], INSTRUME=camera, GAIN=gain))
    said = (opened.known["iso"], opened.known["gain_db"], opened.about["gain_setting"], opened.known["egain"])
    assert said == (None if expected[0] is None else pytest.approx(expected[0]), *expected[1:])


def test_three_planes_of_a_developed_picture(tmp_path):
    colours = np.stack([np.full((6, 10), v) for v in (900, 1800, 1200)]).astype(np.uint16)
    with pytest.raises(BadInput, match="the colours of a developed picture"):
        load_recording(write(tmp_path / "a.fits", colours), cfa="MONO", **LEVELS)
    frames = np.random.default_rng(0).normal(900, 5, (3, 6, 10)).astype(np.uint16)
    assert load_recording(write(tmp_path / "b.fits", frames), cfa="MONO", **LEVELS).count == 3


def test_three_planes_that_are_no_three_frames_or_may_be_none(tmp_path, caplog):
    frames = np.random.default_rng(0).normal(900, 5, (3, 6, 10)).astype(np.uint16)
    with pytest.raises(BadInput, match="three planes of the same pixels are a grey picture"):
        load_recording(write(tmp_path / "a.fits", frames[[0, 0, 0]]), cfa="MONO", **LEVELS)
    assert load_recording(write(tmp_path / "b.fits", frames), cfa="MONO", **LEVELS).count == 3
    assert "b.fits: three planes are read as three frames" in caplog.text
    caplog.clear()
    assert load_recording(write(tmp_path / "c.fits", frames, CTYPE3="TIME"), cfa="MONO", **LEVELS).count == 3
    assert load_recording(write(tmp_path / "d.fits", frames[:2]), cfa="MONO", **LEVELS).count == 2
    assert not caplog.text


def test_a_picture_of_three_values_a_pixel(tmp_path):
    colours = np.random.default_rng(0).integers(800, 1000, (20, 30, 3)).astype(np.uint16)
    np.save(tmp_path / "a.npy", colours)
    for path in (write(tmp_path / "a.fits", colours), tmp_path / "a.npy"):
        with pytest.raises(BadInput, match="3 values a pixel are the colours of a developed picture"):
            load_recording(path, cfa="MONO", **LEVELS)


def test_a_kind_that_is_not_known_is_said(tmp_path, caplog):
    path = write(tmp_path / "a.fits", FRAMES[0], IMAGETYP="Zorbl")
    assert load_recording(path, cfa="MONO", **LEVELS).kind == "scene"
    assert "IMAGETYP 'Zorbl' is unknown: taken for a scene" in caplog.text
    caplog.clear()
    assert load_recording(path, cfa="MONO", kind="dark", **LEVELS).kind == "dark" and not caplog.text


def test_accents_in_a_header_do_no_harm(tmp_path):
    """The standard forbids them, and programs write them: an observer, a place."""
    path = write(tmp_path / "a.fits", FRAMES, INSTRUME="Camera", OBSERVER="Jose X")
    path.write_bytes(path.read_bytes().replace(b"Jose", b"Jos\xe9"))
    recording = load_recording(path, cfa="MONO", black_level=0, white_level=65535)
    np.testing.assert_array_equal(recording.frames[:], FRAMES)
    assert recording.camera == "Camera"


@pytest.mark.parametrize("name", ["a.fits", "a.fits.gz"])
def test_a_header_that_never_ends_is_not_read_to_the_end_of_the_file(tmp_path, name):
    """Zeros behind an image are a header to its reader: of a gigabyte of them, packed into one megabyte."""
    sound = write(tmp_path / "sound.fits", FRAMES[0], BAYERPAT="RGGB").read_bytes()
    content = sound + bytes(2880 * 1001)
    (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    with pytest.raises(BadInput, match="a header without an end"):
        open_fits(tmp_path / name)


def test_packings_that_nobody_asked_for_are_named(tmp_path):
    path = write(tmp_path / "a.fits", FRAMES[0])
    path.write_bytes(bz2.compress(path.read_bytes()))
    with pytest.raises(BadInput, match="packed with bzip2: unpack it"):
        open_fits(path)


def with_card(path, name, value):
    """The file with one card of its header replaced."""
    content = bytearray(path.read_bytes())
    at = content.index(name.encode().ljust(8))
    content[at : at + 80] = f"{name:8}= {value:>20}".ljust(80).encode()
    path.write_bytes(content)


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("SIMPLE", "F", "SIMPLE is 'F', not T"),
        ("NAXIS2", "-6", "NAXIS2 is '-6': its header is damaged"),  # its reader would follow it for ever
        ("NAXIS2", "- 6", "NAXIS2 is '- 6'"),
        ("NAXIS2", "", "NAXIS2 says nothing"),
        ("NAXIS1", "99999999999", "its header claims .* bytes: damaged"),
        ("NAXIS1", "4000", "it ends before the 192000 bytes that its header states"),
        ("BITPIX", "17", "BITPIX is 17"),
        ("BZERO", "'1'", "BZERO of its header is '1', no number"),
        ("BSCALE", "", "BSCALE of its header is None, no number"),
        ("EXPTIME", "'long", "the value of EXPTIME in its header cannot be read: mend or remove that card"),
    ],
)
def test_what_a_header_cannot_mean_is_said_in_our_words(tmp_path, name, value, message):
    path = write(tmp_path / "a.fits", FRAMES, BAYERPAT="RGGB", EXPTIME=1.0)
    with_card(path, name, value)
    with pytest.raises(BadInput, match=message) as caught:
        load_recording(path, **LEVELS)
    assert "astropy" not in str(caught.value) and "verify" not in str(caught.value)


def test_a_gzip_stream_that_ends_early_or_is_damaged(tmp_path):
    whole = gzip.compress(write(tmp_path / "a.fits", FRAMES, BAYERPAT="RGGB").read_bytes())
    path = tmp_path / "b.fits.gz"
    for content, message in ((whole[:-200], "cut short"), (whole[:-8] + bytes(8), "damaged")):
        path.write_bytes(content)
        with pytest.raises(BadInput, match=f"its gzip stream is {message}: copy it again"):
            load_recording(path, **LEVELS)


def test_files_without_the_padding_behind_their_pixels_are_read(tmp_path):
    path = write(tmp_path / "a.fits", FRAMES, BAYERPAT="RGGB")
    path.write_bytes(path.read_bytes()[: 2880 + FRAMES.nbytes])
    np.testing.assert_array_equal(load_recording(path, **LEVELS).frames[:], FRAMES)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(BadInput, match="cut short"):
        load_recording(path, **LEVELS)
