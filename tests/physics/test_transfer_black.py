"""The black level of flats when no dark is as long as they are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED, MECHANISMS
from cannoise_jax.physics.transfer.black import black_at
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import find_mechanisms, format_findings, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import transfer_at
from cannoise_jax.physics.transfer.table import format_outcome, format_transfer
from cannoise_jax.recordings.recording import Recording, per_channel

GAIN, READ, BLACK, RATE = 2.0, 3.0, 200.0, 20.0


def shot(seed, kind, light, seconds, frames=8, temperature_c=None):
    """A camera with a dark current of 20 e-/s; light: electrons per pixel."""
    rng, size = np.random.default_rng(seed), (frames, 64, 96)
    charge = rng.poisson(light + RATE * seconds, size) + rng.normal(0, READ, size)
    frames_dn = np.clip(np.rint(BLACK + GAIN * charge), 0, 16383).astype(np.uint16)
    return Recording(
        frames_dn, "RGGB", per_channel(BLACK), 16383.0, camera="made", kind=kind, exposure_s=seconds,
        temperature_c=temperature_c,
    )  # fmt: skip


def flats():
    """One steady light, 0.01 to 0.08 s."""
    return [shot(9 + n, "flat", 90000.0 * t, t) for n, t in enumerate((0.01, 0.02, 0.04, 0.08))]


def gathered(*recordings):
    return [frame_statistics(r) for r in recordings]


def test_one_long_dark_is_remarked_and_explains_nothing():
    statistics = gathered(*flats(), shot(1, "dark", 0.0, 10.0))
    transfer = transfer_at(statistics)
    text = format_transfer(transfer)
    assert "flats at 0.01 s" in text and "dark of 10 s" in text and "record a dark at 0.01 s" in text
    findings = find_mechanisms(statistics, transfer.baseline, LISTED)
    verdicts = {f.mechanism: f.verdict for f in findings}
    unknown = {"nonlinearity", "channel_offset", "bookkeeping"}
    assert {verdicts[id] for id in unknown} == {"not looked for"}
    assert "record a dark at" in format_findings(findings)
    model = sensor_model([transfer], findings)
    assert not unknown & {f.mechanism for f in model.mechanisms}


def test_what_nothing_was_recorded_for_is_not_said_to_be_absent():
    statistics = gathered(flats()[0], shot(1, "dark", 0.0, 0.01))
    findings = find_mechanisms(statistics, transfer_at(statistics).baseline, LISTED)
    absent, missing = (
        part.splitlines()
        for part in format_findings(findings)
        .partition("Not there:\n")[2]
        .split("\n\nNot looked for, for want of these recordings:\n")
    )
    assert any(line.startswith("  black_clipping: darks are not cut off") for line in absent)
    assert "  dark_current: record darks at three or more exposure times" in "\n".join(missing)
    assert not any(line.startswith("  missing_codes: no missing") for line in missing)


def test_of_darks_of_unknown_exposures_the_darkest_is_taken():
    made = (shot(n, "dark", 0.0, t) for n, t in enumerate((9.0, 0.01)))
    unknown = [dataclasses.replace(dark, exposure_s=None) for dark in made]
    for darks in (unknown, unknown[::-1]):
        level = black_at(gathered(*flats(), *darks), 0.01).level
        assert np.abs(np.subtract(level, BLACK)).max() < 1.0


def test_flats_beyond_the_last_code_show_no_full_well():
    darks = shot(2, "dark", 0.0, 0.01), shot(3, "dark", 0.0, 60.0)
    statistics = gathered(*flats(), shot(1, "flat", 8100.0, 0.1), *darks)
    transfer = transfer_at(statistics)
    text = format_transfer(transfer) + format_findings(find_mechanisms(statistics, transfer.baseline, LISTED))
    assert "saturation level" in text and "no flat is bright enough" not in text
    assert "saturation: the codes end before the pixels are full" in text


def test_ends_that_nothing_bounds_are_written_by_their_order():
    assert format_outcome(Estimate(1.0, 1.0, (0.0, 1e304))) == "1 [0, 1e+304]"


@pytest.mark.parametrize("times", [(5.0, 10.0, 20.0), (0.01, 10.0)], ids=["line", "as long as the flats"])
def test_black_is_that_of_the_flats_where_darks_allow_it(times):
    statistics = gathered(*flats(), *(shot(20 + n, "dark", 0.0, t) for n, t in enumerate(times)))
    black = black_at(statistics, 0.01)
    assert black.certain and ("line" in black.note) == (len(times) == 3)
    assert np.abs(np.subtract(black.level, BLACK)).max() < 4 * max(black.error) + 0.4  # and 0.4 DN of charge
    transfer = transfer_at(statistics)
    assert np.allclose(transfer.baseline.gain, GAIN, rtol=0.03)
    # In the line's darks 9 e-^2 of read noise stand beside 100 of charge, known to 2 of every channel.
    assert np.mean(transfer.baseline.read_noise_e) == pytest.approx(READ, abs=0.5 if black.note else 0.1)
    loss = MECHANISMS["nonlinearity"].estimator.measure(statistics)["loss"]
    assert abs(loss.value) < 3.5 * loss.stderr and loss.stderr < 0.01
    offset = MECHANISMS["channel_offset"].estimator.measure(statistics, transfer.baseline)["sigma_dn"]
    assert offset.value < 1.0


def test_the_model_of_long_darks_has_the_black_level_without_their_charge():
    statistics = gathered(*flats(), *(shot(20 + n, "dark", 0.0, t) for n, t in enumerate((5.0, 10.0, 20.0))))
    transfer = transfer_at(statistics)
    model = sensor_model([transfer], find_mechanisms(statistics, transfer.baseline, LISTED))
    assert "dark_current" in {f.mechanism for f in model.mechanisms}
    np.testing.assert_allclose(model.black_level, BLACK, atol=1.0)
    assert np.mean(model.read_noise_e) == pytest.approx(READ, abs=0.5)


@pytest.mark.slow
def test_error_of_the_line_holds_its_scatter():
    errors = []
    for seed in range(60):
        times = enumerate((1.0, 2.0, 4.0, 8.0))
        darks = gathered(*(shot(100 * seed + n, "dark", 0.0, t, 2) for n, t in times))
        black = black_at(darks, 0.01)
        errors.append((np.array(black.level) - BLACK - GAIN * RATE * 0.01) / black.error)
    assert 0.85 < np.std(errors) < 1.15
    assert 0.84 < np.mean(np.abs(errors) < 1.6449) < 0.95


def test_darks_of_another_temperature_do_not_count():
    darks = [shot(n, "dark", 0.0, t, temperature_c=20.0) for n, t in enumerate((5.0, 10.0, 20.0))]
    assert black_at(gathered(*darks), 0.01, 21.0).certain
    cold = black_at(gathered(*darks), 0.01, -10.0)
    assert not cold.certain and "record a dark at 0.01 s" in cold.note


def test_unknown_exposures_leave_the_dark_as_it_is():
    dark = shot(1, "dark", 0.0, 10.0)
    (s,) = gathered(dark)
    assert black_at([s], None).level == per_channel(s.frame_means.mean(0))
    assert not isinstance(MECHANISMS["bookkeeping"].estimator.measure([s]), NotMeasurable)


@pytest.mark.parametrize("rates", [(1.0, 0.44, 0.15), (1.0, 1.11, 1.25)], ids=["filters", "equal levels"])
def test_flats_of_several_lights_show_no_nonlinearity(rates):
    """As through filters, exposed until each is bright enough."""
    seconds = (1.0, 2.5, 6.0) if rates[1] < 1 else (1.0, 0.9, 0.8)
    lit = [
        shot(n, "flat", 5000.0 * rate * t, t) for n, (rate, t) in enumerate(zip(rates, seconds, strict=True))
    ]
    darks = [shot(20 + n, "dark", 0.0, t) for n, t in enumerate((0.01, 1.0, 6.0))]
    statistics = gathered(*lit, *darks)
    found = MECHANISMS["nonlinearity"].estimator.measure(statistics)
    assert isinstance(found, NotMeasurable) and "one light" in found.record


def test_quiet_darks_of_8_bits_leave_the_gain_alone():
    """Darks of 0.4 codes round to less than their variance and a twelfth of a code; flats do not."""
    rng = np.random.default_rng(8)
    made = []
    for n, electrons in enumerate((0.0, 1000.0, 2000.0, 4000.0)):
        values = 0.02 * (rng.poisson(electrons, (8, 96, 128)) + 20 * rng.standard_normal((8, 96, 128))) + 4
        frames = np.clip(np.rint(values), 0, 255).astype(np.uint16)
        kind = "flat" if electrons else "dark"
        made.append(Recording(frames, "MONO", (4.0,) * 4, 255.0, kind=kind, exposure_s=0.001 * max(n, 1)))
    gain = transfer_at(gathered(*made)).baseline.gain
    assert np.mean(gain) == pytest.approx(0.02, rel=0.01)
