"""Intervals of paired denoisers: coverage, and what pairing is worth."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.evaluation.denoising import gap_closed, in_order, paired_interval, psnr, ssim, summary


def runs(rng, gain, seeds=3, scenes=12):
    """PSNRs with a spread of seeds of 1 dB and of scenes of 3 dB, both shared, and 0.2 dB of their own."""
    common = rng.normal(30, 1, (seeds, 1)) + rng.normal(0, 3, (1, scenes))
    return [common + g + rng.normal(0, 0.2, (seeds, scenes)) for g in (0.0, gain)]


def test_intervals_cover_the_true_gain_in_about_nine_of_ten_trials():
    rng = np.random.default_rng(0)
    inside, widths = 0, []
    for trial in range(200):
        base, other = runs(rng, 0.5)
        found = paired_interval(other, base, trial)
        inside += found.low <= 0.5 <= found.high
        widths.append(found.high - found.low)
    assert inside >= 0.80 * 200
    assert np.mean(widths) < 0.4  # unpaired seeds alone would make it 2


def test_one_seed_is_resampled_over_scenes_alone():
    rng = np.random.default_rng(1)
    base, other = runs(rng, 0.5, seeds=1)
    found = paired_interval(other, base)
    assert found.low < found.value < found.high
    assert found.high - found.low == pytest.approx(2 * 1.645 * (other - base).std(ddof=1) / 12**0.5, rel=0.25)


def test_psnr_and_ssim_of_known_errors():
    rng = np.random.default_rng(2)
    clean = rng.uniform(0, 1, (32, 32, 4)).astype(np.float32)
    assert psnr(clean, clean + 0.1) == pytest.approx(20, abs=1e-3)
    assert psnr(clean, clean) == np.inf
    assert ssim(clean, clean) == pytest.approx(1)
    noisy = clean + 0.3 * rng.normal(size=clean.shape).astype(np.float32)
    assert ssim(clean, noisy) < 0.9


def test_summary_and_order_say_what_is_told_apart():
    rng = np.random.default_rng(3)
    base, best = runs(rng, 2.0)
    numbers = {"pg": base, "calibrated": base + 1.0, "discovered": base + 1.0, "real_darks": best}
    rows = summary(numbers, "pg", "real_darks")
    assert rows["calibrated"]["gap_closed"] == pytest.approx(0.5, abs=0.06)
    assert "over_pg" not in rows["pg"] and rows["calibrated"]["over_pg"]["low"] == pytest.approx(1)
    outcomes = [
        step["outcome"] for step in in_order(numbers, ("pg", "calibrated", "discovered", "real_darks"))
    ]
    assert outcomes == ["above", "not told apart", "above"]
    assert np.isnan(gap_closed(base, best, base))
    none = best - best.mean() + base.mean() + 1e-3  # above by a hair, and by far more from scene to scene
    rows = summary({**numbers, "real_darks": none}, "pg", "real_darks")
    assert rows["real_darks"]["over_pg"]["low"] < 0 < rows["real_darks"]["over_pg"]["value"]
    assert all("gap_closed" not in row for row in rows.values())
