import numpy as np
import pytest
import rawpy

from cannoise_jax.recordings import camera_raw, raw_tags
from cannoise_jax.recordings.camera_raw import read_camera_raw
from cannoise_jax.recordings.load import load_recording
from cannoise_jax.recordings.packing import pack
from cannoise_jax.recordings.recording import BadInput
from tests.recordings.dng import ASCII, LONG, SHORT, write_dng

LEVELS = {"R": 100, "G": 300, "B": 200}  # mean DN of each colour, so a wrong phase shows
BLACK = (60.0, 61.5, 62.25, 63.0)
PROFILE = (1e-3, 1e-6, 2e-3, 2e-6, 3e-3, 3e-6)  # S, O of R, G, B


def sensor(cfa, active=(0, 0, 104, 160), size=(104, 160), seed=0):
    """Pixels whose mean tells their colour inside the active area; 50 + site outside of it."""
    rows, columns = np.indices(size)
    top, left, bottom, right = active
    cell = np.array([LEVELS[c] for c in cfa]).reshape(2, 2)
    site = 2 * ((rows - top) % 2) + (columns - left) % 2
    values = cell[(rows - top) % 2, (columns - left) % 2]
    values = values + np.random.default_rng(seed).integers(-20, 21, size)
    inside = (rows >= top) & (rows < bottom) & (columns >= left) & (columns < right)
    return np.where(inside, values, 50 + site).astype(np.uint16)


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("cfa", ["RGGB", "GRBG", "GBRG", "BGGR"])
def test_every_field_of_a_dng(tmp_path, cfa, nested):
    pixels = sensor(cfa)
    path = write_dng(
        tmp_path / "a.dng", pixels, cfa=cfa, black=BLACK, white=1000, noise_profile=PROFILE, nested=nested
    )
    with rawpy.imread(str(path)) as raw:  # LibRaw itself takes the file
        assert raw.raw_image_visible.shape == (104, 160)
    recording = read_camera_raw(path)
    np.testing.assert_array_equal(recording.frames, pixels[None])
    assert recording.frames.dtype == np.uint16
    assert recording.cfa == cfa and recording.white_level == 1000 and recording.black_level == BLACK
    assert recording.camera == "Acme Phone 3" and recording.kind == "scene" and recording.path == str(path)
    assert recording.iso == 400 and recording.exposure_s == pytest.approx(0.02)
    plane = ["RGB".index(c) for c in cfa]
    assert recording.shot == pytest.approx([PROFILE[2 * p] for p in plane])
    assert recording.read == pytest.approx([PROFILE[2 * p + 1] for p in plane])


@pytest.mark.parametrize("active", [(4, 6, 100, 150), (3, 6, 100, 149), (4, 5, 99, 150), (3, 5, 98, 151)])
@pytest.mark.parametrize("cfa", ["RGGB", "GBRG"])
def test_colours_and_black_levels_follow_an_odd_visible_area(tmp_path, cfa, active):
    path = write_dng(
        tmp_path / "a.dng", sensor(cfa, active), cfa=cfa, active=active, black=BLACK, noise_profile=PROFILE
    )
    recording = read_camera_raw(path)
    height, width = recording.size
    assert height % 2 == width % 2 == 0
    assert active[2] - active[0] - 2 <= height <= active[2] - active[0]
    assert active[3] - active[1] - 2 <= width <= active[3] - active[1]
    means = pack(recording.frames[0], recording.cfa).mean(axis=(0, 1))
    np.testing.assert_allclose(means, [100, 300, 300, 200], atol=2)
    # Each pixel keeps the black level that the file gives for its place on the sensor.
    stated = dict(zip(np.ndindex(2, 2), BLACK, strict=True))
    for site, black in enumerate(recording.black_level):
        colour = recording.cfa[site]
        places = [place for place, value in stated.items() if value == black]
        assert [cfa[2 * i + j] for i, j in places] == [colour]
        assert recording.shot[site] == pytest.approx(PROFILE[2 * "RGB".index(colour)])
    assert sorted(recording.black_level) == sorted(BLACK)


def test_one_noise_profile_for_all_and_none(tmp_path):
    path = write_dng(tmp_path / "a.dng", sensor("BGGR"), cfa="BGGR", noise_profile=(4e-4, 5e-7))
    assert read_camera_raw(path).shot == (4e-4,) * 4 and read_camera_raw(path).read == (5e-7,) * 4
    none = read_camera_raw(write_dng(tmp_path / "c.dng", sensor("RGGB"), iso=None, exposure_s=None))
    assert none.shot is None and none.read is None and none.iso is None and none.exposure_s is None


@pytest.mark.parametrize("shot", [-1e-4, float("nan"), 1e30])
def test_an_impossible_noise_profile_is_left_out_and_the_image_used(tmp_path, caplog, shot):
    pixels = sensor("RGGB")
    path = write_dng(tmp_path / "a.dng", pixels, noise_profile=[1e-3, 1e-6, shot, 1e-6, 1e-3, 1e-6])
    recording = load_recording(path)
    assert recording.shot is None and recording.read is None
    np.testing.assert_array_equal(recording.frames[:], pixels[None])
    assert "NoiseProfile" in caplog.text and str(path) in caplog.text


def test_a_noise_profile_that_fits_no_plane_is_left_out(tmp_path, caplog):
    path = write_dng(tmp_path / "a.dng", sensor("RGGB"), noise_profile=[1e-3, 1e-6] * 5)
    assert read_camera_raw(path).shot is None
    assert "5 pairs, not one a colour" in caplog.text


def test_a_noise_profile_of_an_odd_count_is_left_out(tmp_path, caplog):
    path = write_dng(tmp_path / "a.dng", sensor("RGGB"), noise_profile=[1e-3])
    assert read_camera_raw(path).shot is None
    assert "1 numbers, not pairs" in caplog.text


def test_masked_areas_that_are_no_areas_are_refused(tmp_path):
    path = write_dng(tmp_path / "a.dng", sensor("RGGB"), black=(0,) * 4, extra={50830: (LONG, [4, 0, 100])})
    with pytest.raises(BadInput, match=r"a\.dng: tags that make no sense"):
        read_camera_raw(path)


def test_a_masked_border_keeps_its_phase(tmp_path):
    active = (5, 8, 101, 152)
    path = write_dng(tmp_path / "a.dng", sensor("GRBG", active), cfa="GRBG", active=active, black=(0,) * 4)
    with rawpy.imread(str(path)) as raw:
        visible = raw.sizes.top_margin, raw.sizes.left_margin
    # Outside the active area a pixel reads 50 + its site counted from the active area's corner.
    shift = 2 * ((visible[0] - active[0]) % 2) + (visible[1] - active[1]) % 2
    expected = tuple(50 + (site ^ shift) for site in range(4))
    assert read_camera_raw(path).black_level == expected


def test_masked_areas_that_the_file_names(tmp_path):
    active = (4, 8, 100, 152)
    masked = [4, 0, 100, 6, 0, 8, 2, 152]
    raw = np.full((104, 160), 900, np.uint16)
    for top, left, bottom, right in np.reshape(masked, (-1, 4)):
        raw[top:bottom, left:right] = sensor("RGGB", active)[top:bottom, left:right]
    extra = {50830: (LONG, masked)}
    path = write_dng(tmp_path / "a.dng", raw, active=active, extra=extra, black=(0,) * 4)
    assert read_camera_raw(path).black_level == (50, 51, 52, 53)


def test_no_masked_pixels(tmp_path):
    opened = camera_raw.open_camera_raw(write_dng(tmp_path / "a.dng", sensor("RGGB"), black=(0,) * 4))
    assert opened.known["black_level"] == (0,) * 4 and not opened.about


def test_mosaics_that_are_not_bayer_are_refused_in_one_line(tmp_path):
    x_trans = "GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG"
    pixels = sensor("RGGB")
    cases = {
        "X-Trans mosaic": write_dng(tmp_path / "x.dng", pixels, cfa=x_trans),
        "all colours in every pixel": write_dng(tmp_path / "f.dng", np.stack([pixels] * 3, -1), samples=3),
        "mosaic of cyan, yellow, magenta": write_dng(tmp_path / "c.dng", pixels, cfa="CYYM"),
        "RGBG mosaic": write_dng(tmp_path / "g.dng", pixels, cfa="RGBG"),
        r"planes \[1\] are not red": write_dng(tmp_path / "one.dng", pixels, plane_colours="G"),
        "are not red, green, blue": write_dng(tmp_path / "p.dng", pixels, plane_colours="BGR"),
    }
    for message, path in cases.items():
        with pytest.raises(BadInput, match=message) as caught:
            read_camera_raw(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_broken_files(tmp_path):
    path = write_dng(tmp_path / "a.dng", sensor("RGGB"))
    whole = path.read_bytes()
    for length in (0, 50, 600, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(BadInput, match="truncated|not a readable camera raw") as caught:
            read_camera_raw(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(BadInput, match="no such file"):
        read_camera_raw(tmp_path / "none.dng")


def test_a_monochrome_sensor(tmp_path):
    pixels = sensor("RGGB", size=(103, 159))  # odd sizes are fine without a colour cell
    recording = read_camera_raw(write_dng(tmp_path / "a.dng", pixels, cfa="", noise_profile=(4e-4, 5e-7)))
    assert recording.cfa == "MONO" and recording.black_level == (64,) * 4 and recording.shot == (4e-4,) * 4
    np.testing.assert_array_equal(recording.frames[0], pixels)


def test_the_callers_word_wins_over_the_tags(tmp_path):
    extra = {271: (ASCII, "Acme"), 272: (ASCII, "Acme Z"), 274: (SHORT, [6])}
    path = write_dng(tmp_path / "a.dng", sensor("RGGB"), extra=extra)
    assert load_recording(path).camera == "Acme Z"
    recording = load_recording(path, cfa="MONO", black_level=10, iso=100, kind="flat", camera="mine")
    assert (recording.cfa, recording.iso, recording.kind, recording.camera) == ("MONO", 100, "flat", "mine")
    assert recording.black_level == (10,) * 4
    assert recording.size == (104, 160)  # orientation is for viewing: the sensor's own rows are kept


def test_masked_pixels_give_the_black_level_that_no_tag_states(tmp_path):
    raw = np.full((68, 96), 900, np.uint16)
    raw[:4] = 70 + np.arange(96) % 2  # a masked border, its columns one code apart
    path = write_dng(tmp_path / "a.dng", raw, black=(0, 0, 0, 0), active=(4, 0, 68, 96))
    opened = camera_raw.open_camera_raw(path)
    assert opened.known["black_level"] == (70, 71, 70, 71) and opened.about["black_from"] == "masked pixels"
    stated = write_dng(tmp_path / "b.dng", raw, black=(64, 64, 64, 64), active=(4, 0, 68, 96))
    assert camera_raw.open_camera_raw(stated).known["black_level"] == (64,) * 4


@pytest.mark.parametrize(("stated", "taken"), [("31", 31.0), ("-4 C", -4.0), ("165", None), ("--5", None)])
def test_a_temperature_that_no_sensor_has_is_not_taken(stated, taken, tmp_path, monkeypatch):
    (tmp_path / "a.cr2").write_bytes(b"")
    tags = {"MakerNote CameraTemperature": stated}
    monkeypatch.setattr(raw_tags.exifread, "process_file", lambda file, details: tags)
    assert raw_tags.exif_of(tmp_path / "a.cr2").get("temperature_c") == taken
