"""A frame of which a part shows another picture is named and left out; drifts and leans are none."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.recordings.one_light import odd_pictures
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.recordings.usable import usable

SIZE = (96, 144)


def taken(kind, change, frames=6, seed=1, light=900.0):
    """Frames of a camera of black 150; change(number, light) -> the light of one (of darks its level)."""
    rng = np.random.default_rng(seed)
    out = []
    for number in range(frames):
        if kind == "flat":
            values = 150 + 0.5 * rng.poisson(change(number, np.full(SIZE, light)))
        else:
            values = change(number, np.full(SIZE, 150.0))
        out.append(values + 2 * rng.standard_normal(SIZE))
    codes = np.clip(np.rint(out), 0, 4095).astype(np.uint16)
    sources = tuple(f"night/{kind}_{n}.fits" for n in range(frames))
    return Recording(
        codes, "MONO", (150.0,) * 4, 4095.0, "c", kind, exposure_s=1.0, path=f"{kind}.h5", sources=sources
    )


def shaded(number, light):
    out = light.copy()
    if number == 4:
        out[:, 100:] *= 0.75
    return out


def cut(number, level):
    out = level.copy()
    if number == 1:
        out[:40] = 0
    return out


@pytest.mark.parametrize(
    ("kind", "change", "name", "part"),
    [
        ("flat", shaded, "flat_4.fits", "-25 % of light"),
        ("dark", cut, "dark_1.fits", "rows 1 to 36, columns 1 to 144 lie -1"),
    ],
)
def test_the_frame_with_another_picture_is_named_and_left_out(kind, change, name, part):
    other = taken("dark" if kind == "flat" else "flat", lambda n, light: light, seed=2)
    capture, lines = usable(CaptureSet("c", (taken(kind, change), other)))
    (line,) = lines
    assert name in line and part in line and line.endswith("left out")
    kept = next(r for r in capture.recordings if r.kind == kind)
    assert kept.count == 5 and not any(name in s for s in kept.sources)


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("flat", lambda n, light: light * (1 - 0.1 * n)),
        ("flat", lambda n, light: light * (1 + 0.04 * n * np.linspace(-1, 1, SIZE[1]))),
        ("flat", lambda n, light: light * (1 + 0.3 * np.sin(np.linspace(0, 3, SIZE[0])))[:, None]),
        ("dark", lambda n, level: level + 3 * (n % 3)),
        ("dark", lambda n, level: level + 4 * (n == 2) * (np.arange(SIZE[1]) > 70)),
    ],
    ids=["drift", "lean", "vignetting", "offset", "amplifier"],
)
def test_what_lights_and_offsets_do_is_no_other_picture(kind, change):
    assert not odd_pictures(taken(kind, change))
