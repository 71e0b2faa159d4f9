"""The lattice of codes: combs of every kind, and histograms that are uneven without one."""

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.signatures.codes import Codes, comb_score
from tests.discovery.capture import SIZE, capture_set

LEVELS = ((500, 5.0), (900, 22.0), (1500, 31.0))


def values(seed):
    rng = np.random.default_rng(seed)
    drawn = np.concatenate([rng.normal(mean, sigma, 60_000) for mean, sigma in LEVELS])
    return np.rint(drawn).astype(int), rng


def score(codes):
    counts = np.bincount(codes, minlength=4096).astype(float)
    return comb_score(None, codes=Codes(counts, 4.9, (), (), 1.0, 1.0, None))


@pytest.mark.parametrize("period, share", [(2, 1.0), (2, 0.05), (5, 1.0), (12, 0.5), (33, 0.5), (100, 1.0)])
def test_period_of_codes_that_the_converter_skips(period, share):
    codes, rng = values(period)
    skipped = (codes % period == 1) & (rng.random(codes.size) < share)
    found = score(codes - skipped)
    assert found.log_p < -20
    assert found.amplitude == period
    assert found.where["phase"] == 1
    # The code below has what is missing; every second code has one such on either side.
    beside = 1 + share / (1 if period == 2 else 2)
    assert found.parameters["shortfall"][0] == pytest.approx(1 - (1 - share) / beside, abs=0.2 * share)


def test_codes_that_digital_scaling_doubles_repeat_after_no_whole_number():
    codes, _ = values(3)
    found = score(np.floor(codes * 26 / 29).astype(int))  # three of 29 fall together with their neighbour
    assert found.log_p < -100
    assert found.amplitude == pytest.approx(26 / 3, rel=0.01)
    assert found.parameters["shortfall"][0] < -0.5


def test_one_uneven_code_is_no_comb():
    codes, rng = values(4)
    moved = (codes == 500) & (rng.random(codes.size) < 0.1)
    assert score(codes - moved).log_p == 0.0


def test_null_is_not_too_small():
    p = np.exp([score(values(seed)[0]).log_p for seed in range(40)])
    assert p.min() > 1e-3


@pytest.mark.parametrize("black", [0.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_darks_cut_off_at_black_are_neither_hot_nor_curved(black):
    found = diagnose(capture_set(1, black=black), compare=False)
    assert found.findings == ["black_clipping"]


@pytest.mark.parametrize("skipped", [True, False])
def test_codes_are_judged_in_frames_that_are_all_alike(skipped):
    """Flats and darks whose codes lie within a few standard deviations have no rail at their extremes."""

    def alter(rng):
        return lambda dn, *_: np.where(np.rint(dn) % 8 == 7, np.rint(dn) + 1, dn) if skipped else dn

    looking = splits_of(capture_set(3, alter, kinds="df")).looking
    comb = next(s for s in looking.signatures if s.name == "comb").score(looking.fields)
    assert comb is not None
    assert (comb.log_p < -100 and comb.amplitude == 8) if skipped else comb.log_p > -7


@pytest.mark.parametrize("seed", range(3))
def test_a_dead_column_in_broad_flats_leaves_no_comb(seed):
    """Its codes are as narrow as the read noise."""

    def alter(rng):
        def change(dn, signal, kind, exposure):
            dark = 200 + 1.5 * 2 * rng.standard_normal(dn.shape)
            return np.where(np.arange(dn.shape[1]) == 40, dark, dn)

        return change

    looking = splits_of(capture_set(seed, alter, kinds="f", read=20.0)).looking
    comb = next(s for s in looking.signatures if s.name == "comb").score(looking.fields)
    assert comb is not None and comb.log_p > -7


@pytest.mark.slow
@pytest.mark.parametrize("share", [pytest.param(0.0, marks=pytest.mark.slow), 0.01])
def test_pixels_that_jump_are_told_beside_a_comb(share):
    """A comb makes no pixel louder than others: what jumps by several codes is not its doing."""

    def alter(rng):
        jump = rng.exponential(30.0, SIZE) * (rng.random(SIZE) < share)

        def change(dn, *_):
            codes = np.rint(dn + jump * (rng.random(SIZE) < 0.5))
            return np.where(codes % 8 == 7, codes + 1, codes)

        return change

    found = diagnose(capture_set(5, alter, kinds="df"), compare=False).findings
    assert "missing_codes" in found
    assert ("rts" in found) == bool(share)


def test_codes_that_are_rarer_are_in_the_simulator_and_as_rare_there():
    """Thresholds of a converter that lie uneven make every second code narrower."""

    def narrower(rng):
        def change(dn, *_):
            below = np.floor(dn)
            first = np.where(below % 2 == 0, 0.56, 0.44)  # even codes end later
            return below + (dn - below > first)

        return change

    found = diagnose(capture_set(6, narrower, kinds="df", frames=8), compare=False)
    assert found.findings == ["missing_codes"]
    drawn = found.model.sample(jax.random.key(1), np.zeros(SIZE, np.float32), Settings(iso=100.0, frames=16))
    darks = (r for r in found.capture.recordings if r.kind == "dark")
    real = np.concatenate([np.asarray(r.frames).ravel() for r in darks])

    def odd(codes):
        return np.mean(np.asarray(codes) % 2)

    assert odd(real) < 0.46 and odd(drawn) == pytest.approx(odd(real), abs=0.01)
