"""Sites of a sensor without colours that part in the light."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, FRAMES = (96, 128), 6
LEVELS = (600, 1500, 2500, 3200)


def camera(
    seed,
    *,
    cfa="MONO",
    prnu=0.0,
    columns=0.0,
    rows=0.0,
    shared=0.0,
    offset=0.0,
    levels=LEVELS,
    darks=True,
    parted=lambda level: 0.0,
):
    """Darks and flats under a lamp that leans and a lens, in plain NumPy. parted: half the difference of even
    and odd columns at a level, DN, as a share of the light. shared: noise of rows, DN. offset:
    of the columns."""
    rng = np.random.default_rng(seed)
    gain, read, black = 0.5, 4.0, 100.0
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] / np.array(SIZE)[:, None, None] - 0.5
    lens = (1 - 0.6 * (y**2 + x**2) + 0.1 * x) * (1 + prnu * rng.standard_normal(SIZE))
    lens *= (1 + columns * rng.standard_normal(SIZE[1])) * (1 + rows * rng.standard_normal((SIZE[0], 1)))
    out = []
    unlit = (("bias", 0), ("dark", 0)) if darks else ()
    turns = 1 - 2 * (np.arange(SIZE[1]) % 2)
    for kind, level in (*unlit, *(("flat", n) for n in levels)):
        light = level / gain * lens * (1 + parted(level) * turns)
        charge = rng.poisson(light, (FRAMES, *SIZE)) + read * rng.standard_normal((FRAMES, *SIZE))
        rows_of = shared * rng.standard_normal((FRAMES, SIZE[0], 1))
        codes = np.clip(np.round(black + offset * turns + gain * charge + rows_of), 0, 4095).astype(np.uint16)
        seconds = 1.0 if kind == "dark" else 0.01
        out.append(
            Recording(codes, cfa, (black,) * 4, 4095.0, kind=kind, exposure_s=seconds, path=f"{kind}{level}")
        )
    return CaptureSet("camera", tuple(out))


def looked_at(capture):
    prepared = prepare(capture, [list(range(FRAMES))] * len(capture.recordings), False, entries=())
    return next((s for s in prepared.signatures if s.name == "sites_apart"), None), prepared.fields


@pytest.mark.parametrize(
    "patterns",
    [{}, {"prnu": 0.01, "columns": 0.003, "rows": 0.002}, {"shared": 2.0, "levels": (150, 300, 600, 1200)}],
)
def test_the_scatter_of_pixels_and_lines_parts_no_sites(patterns):
    chances = []
    for seed in range(12):
        signature, fields = looked_at(camera(seed, **patterns))
        chances.append(np.exp(signature.score(fields).log_p))
    assert min(chances) > 1e-3 and np.mean(np.array(chances) < 0.05) <= 0.25


def test_another_gain_of_odd_columns_is_found_and_simulated_with_its_size():
    signature, fields = looked_at(camera(1, prnu=0.007, parted=lambda level: 0.002))
    found = signature.score(fields)
    assert found.log_p < -15 and found.payload.steady
    assert found.amplitude == pytest.approx(0.002, abs=3 * found.error)
    assert signature.kind(found) == "even and odd columns differ by 0.41 % of the light"
    pattern = signature.pattern(fields, found, np.random.default_rng(0))
    assert np.mean(pattern[:, ::2] - pattern[:, 1::2]) == pytest.approx(0.004, rel=0.1)


def test_a_gain_that_parts_at_bright_light_alone_is_told_by_level_and_not_simulated():
    bent = lambda level: 0.002 * max(level - 2000, 0) / 1200  # noqa: E731
    signature, fields = looked_at(camera(2, prnu=0.007, parted=bent))
    found = signature.score(fields)
    assert found.log_p < -15 and not found.payload.steady
    shares = [values[1] for _, values in found.payload.by_level]
    assert shares == pytest.approx([bent(n) for n in LEVELS], abs=4e-4)
    assert "may be another one at another signal" in signature.kind(found)


def test_an_offset_is_no_share_of_the_light_and_one_flat_tells_of_no_other():
    """Without darks the black level is what was stated, whatever it is."""
    signature, fields = looked_at(camera(6, offset=0.5, darks=False))
    assert signature.score(fields) is None
    signature, fields = looked_at(camera(7, offset=0.5))
    assert signature.score(fields).log_p > np.log(1e-3)
    signature, fields = looked_at(camera(8, parted=lambda level: 0.002, levels=(2500,)))
    found = signature.score(fields)
    assert found.log_p < -8 and not found.payload.steady


def test_a_sensor_with_colours_has_other_light_at_every_site():
    assert looked_at(camera(3, cfa="RGGB"))[0] is None


def test_frames_of_another_source_are_seen_as_they_are():
    """As draws of a simulator that has the difference, or has it not."""
    signature, fields = looked_at(camera(4))
    other, others = looked_at(camera(5, parted=lambda level: 0.002))
    assert signature.score(others).amplitude == pytest.approx(0.002, rel=0.15)
    assert other.score(fields).amplitude < 0.0005
