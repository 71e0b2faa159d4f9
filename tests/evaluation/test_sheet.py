"""The EMVA 1288 sheet: its numbers are those of photon transfer, its figures hold what they say."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from cannoise_jax.evaluation.sheet import sheet_page
from cannoise_jax.evaluation.sheet_data import sheet_data
from cannoise_jax.evaluation.svg import Series, plot
from cannoise_jax.physics.transfer.noise_profile import darktable_profiles, profile_csv, profile_rows
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, photon_transfer
from cannoise_jax.physics.transfer.table import format_transfer
from cannoise_jax.recordings.recording import CaptureSet, Recording

GAIN, READ, BLACK, WHITE, FULL = 2.0, 3.0, 256.0, 16383.0, 6000.0
SIZE = (64, 96)


def made(electrons, kind, seconds, iso=None, cfa="RGGB", seed=0, rows=0.0):
    rng = np.random.default_rng(seed + int(1e6 * seconds))
    charge = rng.poisson(electrons, (12, *SIZE))
    fixed = rows * np.sin(2 * np.pi * np.arange(SIZE[1]) / 8)
    values = BLACK + GAIN * (charge + rng.normal(0, READ, (12, *SIZE))) + fixed
    frames = np.clip(np.rint(values), 0, BLACK + GAIN * FULL).astype(np.uint16)
    return Recording(
        frames, cfa, (BLACK,) * 4, WHITE, kind=kind, exposure_s=seconds, iso=iso, camera="Acme X"
    )


@pytest.fixture(scope="module")
def transfers():
    flats = [made(1e5 * s, "flat", s) for s in (0.005, 0.01, 0.02, 0.04, 0.2)]
    darks = [made(0.0, "dark", s, rows=3.0) for s in (0.01, 0.02, 0.04)]
    return photon_transfer(CaptureSet("Acme X", (*flats, *darks)))


def row(setting, name, unit):
    (found,) = [r for r in setting["table"] if r["name"].startswith(name) and r["unit"] == unit]
    return found


def test_the_table_is_that_of_photon_transfer_and_the_equations_of_the_standard(transfers):
    (setting,) = sheet_data(transfers)
    (transfer,) = transfers
    for name, title, unit in (("system gain", "K,", "DN/e-"), ("DSNU1288", "DSNU1288", "e-")):
        expected = [o.value for o in transfer.outcomes(name, unit)]
        assert row(setting, title, unit)["values"] == expected
    noise, full = (np.array(row(setting, n, "e-")["values"]) for n in ("sigma_d", "mu_e.sat"))
    np.testing.assert_allclose(noise, READ, rtol=0.05)
    np.testing.assert_allclose(full, FULL, rtol=0.02)
    least = np.array(row(setting, "mu_e.min", "e-")["values"])
    np.testing.assert_allclose(least, np.sqrt(noise**2 + 1 / GAIN**2 / 12) + 0.5, rtol=1e-3)
    np.testing.assert_allclose(row(setting, "SNR max", "")["values"], np.sqrt(full))
    np.testing.assert_allclose(row(setting, "DR", "dB")["values"], 20 * np.log10(full / least), rtol=1e-6)
    assert max(row(setting, "LE", "%")["values"]) < 0.5  # the light is proportional to the time
    assert row(setting, "LE", "%")["ci90"] == [None] * 4  # it is a mean of deviations, no estimate
    assert "calibrated light" in row(setting, "eta", "e-/photon")["record"]


@pytest.mark.parametrize("read_e", [0.2, 1.5])
def test_the_dark_noise_is_that_of_the_recorded_codes(read_e):
    """sigma_y.dark of EMVA 1288 is the scatter of what is stored, and mu_e.min follows from it."""
    rng = np.random.default_rng(5)
    own = []
    for kind, light, seconds in (("dark", 0.0, 0.01), *(("flat", 400.0 * k, 0.01 * k) for k in (1, 4, 12))):
        noise = read_e * rng.standard_normal((12, *SIZE)) + 0.1 * rng.standard_normal((12, SIZE[0], 1))
        values = 64.3 + GAIN * (rng.poisson(light, noise.shape) + noise)
        codes = np.rint(values).astype(np.uint16)
        own.append(Recording(codes, "MONO", (64.0,) * 4, WHITE, kind=kind, exposure_s=seconds, camera="A"))
    (setting,) = sheet_data(photon_transfer(CaptureSet("A", tuple(own))))
    codes = own[0].frames.astype(float)
    codes -= codes.mean((1, 2), keepdims=True)
    sigma = float(np.sqrt(codes.var(0, ddof=1).mean()))
    found = row(setting, "sigma_y.dark", "DN")
    assert found["values"][0] == pytest.approx(sigma, rel=0.01)
    assert found["ci90"][0][0] < found["values"][0] < found["ci90"][0][1]
    (gain,) = row(setting, "K,", "DN/e-")["values"]
    assert row(setting, "mu_e.min", "e-")["values"][0] == pytest.approx(found["values"][0] / gain + 0.5)
    (bare,) = row(setting, "temporal dark noise without", "DN")["values"]
    assert bare == pytest.approx(GAIN * np.hypot(read_e, 0.1), rel=0.03)


def test_the_points_lie_on_the_line_and_the_spectrum_shows_the_pattern(transfers):
    (setting,) = sheet_data(transfers)
    mean, variance = (np.array(setting["transfer"][n][0])[:4] for n in ("mean", "variance"))
    np.testing.assert_allclose(variance, GAIN * mean + (GAIN * READ) ** 2, rtol=0.05)
    dark = setting["spectra"]["dark"]
    along = dark["rows"]
    peak = along["frequency"][int(np.argmax(along["amplitude"]))]
    assert peak == pytest.approx(1 / 8, rel=0.05)
    assert (
        max(along["amplitude"]) > 5 * dark["noise"] and max(dark["columns"]["amplitude"]) < 2 * dark["noise"]
    )


def test_the_page_holds_every_figure_and_no_other_file(transfers):
    page = sheet_page("Acme <X>", sheet_data(transfers), "made by hand")
    assert "Acme &lt;X&gt;" in page and "made by hand" in page and page.count("<svg") == 8
    assert not re.search(r"""(src|href)=["']""", page) and "@media print" in page
    for title in ("Photon transfer", "SNR", "Linearity", "Dark signal", "Spectrogram of DSNU", "of PRNU"):
        assert title in page
    assert "nan" not in page.lower().replace("nance", "")


def test_its_style_is_well_formed(transfers):
    """A block of the style that is left open takes all rules after it with it."""
    style = re.search("<style>(.*?)</style>", sheet_page("Acme X", sheet_data(transfers)), re.DOTALL)[1]
    depth, opened = 0, []
    for at, sign in ((m.start(), m.group()) for m in re.finditer("[{}]", style)):
        depth += 1 if sign == "{" else -1
        opened += [style[:at].rsplit("\n", 1)[-1]] if depth > 2 else []
        assert depth >= 0
    assert depth == 0 and not opened


def test_the_printed_table_is_not_cut_off(transfers):
    """Paper does not scroll: every column must be able to wrap, and intervals stay in one piece."""
    page = sheet_page("Acme X", sheet_data(transfers))
    printed = page[page.index("@media print { figure") :].partition("\n}")[0]
    assert ".scroll { overflow: visible; }" in printed and "td.n { white-space: normal; }" in printed
    cells = re.findall(r'<td class="n" data-of="R">(.*?)</td>', page)
    assert cells and all(
        re.fullmatch(r'\S+( <span class="i">\[\S+, \S+\]</span>)?|not measured', c) for c in cells
    )


def test_recordings_are_listed_by_kind_and_exposure(transfers):
    (setting,) = sheet_data([replace(transfers[0], statistics=transfers[0].statistics[::-1])])
    listed = [(r["kind"], r["exposure_s"]) for r in setting["recordings"]]
    assert listed == sorted(listed) and len(listed) == 8


def test_a_flat_that_clips_in_one_channel_is_no_part_of_its_linearity():
    """Three exposures, the longest clipped in blue: no line of two is judged, the others are as they are."""
    blue = np.ones(SIZE)
    blue[1::2, 1::2] = 4.0
    flats = [made(1e5 * s * blue, "flat", s) for s in (0.005, 0.01, 0.02)]
    darks = [made(0.0, "dark", 0.01)]
    (setting,) = sheet_data(photon_transfer(CaptureSet("Acme X", (*flats, *darks))))
    error = row(setting, "LE", "%")["values"]
    assert error[3] is None and max(error[:3]) < 0.5
    assert "not measured" in sheet_page("Acme X", [setting])


def test_what_was_not_recorded_is_said():
    (setting,) = sheet_data(photon_transfer(CaptureSet("Acme X", (made(0.0, "dark", 0.01),))))
    assert "even, steady light" in row(setting, "K,", "DN/e-")["record"]
    assert "three exposure times" in row(setting, "LE", "%")["record"]
    assert "not measured: record" in sheet_page("Acme X", [setting])


def test_a_sensor_without_colours_has_one_column_of_all_pixels():
    levels = (0.005, 0.01, 0.02, 0.04, 0.2)
    flats = [made(1e5 * s, "flat", s, cfa="MONO") for s in levels]
    darks = [made(0.0, "dark", s, cfa="MONO", rows=3.0) for s in (0.01, 0.02, 0.04)]
    (transfer,) = photon_transfer(CaptureSet("Acme M", (*flats, *darks)))
    (setting,) = sheet_data([transfer])
    assert setting["channels"] == ["all"] and all(len(r["values"]) == 1 for r in setting["table"])
    for title, name, unit, most in (
        ("K,", "system gain", "DN/e-", 0.003),
        ("sigma_d", "temporal dark noise", "e-", 0.01),
        ("mu_e.sat", "saturation level", "e-", 0.003),
        ("DSNU1288", "DSNU1288", "e-", 0.05),
    ):
        sites = [o.value for o in transfer.outcomes(name, unit)]
        found, (low, high) = row(setting, title, unit)["values"][0], row(setting, title, unit)["ci90"][0]
        assert found == pytest.approx(np.mean(sites), rel=most)
        if name == "system gain":  # four times as many pixels
            (a, b), *_ = [o.ci90 for o in transfer.outcomes(name, unit)]
            assert (high - low) < 0.75 * (b - a)
    assert row(setting, "K,", "DN/e-")["values"][0] == pytest.approx(GAIN, rel=0.01)
    along = setting["spectra"]["dark"]["rows"]
    peak = along["frequency"][int(np.argmax(along["amplitude"]))]
    assert peak == pytest.approx(1 / 8, rel=0.05) and max(along["frequency"]) == 0.5
    assert all(len(r["level_dn"]) == 1 for r in setting["recordings"])
    page = sheet_page("Acme M", [setting])
    assert page.count("<th>all pixels</th>") == 1 and "data-of" not in page.partition("<body>")[2]
    assert "nan" not in page.lower().replace("nance", "")
    assert [r["channel"] for r in profile_rows([transfer])] == ["all"]
    said = format_transfer(of_all_pixels(transfer)).splitlines()
    assert said[2].split() == ["unit", "all", "pixels"] and sum("system gain" in line for line in said) == 2
    assert of_all_pixels(whole := of_all_pixels(transfer)) is whole


def test_profiles_of_every_iso():
    recordings = []
    for iso, gain in ((100.0, 1.0), (400.0, 4.0)):
        recordings += [made(2000.0 / gain, "flat", 0.01, iso, seed=int(iso)), made(0.0, "dark", 0.01, iso)]
    rows = profile_rows(photon_transfer(CaptureSet("Acme X", tuple(recordings))))
    assert [(r["iso"], r["channel"]) for r in rows[:5]] == [
        *((100.0, c) for c in ("R", "Gr", "Gb", "B")), (400.0, "R")]  # fmt: skip
    span = WHITE - BLACK
    for r in rows:
        assert r["shot"] == pytest.approx(GAIN / span, rel=0.05)
        assert r["read"] == pytest.approx((GAIN * READ / span) ** 2, rel=0.1)
    lines = profile_csv(rows).splitlines()
    assert len(lines) == 9 and lines[0].startswith("iso,channel,shot,read,")
    (camera,) = darktable_profiles("Acme X", rows)["noiseprofiles"]
    (model,) = camera["models"]
    assert (camera["maker"], model["model"]) == ("Acme", "X") and [p["iso"] for p in model["profiles"]] == [
        100,
        400,
    ]
    greens = [r["shot"] for r in rows[:4] if r["channel"].startswith("G")]
    assert (
        model["profiles"][0]["a"][1] == pytest.approx(np.mean(greens)) and len(model["profiles"][0]["b"]) == 3
    )


def test_a_camera_that_counts_in_decibels_is_named_by_them():
    own = []
    for decibels in (0.0, 10.0):
        iso = 100 * 10 ** (decibels / 20)
        for r in (made(2000.0, "flat", 0.01, iso, "MONO"), made(0.0, "dark", 0.01, iso, "MONO")):
            own.append(replace(r, gain_db=decibels))
    transfers = photon_transfer(CaptureSet("Acme X", tuple(own)))
    said = "\n".join(map(format_transfer, transfers))
    assert "gain 0 dB" in said and "gain 10 dB" in said and "ISO" not in said
    rows = profile_rows(transfers)
    assert [r["gain_db"] for r in rows] == [0.0, 10.0]
    (camera,) = darktable_profiles("Acme X", rows)["noiseprofiles"]
    named = [(p["name"], p["iso"]) for p in camera["models"][0]["profiles"]]
    assert named == [("Acme X iso 100 (gain 0 dB)", 100), ("Acme X iso 316 (gain 10 dB)", 316)]


def test_a_plot_leaves_out_what_its_axes_cannot_show():
    svg = plot([Series("a", [0.0, 1.0, 10.0], [1.0, 2.0, np.nan])], "x & y", "z", log_x=True)
    assert svg.count("<circle") == 1 and "x &amp; y" in svg
    assert plot([Series("a", [], [])], "x", "y") == ""
    one = plot([Series("", [3.0], [5.0])], "x", "y")
    assert one.count("<circle") == 1 and "nan" not in one


def test_every_number_of_an_axis_lies_within_the_figure():
    for top in (9.0, 37_900.0, 1e5, 2.2e7):
        svg = plot([Series("", [0.0, top], [0.0, top], line=True)], "x", "y")
        width = float(re.search(r'viewBox="0 0 (\d+)', svg)[1])
        along = re.findall(r'class="tick" x="([\d.]+)" y="[\d.]+" text-anchor="middle">([^<]+)<', svg)
        assert all(3.7 * len(text) <= float(x) <= width - 3.7 * len(text) for x, text in along)


def upward(svg):
    """Numbers of the upright axis: their right end, place and text."""
    found = re.findall(r'class="tick" x="([\d.]+)" y="([\d.]+)" text-anchor="end">([^<]+)<', svg)
    return [(float(x), float(y), text) for x, y, text in found]


@pytest.mark.parametrize("low, high", [(0.05, 0.058), (0.31, 0.46), (0.7, 1.2), (2.01, 2.02), (1.0, 1e4)])
def test_a_logarithmic_axis_has_numbers_whatever_its_range(low, high):
    svg = plot([Series("", [1.0, 10.0], [low, high], line=True)], "x", "y", log_x=True, log_y=True)
    assert len(upward(svg)) >= 2
    assert len({text for _, _, text in upward(svg)}) == len(upward(svg))


@pytest.mark.parametrize("low, high", [(100.0, 100.013), (1e4, 1e4 + 0.01), (0.0, 3000.0), (5e5, 5e5 + 3)])
def test_the_title_of_an_axis_lies_beside_its_numbers_and_they_differ(low, high):
    svg = plot([Series("", [0.0, 8.0], [low, high])], "x", "y")
    ticks = upward(svg)
    assert all(x - 7 * len(text) >= 18 for x, _, text in ticks)
    assert len({text for _, _, text in ticks}) == len(ticks) >= 2


@pytest.mark.parametrize("falling, side", [(False, "left"), (True, "right")])
def test_the_legend_lies_where_the_data_do_not(falling, side):
    y = np.linspace(1, 10, 30)[:: -1 if falling else 1]
    svg = plot([Series("along rows", np.linspace(0, 1, 30), y, line=True)], "x", "y")
    (key,) = re.findall(r'class="key c0" x="([\d.]+)" y="([\d.]+)"', svg)
    line = re.search(r'points="([^"]+)"', svg)[1].split()
    points = np.array([p.split(",") for p in line], float)
    x, top = map(float, key)
    assert (x < points[:, 0].mean()) == (side == "left") and top < points[:, 1].mean()
    near = points[(points[:, 0] >= x) & (points[:, 0] <= x + 90)]
    assert (near[:, 1] > top + 15).all()
