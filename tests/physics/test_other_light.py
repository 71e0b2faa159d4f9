"""Flats whose light is distributed differently over the frame than that of a longer one of the lamp."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.physics.transfer.faults import faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.other_light import other_light_line
from cannoise_jax.recordings.recording import Recording

SIZE, BLACK, GAIN = (96, 128), 100.0, 0.5
Y, X = np.indices(SIZE)
FALL = 1 - 0.4 * ((Y - 48) ** 2 + (X - 64) ** 2) / (48**2 + 64**2)


def seen(seconds, light=0.0, added=0.0, kind="flat", drift=None, seed=0, frames=8):
    """light: DN per second where it is brightest; added: an image, DN; drift: of every frame's rows."""
    rng = np.random.default_rng([seed, int(1e4 * seconds), kind == "dark"])
    stack = []
    for _ in range(frames):
        signal = np.maximum(light * seconds * FALL * (1 if drift is None else drift(rng)) + added, 0)
        stack.append(BLACK + GAIN * rng.poisson(signal / GAIN) + 2.0 * rng.standard_normal(SIZE))
    codes = np.clip(np.rint(stack), 0, 4095).astype(np.uint16)
    path = f"{kind}_{seconds:g}s.h5"
    r = Recording(codes, "MONO", (BLACK,) * 4, 4095.0, kind=kind, exposure_s=seconds, path=path)
    return frame_statistics(r)


def said(*flats):
    return other_light_line([*flats, seen(0.01, kind="dark"), seen(0.1, kind="dark")])


def test_light_that_does_not_grow_with_the_exposure_is_told_and_where():
    read_later = 40.0 * Y / SIZE[0]  # rows that are read last are lit the longest
    line = said(*(seen(t, 10_000.0, read_later) for t in (0.02, 0.05, 0.15)))
    assert line.startswith("flat_0.02s.h5: its light is distributed differently over the frame")
    assert "the longer flat_0.0" in line or "the longer flat_0.1" in line
    assert "rows 1 to 6" in line or "rows 91 to 96" in line
    columns = said(*(seen(t, 10_000.0, 40.0 * X / SIZE[1]) for t in (0.02, 0.15)))
    assert "columns" in columns
    darks = [seen(0.01, kind="dark")]
    assert (
        "distributed differently"
        in faults([*(seen(t, 10_000.0, read_later) for t in (0.02, 0.15)), *darks]).lamp
    )


def another_lamp():
    return seen(0.02, 10_000.0), seen(0.15, 4_000.0, 30.0 * Y / SIZE[0])


def flickers():
    def rows(rng):
        return 1 + 0.05 * np.sin(2 * np.pi * (Y / 60 + rng.random()))

    return tuple(seen(t, 10_000.0, drift=rows) for t in (0.02, 0.15))


def bent():
    """A response that loses a tenth at full scale makes the middle of bright flats darker."""
    return tuple(seen(t, 10_000.0, -0.1 * (10_000.0 * t * FALL) ** 2 / 4_000.0) for t in (0.02, 0.1, 0.15))


def flickers_in_few_frames():
    def rows(rng):
        return 1 + 0.05 * np.sin(2 * np.pi * (Y / 60 + rng.random()))

    return tuple(seen(t, 10_000.0, drift=rows, frames=5, seed=s) for s in range(6) for t in (0.02, 0.15))


def glowing():
    """Charge of the darks is none of the light."""
    return tuple(seen(t, 10_000.0) for t in (0.02, 0.1, 0.15))


@pytest.mark.parametrize("flats", [another_lamp, flickers, flickers_in_few_frames, bent, glowing])
def test_one_lamp_that_falls_off_or_flickers_and_two_lamps_are_not(flats):
    assert said(*flats()) == ""


def test_bright_and_dim_flats_alarm_no_more_than_by_chance():
    alarms = [
        bool(said(seen(0.02, 3_000.0, seed=s, frames=5), seen(0.15, 3_000.0, seed=s, frames=5)))
        for s in range(40)
    ]
    assert not any(alarms)


def test_nothing_is_said_of_one_flat_or_without_darks():
    flats = [seen(0.02, 10_000.0), seen(0.15, 10_000.0, 40.0 * Y / SIZE[0])]
    assert other_light_line(flats) == ""
    assert said(flats[0]) == ""
