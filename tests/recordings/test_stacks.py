import json
import os
import struct

import h5py
import numpy as np
import pytest
import tifffile
from PIL import Image

from cannoise_jax.recordings.load import load_capture_set, load_recording
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.recordings.stacks import read_tiff

FRAMES = np.random.default_rng(0).integers(60, 1000, (3, 6, 8)).astype(np.uint16)
SIDE_CAR = {
    "cfa": "RGGB",
    "black_level": [60, 61, 62, 63],
    "white_level": 1023,
    "iso": 100,
    "exposure_s": None,
}
GREY = "minisblack"
WRITERS = {
    ".npy": lambda path, frames: np.save(path, frames),
    ".npz": lambda path, frames: np.savez_compressed(path, frames=frames),
    ".tif": lambda path, frames: tifffile.imwrite(path, frames, photometric="minisblack"),
    ".tiff": lambda path, frames: tifffile.imwrite(
        path, frames, photometric="minisblack", compression="zlib"
    ),
}


def write(path, frames=FRAMES, side_car=SIDE_CAR):
    WRITERS[path.suffix](path, frames)
    if side_car is not None:
        text = side_car if isinstance(side_car, str) else json.dumps(side_car)
        path.with_suffix(".json").write_text(text)
    return path


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("frames", [FRAMES, FRAMES[0]], ids=["stack", "single"])
def test_stacks_with_a_side_car(tmp_path, suffix, frames):
    path = write(
        tmp_path / f"a{suffix}", frames, SIDE_CAR | {"kind": "flat", "camera": "X", "note": "ignored"}
    )
    recording = load_recording(path)
    expected = frames.reshape(-1, 6, 8)
    np.testing.assert_array_equal(np.asarray(recording.frames), expected)
    np.testing.assert_array_equal(recording.frames[:1, 2:4], expected[:1, 2:4])
    assert recording.frames.dtype == np.uint16 and recording.black_level == (60, 61, 62, 63)
    assert (recording.iso, recording.exposure_s, recording.kind, recording.camera) == (100, None, "flat", "X")


def test_names_that_a_side_car_cannot_use_are_said_once(tmp_path, caplog):
    path = write(tmp_path / "a.npy", side_car=SIDE_CAR | {"blacklevel": 3, "gain": 1})
    load_recording(path)
    (record,) = caplog.records
    text = record.getMessage()
    assert text.startswith(f"{tmp_path / 'a.json'}: blacklevel, gain not used: ") and "black_level" in text
    caplog.clear()
    load_recording(write(tmp_path / "b.npy"))
    assert not caplog.records


def test_shot_noise_is_not_negative_but_an_offset_may_be(tmp_path):
    path = write(tmp_path / "a.npy", side_car=SIDE_CAR | {"shot": [1e-3, 1e-3, -1e-3, 1e-3], "read": 1e-5})
    with pytest.raises(
        BadInput, match=r"shot is 0\.001, 0\.001, -0\.001, 0\.001: expected at least 0"
    ) as caught:
        load_recording(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    for wrong in ({"read": -300}, {"shot": 1e30}, {"read": 9.0}):  # in DN, or no noise level at all
        path = write(tmp_path / "a.npy", side_car=SIDE_CAR | wrong)
        with pytest.raises(BadInput, match="noise wider than the whole range: write it normalised"):
            load_recording(path)
    path = write(tmp_path / "a.npy", side_car=SIDE_CAR | {"shot": 0, "read": -1e-6})
    assert load_recording(path).read == (-1e-6,) * 4


@pytest.mark.parametrize("suffix", WRITERS)
def test_without_a_side_car_the_caller_states_what_is_needed(tmp_path, suffix):
    path = write(tmp_path / f"a{suffix}", side_car=None)
    with pytest.raises(BadInput, match="cfa.* missing: set .* with --cfa"):
        load_recording(path)
    recording = load_recording(path, cfa="MONO", black_level=64, white_level=1023)
    assert recording.cfa == "MONO" and recording.camera == tmp_path.name


@pytest.mark.parametrize("suffix", WRITERS)
def test_only_whole_numbers_of_up_to_16_bits(tmp_path, suffix):
    eight = load_recording(write(tmp_path / f"a{suffix}", FRAMES.astype(np.uint8), SIDE_CAR))
    np.testing.assert_array_equal(eight.frames[:], FRAMES.astype(np.uint8))
    assert eight.frames.dtype == np.uint16
    for kind in (np.float32, np.int16, np.uint32):
        path = write(tmp_path / f"b{suffix}", FRAMES.astype(kind), SIDE_CAR)
        np.testing.assert_array_equal(np.asarray(load_recording(path).frames), FRAMES)
    for change, said in (
        (lambda x: x / 1000, "no whole"),
        (lambda x: x - 2000, "negative"),
        (lambda x: x * 99, "up to"),
    ):
        path = write(tmp_path / f"c{suffix}", change(FRAMES.astype(np.float64)).astype(np.float32), SIDE_CAR)
        with pytest.raises(BadInput, match=said):
            load_recording(path)


def test_other_byte_orders(tmp_path):
    np.save(tmp_path / "a.npy", FRAMES.astype(">u2"))
    tifffile.imwrite(tmp_path / "b.tif", FRAMES, byteorder=">", photometric="minisblack")
    for name in ("a.npy", "b.tif"):
        recording = load_recording(tmp_path / name, cfa="MONO", black_level=0, white_level=1023)
        np.testing.assert_array_equal(recording.frames[:], FRAMES)


def test_pages_of_other_dimensions_are_refused(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for page in (FRAMES[0], np.stack([FRAMES[0]] * 3, -1)):
            file.write(page, photometric="rgb" if page.ndim == 3 else "minisblack")
    with pytest.raises(BadInput, match="pages of shape .*: expected mosaics"):
        load_recording(tmp_path / "a.tif")


def test_npz_may_hold_the_reference_and_one_array_of_any_name(tmp_path):
    clean = np.random.default_rng(1).random((6, 8), np.float32)
    np.savez(tmp_path / "a.npz", frames=FRAMES, clean=clean)
    np.savez(tmp_path / "b.npz", anything=FRAMES)
    levels = {"cfa": "RGGB", "black_level": 64, "white_level": 1023}
    np.testing.assert_array_equal(load_recording(tmp_path / "a.npz", **levels).clean, clean)
    np.testing.assert_array_equal(load_recording(tmp_path / "b.npz", **levels).frames[:], FRAMES)
    np.savez(tmp_path / "c.npz", a=FRAMES, b=FRAMES)
    with pytest.raises(BadInput, match="c.npz: holds a, b: expected an array 'frames'"):
        load_recording(tmp_path / "c.npz", **levels)


def test_nothing_is_unpickled(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("unpickled",))

    np.save(tmp_path / "a.npy", np.array([Bomb()], object), allow_pickle=True)
    np.savez(tmp_path / "b.npz", frames=np.array([Bomb()], object))
    for name in ("a.npy", "b.npz"):
        with pytest.raises(BadInput, match="Python objects, which are not read: save the frames alone"):
            load_recording(tmp_path / name)


@pytest.mark.parametrize("suffix", WRITERS)
def test_broken_files(tmp_path, suffix):
    path = write(tmp_path / f"a{suffix}", np.tile(FRAMES, (4, 40, 40)))
    whole = path.read_bytes()
    for content in (b"", b"nonsense", whole[:60], whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(BadInput, match="not a readable|cannot read|does not fit") as caught:
            np.asarray(load_recording(path).frames)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_broken_side_cars(tmp_path):
    for text, message in (("{", "not a readable JSON"), ("[1]", "expected an object")):
        path = write(tmp_path / "a.npy", side_car=text)
        with pytest.raises(BadInput, match=f"a.json: {message}"):
            load_recording(path)
    path = write(tmp_path / "a.npy", side_car=SIDE_CAR | {"white_level": "bright"})
    with pytest.raises(BadInput, match="white_level 'bright'"):
        load_recording(path)


@pytest.mark.parametrize(
    "field, value, said",
    [
        ("camera", False, "camera False: expected text"),
        ("camera", True, "camera True: expected text"),
        ("egain", [[1]], r"egain \[\[1\]\]: expected one number"),
        ("white_level", [1023], r"white_level \[1023\]: expected one number"),
        ("exposure_s", 1e-320, "exposure_s is .*: too small to be meant"),
        ("exposure_s", 1e-12, "exposure_s is 1e-12: expected at least 1e-09, or 0"),
        ("exposure_s", 1e9, r"exposure_s is 1e\+09: expected at most 1e\+06"),
        ("exposure_s", -1, "exposure_s is -1: expected at least 0"),
        ("black_level", 1e-320, "black_level is .*: too small to be meant"),
        ("read", [1e-5, 1e-5, 1e-5, 1e-42], "read is .*: too small to be meant"),
    ],
)
def test_values_that_cannot_be_meant_are_refused(tmp_path, field, value, said):
    path = write(tmp_path / "a.npy", side_car=SIDE_CAR | {field: value})
    with pytest.raises(BadInput, match=f"a.npy: {said}") as caught:
        load_recording(path)
    assert "\n" not in str(caught.value)


def test_least_values_that_are_meant_are_read(tmp_path):
    stated = {"exposure_s": 1e-9, "black_level": 0, "camera": 7}
    recording = load_recording(write(tmp_path / "a.npy", side_car=SIDE_CAR | stated))
    assert (recording.exposure_s, recording.black_level, recording.camera) == (1e-9, (0,) * 4, "7")
    assert load_recording(tmp_path / "a.npy", exposure_s=0.0).exposure_s == 0


def test_values_that_a_format_has_rounded_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[[100, 3001]] * 4] * 2, np.float16))
    with pytest.raises(BadInput, match="a.npy: float16 values up to 3"):
        load_recording(tmp_path / "a.npy", cfa="MONO", black_level=0, white_level=4095)
    tifffile.imwrite(tmp_path / "b.tif", FRAMES[0], photometric="minisblack")
    with tifffile.TiffFile(tmp_path / "b.tif", mode="r+") as file:
        file.pages[0].tags["Compression"].overwrite(7)
    with pytest.raises(BadInput, match="b.tif: compressed as JPEG, which changes the pixels"):
        load_recording(tmp_path / "b.tif", cfa="MONO", black_level=0, white_level=4095)


def test_colour_images_and_mixed_pages_are_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((6, 8, 3), np.uint16), photometric="rgb")
    with tifffile.TiffWriter(tmp_path / "b.tif") as file:
        file.write(FRAMES[0], photometric="minisblack")
        file.write(FRAMES[0, :4], photometric="minisblack")
    tifffile.imwrite(tmp_path / "c.tif", np.stack([FRAMES[0]] * 3), photometric="rgb")  # its own guess
    for name, said in (("a", "hold colours"), ("b", "expected mosaics"), ("c", "hold colours: .*minisblack")):
        with pytest.raises(BadInput, match=f"{name}.tif: pages of shape .*{said}"):
            load_recording(tmp_path / f"{name}.tif", cfa="RGGB", black_level=0, white_level=1)
    np.save(tmp_path / "c.npy", np.zeros((1, 2, 6, 8), np.uint16))
    with pytest.raises(BadInput, match=r"shape \(1, 2, 6, 8\)"):
        load_recording(tmp_path / "c.npy", cfa="RGGB", black_level=0, white_level=1)


def test_unknown_formats(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"1")
    with pytest.raises(BadInput, match="unknown format '.txt': supported are .*.dng.*.fits.*.h5"):
        load_recording(tmp_path / "a.txt")
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8")
    with pytest.raises(BadInput, match="a.jpg: developed pictures .* hold no raw values: give what the"):
        load_recording(tmp_path / "a.jpg")


def test_real_single_frames(real_data):
    folder = real_data / "single_frames"
    nikon = load_recording(folder / "nikon_daylight.npy")
    assert nikon.cfa == "RGGB" and nikon.white_level == 16383 and nikon.frames.shape == (1, 512, 768)
    with pytest.raises(BadInput, match="canon100d_night.npy: cfa is missing: set it with --cfa"):
        load_recording(folder / "canon100d_night.npy")
    captures = load_capture_set(folder, cfa="RGGB", camera="single frames")
    assert [r.count for r in captures.recordings] == [1, 1]
    canon = captures.recordings[0]
    assert (canon.iso, canon.exposure_s, canon.temperature_c) == (100, 120.4, 11)
    with pytest.raises(BadInput, match="holds 2 cameras"):
        load_capture_set(folder, cfa="RGGB")


def test_pages_that_lead_back_to_themselves_are_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", FRAMES, photometric="minisblack", metadata=None)
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        first, last = file.pages[0].offset, file.pages[len(file.pages) - 1].offset
    data = bytearray((tmp_path / "a.tif").read_bytes())
    tags = int.from_bytes(data[last : last + 2], "little")
    at = last + 2 + 12 * tags
    assert data[at : at + 4] == b"\0\0\0\0"
    data[at : at + 4] = first.to_bytes(4, "little")
    for name in ("loop.tif", "loop.dng"):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(BadInput, match=f"{name}: not a readable TIFF file: page 3 leads back"):
            load_recording(tmp_path / name, cfa="MONO", black_level=0, white_level=1)


@pytest.mark.parametrize("at", [2**63 + 8, 2**63 - 1, 0, 16])
def test_directories_far_outside_of_the_file_are_refused(tmp_path, at):
    """Of a BigTIFF: where its first directory stands, and how many entries it claims."""
    data = b"II\x2b\0\x08\0\0\0" + at.to_bytes(8, "little") + b"\xff" * 64
    for name in ("far.tif", "far.dng"):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(BadInput, match=name):
            load_recording(tmp_path / name, cfa="MONO", black_level=0, white_level=1)


def test_claims_that_no_file_holds_are_refused_before_they_are_read(tmp_path):
    levels = {"cfa": "MONO", "black_level": 0, "white_level": 1023}
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", (9, 1 << 20, 1 << 20), np.uint16, chunks=(1, 1024, 1024))
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("frames", (10**7, 1024, 1024), np.uint16, chunks=(1, 1024, 1024))
    (tmp_path / "c.pgm").write_bytes(b"P5\n99999 99999\n65535\n")
    (tmp_path / "d.pgm").write_bytes(b"P5\n9999 9999\n65535\n")
    for name in ("a.h5", "b.h5", "c.pgm", "d.pgm"):
        with pytest.raises(BadInput, match=f"{name}: claims .*(no sensor|damaged)"):
            load_recording(tmp_path / name, **levels)


def test_pipes_and_links_to_nothing_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "a.fits")
    (tmp_path / "b.tif").symlink_to(tmp_path / "nowhere")
    with pytest.raises(BadInput, match="a.fits: is no plain file"):
        load_recording(tmp_path / "a.fits")
    for call in (lambda: load_recording(tmp_path / "b.tif"), lambda: load_capture_set(tmp_path)):
        with pytest.raises(BadInput, match="b.tif: a link to nothing"):
            call()


@pytest.mark.parametrize(
    ("photometric", "said"), [("miniswhite", "count down from white"), ("palette", "palette")]
)
def test_numbers_that_are_no_light_are_refused(tmp_path, photometric, said):
    colours = {"colormap": np.zeros((3, 256), np.uint16)} if photometric == "palette" else {}
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, FRAMES[0].astype(np.uint8), photometric=photometric, **colours)
    with pytest.raises(BadInput, match=said):
        load_recording(path, cfa="RGGB", black_level=0, white_level=255)


def test_side_cars_as_other_systems_write_them(tmp_path):
    path = write(tmp_path / "a.npy")
    beside, text = path.with_suffix(".json"), json.dumps(SIDE_CAR, indent=1)
    for content in (text.replace("\n", "\r\n").encode(), text.encode("utf-8-sig")):
        beside.write_bytes(content)
        assert load_recording(path).cfa == "RGGB"
    beside.write_bytes(text.encode("utf-16"))
    with pytest.raises(
        BadInput, match=r"a\.json: not a readable JSON file: no text in UTF-8: save it as that$"
    ):
        load_recording(path)
    beside.unlink()
    beside.symlink_to("nowhere.json")
    with pytest.raises(BadInput, match=r"a\.json: a link to nothing"):
        load_recording(path)


@pytest.mark.parametrize("dtype", [np.uint16, np.uint8])
@pytest.mark.parametrize("squeezed", ["tiff_lzw", "tiff_adobe_deflate", "packbits", None])
def test_pages_that_other_programs_compress(dtype, squeezed, tmp_path):
    frames = np.random.default_rng(0).integers(0, 200, (3, 8, 12)).astype(dtype)
    first, *others = (Image.fromarray(frame) for frame in frames)
    path = tmp_path / "stack.tif"
    first.save(path, save_all=True, append_images=others, compression=squeezed)
    found = read_tiff(path, cfa="MONO", black_level=0, white_level=255)
    np.testing.assert_array_equal(np.asarray(found.frames[:]), frames)
    np.testing.assert_array_equal(np.asarray(found.frames[2]), frames[2])


def test_a_compression_that_is_not_read_is_named(tmp_path):
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, np.zeros((8, 12), np.uint16))
    data = bytearray(path.read_bytes())
    at = data.index(struct.pack("<HHI", 259, 3, 1))
    data[at + 8 : at + 10] = struct.pack("<H", 50001)
    path.write_bytes(data)
    with pytest.raises(BadInput, match=r"stack.tif: its compression \(number 50001\) is not read: save"):
        read_tiff(path, cfa="MONO", black_level=0, white_level=255)
