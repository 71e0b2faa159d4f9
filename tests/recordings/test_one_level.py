"""A frame at another level than the others of its recording is named and left out; honest ones stay."""

from __future__ import annotations

import re

import numpy as np
import pytest

from cannoise_jax.recordings.one_level import odd_levels
from cannoise_jax.recordings.plausible import warn_of_lights
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.recordings.usable import usable

SIZE, BLACK, NOISE = (48, 60), 100.0, 4.0


def recording(kind, levels, seed=0, noise=NOISE, sources=()):
    """Frames at levels above black, DN, whose light has shot noise of a gain of one."""
    rng = np.random.default_rng([seed, len(levels)])
    signal = np.reshape(np.asarray(levels, float), (-1, 1, 1))
    spread = np.sqrt(noise**2 + (np.maximum(signal, 0) if kind == "flat" else 0))
    frames = np.rint(BLACK + signal + spread * rng.standard_normal((len(levels), *SIZE)))
    return Recording(
        frames.clip(0, 16383).astype(np.uint16), "MONO", (BLACK,) * 4, 16383.0, "c", kind, path=f"{kind}.h5",
        sources=sources,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "levels", "unsteady", "odd"),
    [
        ("flat", [1000] * 7 + [400], True, [7]),
        ("flat", [1000, 1300, 1000, 1000], False, [1]),
        ("flat", [1000, 870, 1000, 1000, 1000], False, [1]),
        ("flat", [1000, 870, 1000, 1000, 1000], True, []),  # what a lamp may do is looked for
        ("flat", [970, 990, 1000, 1000, 1000, 1000], False, []),  # it warms up
        ("flat", [1000, 1100, 900, 1050, 800, 1020], False, []),  # it flickers
        ("flat", [1000, 1000, 500, 500], False, []),  # neither is the rule
        ("flat", [1000, 1000, 500], False, []),
        ("scene", [1000] * 7 + [400], False, []),
        ("dark", [0] * 7 + [30], False, [7]),
        ("bias", [0, 0, -20, 0, 0, 0, 0, 0], False, [2]),
        ("dark", [0] * 7 + [30], True, []),  # an offset that jumps is looked for
        ("dark", [0] * 7 + [300], True, [7]),
        ("dark", [0, 2, 4, 1, 3, 12, 2, 0], False, []),  # a clamp that is unsteady
        ("dark", [0, 5, 10, 15, 20, 40], False, []),  # a sensor that warms
        ("dark", [0] * 12 + [40] * 3, False, [12, 13, 14]),
    ],
)
def test_frames_at_another_level_are_told_from_lamps_and_clamps(kind, levels, unsteady, odd):
    found = odd_levels(recording(kind, levels), unsteady)
    assert (list(found.numbers) if found else []) == odd


def test_none_of_many_honest_recordings_holds_an_odd_frame():
    rng = np.random.default_rng(1)
    for seed in range(100):
        jumps = rng.choice([0.0, 0.3, 3.0])
        own = recording("dark", jumps * rng.standard_normal(rng.integers(4, 12)), seed)
        lit = recording("flat", 800 * (1 + 0.02 * rng.standard_normal(rng.integers(4, 12))), seed)
        assert odd_levels(own) is None and odd_levels(lit) is None


def test_it_is_said_in_one_line_with_its_file():
    names = tuple(f"/night/flat_{n}.fits" for n in range(6))
    flats = recording("flat", [1000, 1000, 1000, 2000, 1000, 1000], sources=names)
    kept, lines = usable(CaptureSet("c", (flats, recording("dark", [0] * 5 + [25.0]))))
    assert [r.count for r in kept.recordings] == [5, 5]
    assert "flat_3.fits" not in " ".join(kept.recordings[0].sources)
    assert re.match(r"flat.h5: frame 4 \(flat_3.fits\): 20\d % of the light of the others, which", lines[0])
    said = (
        r"dark.h5: frame 6: \+\S+ DN from the others, which agree to .* DN: another exposure, or light: left"
    )
    assert re.match(said, lines[1])
    assert all(line.endswith(": left out") and "\n" not in line for line in lines)


def test_every_level_is_said_and_no_frame_twice(caplog):
    """Frames that are left out one by one are no recording of several lights."""
    flats = recording("flat", [1000] * 6 + [400, 700])
    warn_of_lights(flats)
    (line,) = usable(CaptureSet("c", (flats,)))[1]
    assert re.match(r"flat.h5: frames 7 to 8: (39|40)\S* and (69|70)\S* % of the light of the others", line)
    assert not caplog.text
    warn_of_lights(recording("flat", [1000] * 5 + [400] * 3))
    assert "make a recording of each light" in caplog.text
    (line,) = usable(
        CaptureSet("c", (recording("dark", [0.0] * 24 + [20.0, 30.0, 40.0, 50.0, 60.0, 70.0]),))
    )[1]
    assert re.search(r"frames 25 to 30: \+(19|20)\S* to \+(69|70)\S* DN from the others", line)
