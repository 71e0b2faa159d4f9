"""What names of files say in numbers, as people write them, and what is not read because it is ambiguous."""

from pathlib import PurePath

import numpy as np
import pytest

from cannoise_jax.recordings.folders.names import named_average, named_settings
from cannoise_jax.recordings.folders.numerals import counted
from cannoise_jax.recordings.folders.plan import plan_folder
from tests.recordings.folders.night import notes


def read(name, field, counters=()):
    return named_settings(PurePath(name), counters).values.get(field)


@pytest.mark.parametrize(
    "name, seconds",
    [
        ("dark_60s_1.tif", 60), ("dark60s.tif", 60), ("Dark_300s_-10C_gain100_0001.tif", 300),
        ("flat_0.5sec_1.tif", 0.5), ("dark_5min_1.tif", 300), ("dark_500 ms_1.tif", 0.5),
        ("dark_1_250s_1.tif", 250), ("flats/10us_1.tif", 1e-5), ("dark/10µs_1.tif", 1e-5),
        ("dark_10\N{GREEK SMALL LETTER MU}s.tif", 1e-5), ("2024-01-01_dark-60s-1.fits", 60),
        ("2024-1-1-60s.fits", 60), ("darks_300s/img_1.tif", 300), ("dark_2m_1.tif", None),
        ("flat_0,5s_1.tif", 0.5), ("flat0,5s.tif", 0.5), ("dark_1,5s.tif", 1.5), ("flat_0,005s.tif", 0.005),
        ("flat_gain100,60s.tif", 60), ("flat_1,2,60s.tif", 60), ("flat_0p5s_1.tif", 0.5),
        ("flat_1e-3s_1.tif", 1e-3), ("flat_2.5e-4s.tif", 2.5e-4), ("dark_1E2s.tif", 100),
        ("dark_.001s_1.tif", 1e-3), ("flat_1-250s_1.tif", 1 / 250), ("1-8000s/flat_1.tif", 1 / 8000),
        ("flat_1⁄125s.tif", 1 / 125), ("flat_1-1s.tif", 1), ("flat1-250s.tif", 250),
        ("20h10m05s_dark_60s.tif", 60),
    ],
)  # fmt: skip
def test_exposures(name, seconds):
    assert read(name, "exposure_s") == (seconds and pytest.approx(seconds))


@pytest.mark.parametrize(
    "name",
    [
        "flat_1-300s_1.tif", "dark-1-60s.tif", "dark_1,300s.tif", "flat1,5s.tif", "dark_1m30s.tif",
        "20h10m05s_dark.tif", "dark_99999999s.tif",
    ],
)  # fmt: skip
def test_exposures_that_may_be_something_else_are_not_read_and_said(name):
    values, doubts = named_settings(PurePath(name))
    assert "exposure_s" not in values and "exposure_s" in doubts


def test_a_time_of_day_is_no_exposure():
    assert read("2024-01-01T20-10-05s_flat_1.tif", "exposure_s") is None


def test_numbers_that_count_files_are_no_numerators():
    counters = counted(["dark_1-60s.tif", "dark_2-60s.tif", "flat_1-250s.tif"])
    assert counters == {"60"}
    assert read("dark_1-60s.tif", "exposure_s", counters) == 60
    assert read("flat_1-250s.tif", "exposure_s", counters) == pytest.approx(1 / 250)


@pytest.mark.parametrize(
    "name, field, value",
    [
        ("dark_iso800_1.tif", "iso", 800), ("flat_ISO-800_1.tif", "iso", 800), ("1_iso_0400.tif", "iso", 400),
        ("dark_800iso_1.tif", "iso", 800), ("dark_800ISO_2.tif", "iso", 800),
        ("dark_100iso_800.tif", "iso", 100),
        ("dark_iso_1.tif", "iso", None), ("flatiso800.tif", "iso", None), ("1_iso100.0.tif", "iso", 100),
        ("dark_gain100_1.tif", "gain_setting", 100), ("dark_100gain_1.tif", "gain_setting", 100),
        ("dark_1_gain_050.tif", "gain_setting", 50), ("dark_10ms_g2.tif", "gain_setting", 2),
        ("dark_-10C_1.tif", "temperature_c", -10), ("dark_-10,5C_1.tif", "temperature_c", -10.5),
        ("dark_gain100,20C.tif", "temperature_c", 20), ("dark_bin2x2.tif", "binning", (2, 2)),
    ],
)  # fmt: skip
def test_settings(name, field, value):
    assert read(name, field) == value


def test_plans_say_what_of_names_was_not_read(tmp_path):
    for name, level in (("flat_1-250s_iso_{}", 3000), ("dark_1m30s_800iso_{}", 100)):
        for n in (1, 2):
            values = np.random.default_rng(n + level).poisson(level, (16, 24)).astype(np.uint16)
            np.save(tmp_path / f"{name.format(n)}.npy", values)
    plan = plan_folder(tmp_path, {"cfa": "MONO"})
    groups = {g.kind: g for one in plan.sets for g in one.groups}
    assert groups["flat"].settings["exposure_s"] == pytest.approx(0.004)
    assert groups["dark"].settings["iso"] == 800 and groups["dark"].settings["exposure_s"] is None
    said = notes(plan)
    for words in ("'1-250s' in names is read as 1/250 s", "'iso_1' in names may count files: not read",
                  "'1m30s' in names is not read as an exposure"):  # fmt: skip
        assert words in said


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("masterbias.fits", "master"), ("bias_stacked.fits", "stacked"), ("dark_avg.fits", "avg"),
        ("mean_bias.fits", "mean"), ("Flat-Median.tif", "median"), ("bias_mean_gain100.fits", "mean"),
        ("integration.fit", "integration"), ("integration1.fit", "integration"),
        ("flat_integrated.fit", "integrated"),
        ("Ha_integration.fit", "integration"), ("drizzle_integration.xisf", "integration"),
    ],
)  # fmt: skip
def test_averages_by_name(name, word):
    assert named_average(PurePath(name)) == word


@pytest.mark.parametrize(
    "name",
    [
        "dark_integration10ms_000.tif", "flat_integration_time_20ms.tif", "t_integration_3_dark.tif",
        "dark_t_integration.tif", "t_integration.tif", "dark_integration-5s_1.tif",
        "integration_10ms/dark_1.tif",
        "meanwhile_flat.tif", "flat_meanwhile_3.tif", "flat_mean20000_001.fits", "flat_mean_20000_1.fits",
        "flat_mean_level_1.fits", "median_strip_001.fits", "bias_20240112_0001.fits",
        "light_mean_street_3.dng",
        "dark_mittelwertfrei.fits", "bias_remastered.fits", "flat_avgust_3.fits",
        "dark_gain100_2024-05-01.fits",
    ],
)  # fmt: skip
def test_no_averages_by_name(name):
    assert named_average(PurePath(name)) is None
