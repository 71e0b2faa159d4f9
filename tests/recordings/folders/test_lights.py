"""Flats of one exposure parted by their light: lamps, ramps of many steps, skies and stacks of pages."""

import numpy as np
import tifffile

from cannoise_jax.recordings.folders.plan import plan_folder
from cannoise_jax.recordings.folders.store import recording_of
from tests.recordings.folders.night import labels, night, shot


def test_flats_of_one_exposure_under_several_lights_are_recordings_of_their_own(tmp_path):
    night(tmp_path)
    for electrons in (150, 900, 4000.0 * 1.05, 16000):
        for n in (1, 2):
            shot(tmp_path / f"flat_{electrons:.0f}_{n}.fits", "flat", electrons=electrons * (1 + 0.02 * n),
                 IMAGETYP="Flat Field", EXPTIME=2.0, INSTRUME="Acme 100")  # fmt: skip
    # The two of the night have 4000 electrons: between the lamps' 4200 and them lies less than a tenth.
    made = labels(plan_folder(tmp_path))
    assert sorted(count for name, count in made.items() if name.startswith("flat_2s")) == [2, 2, 2, 4]


def test_flats_of_a_sky_that_changes_from_frame_to_frame_stay_together(tmp_path):
    night(tmp_path)
    for n in range(5):
        shot(tmp_path / f"flat_b{n}.fits", "flat", electrons=4000 * 1.3**n, FILTER="B",
             IMAGETYP="Flat Field", EXPTIME=2.0, INSTRUME="Acme 100")  # fmt: skip
    assert labels(plan_folder(tmp_path))["flat_2s_B"] == 5


def pages(path, levels, seed=0):
    """A stack of one page for each number of electrons, 2 DN/e- above 1000 DN."""
    rng = np.random.default_rng(seed)
    light = np.asarray(levels, float)[:, None, None] + np.zeros((len(levels), 24, 32))
    values = np.rint(1000 + 2 * rng.poisson(light) + rng.normal(0, 4, light.shape)).astype(np.uint16)
    tifffile.imwrite(path, values, photometric="minisblack")


def test_pages_of_several_lights_are_recordings_of_their_own(tmp_path):
    pages(tmp_path / "flat_series.tif", (500, 500, 4000, 4000, 4000))
    pages(tmp_path / "flat_channels.tif", (1000, 2000) * 3, seed=1)
    pages(tmp_path / "dark.tif", (0,) * 4, seed=2)
    plan = plan_folder(tmp_path, {"camera": "scope"})
    lit = {g.label: (g.frames, [s.title for s in g.shots]) for g in plan.sets[0].groups if g.kind == "flat"}
    assert sorted(lit.values()) == [
        (2, ["flat_series.tif (pages 1, 2)"]),
        (3, ["flat_channels.tif (pages 1, 3, 5)"]),
        (3, ["flat_channels.tif (pages 2, 4, 6)"]),
        (3, ["flat_series.tif (pages 3, 4, 5)"]),
    ]
    for group in (g for g in plan.sets[0].groups if g.kind == "flat"):
        frames = recording_of(group, plan.sets[0], plan.overrides).frames[:]
        assert frames.shape[0] == group.frames
        assert np.ptp(np.median(frames, (1, 2))) < 0.1 * np.median(frames)


def ramp(folder, lamps, each):
    """Flats of one exposure, so many of each lamp one after the other."""
    night(folder)
    for n, electrons in enumerate(np.repeat(lamps, each)):
        shot(folder / f"img_{n:03d}.fits", "flat", electrons=electrons, IMAGETYP="Flat Field", EXPTIME=0.5,
             INSTRUME="Acme 100")  # fmt: skip
    made = labels(plan_folder(folder))
    return [n for name, n in made.items() if name.startswith("flat_") and not name.startswith("flat_2s")]


def test_a_ramp_of_close_steps_is_one_recording_a_step(tmp_path):
    """EMVA 1288, section 6: two frames at each of many lamp levels, the upper ones closer than a tenth."""
    assert ramp(tmp_path / "steps", np.linspace(1000, 3000, 15), 2) == [2] * 15


def test_light_that_drifts_through_a_series_is_no_ramp(tmp_path):
    rng = np.random.default_rng(4)
    drifts = 2000 * (1 + 0.01 * np.arange(12) + 0.003 * rng.standard_normal(12))
    assert ramp(tmp_path / "drift", drifts, 1) == [12]
