"""PGM and PNG mosaics: what is read, and what is refused in one line."""

import json
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from cannoise_jax.recordings.load import load_recording
from cannoise_jax.recordings.pictures import open_picture
from cannoise_jax.recordings.recording import BadInput

FRAME = np.random.default_rng(0).integers(60, 1000, (6, 8)).astype(np.uint16)
LEVELS = {"cfa": "MONO", "black_level": 60}


def pgm(frame, white, text=False):
    head = b"%s\n# by hand\n%d %d\n%d\n" % (b"P2" if text else b"P5", frame.shape[1], frame.shape[0], white)
    if text:
        return head + b" ".join(b"%d" % v for v in frame.ravel())
    return head + frame.astype(">u2" if white > 255 else "u1").tobytes()


@pytest.mark.parametrize("text", [False, True])
def test_pgm_states_its_white_level(tmp_path, text):
    (tmp_path / "a.pgm").write_bytes(pgm(FRAME, 1023, text))
    recording = load_recording(tmp_path / "a.pgm", **LEVELS)
    np.testing.assert_array_equal(np.asarray(recording.frames), FRAME[None])
    assert recording.white_level == 1023


def test_several_images_of_one_file_and_eight_bits(tmp_path):
    (tmp_path / "a.pgm").write_bytes(pgm(FRAME, 4095) + pgm(FRAME + 1, 4095))
    np.testing.assert_array_equal(load_recording(tmp_path / "a.pgm", **LEVELS).frames[:], [FRAME, FRAME + 1])
    (tmp_path / "b.pgm").write_bytes(pgm(FRAME // 4, 255))
    with pytest.raises(BadInput, match="set it with --white-level"):  # 255 is the container's
        load_recording(tmp_path / "b.pgm", **LEVELS)
    np.testing.assert_array_equal(
        load_recording(tmp_path / "b.pgm", white_level=255, **LEVELS).frames[0], FRAME // 4
    )


def test_grey_png_with_a_side_car(tmp_path):
    Image.fromarray(FRAME).save(tmp_path / "a.png")
    (tmp_path / "a.json").write_text(json.dumps({**LEVELS, "white_level": 1023, "kind": "flat"}))
    recording = load_recording(tmp_path / "a.png")
    np.testing.assert_array_equal(np.asarray(recording.frames[0]), FRAME)
    assert recording.kind == "flat"


def test_grey_bmp_is_a_mosaic_of_8_bits(tmp_path):
    values = (FRAME // 4).astype(np.uint8)
    Image.fromarray(values).save(tmp_path / "a.bmp")
    np.testing.assert_array_equal(
        load_recording(tmp_path / "a.bmp", white_level=255, **LEVELS).frames[0], values
    )
    Image.fromarray(np.stack([values] * 3, -1)).save(tmp_path / "b.bmp")
    with pytest.raises(BadInput, match="colours or a palette"):
        load_recording(tmp_path / "b.bmp", white_level=255, **LEVELS)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.pgm", b"P6\n2 2\n255\n" + bytes(12), "colours"),
        ("a.pgm", b"P5\n8 6\n1023\n" + bytes(10), "truncated"),
        ("a.pgm", b"P5\n2 2\n0\n" + bytes(4), "highest value 0"),
        ("a.pgm", pgm(FRAME, 100), "truncated, or values above"),
        ("a.pgm", pgm(FRAME, 1023) + pgm(FRAME[:4], 1023), "several sizes"),
        ("a.png", b"nonsense", "not a readable PNG"),
        ("a.bmp", b"nonsense", "not a readable BMP"),
    ],
)
def test_broken_pictures(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BadInput, match=said) as caught:
        load_recording(tmp_path / name, white_level=1023, **LEVELS)
    assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)


def test_colours_are_refused(tmp_path):
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "a.png")
    with pytest.raises(BadInput, match="expected a grey mosaic"):
        load_recording(tmp_path / "a.png", white_level=255, **LEVELS)


def test_large_pictures_are_held_to_the_limit_of_sensors_alone(tmp_path):
    """A hundred megapixels are a sensor's; a picture that claims more than any has is refused unread."""
    path = tmp_path / "a.png"
    Image.new("L", (11648, 8736), 9).save(path)
    assert open_picture(path).frames.shape == (1, 8736, 11648)
    content = bytearray(path.read_bytes())
    content[16:24] = struct.pack(">II", 2**31 - 1, 32)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    path.write_bytes(content)
    with pytest.raises(BadInput, match="claims frames of 32 x 2147483647 pixels: no sensor has that many"):
        open_picture(path)
