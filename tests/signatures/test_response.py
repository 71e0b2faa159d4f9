"""A response that bends, told by flats: the loss with its error, and what is no such loss."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.physics.transfer.bent import signal_of_order
from cannoise_jax.signatures.black_charge import charge_in_black
from cannoise_jax.signatures.curvature import order_of
from cannoise_jax.signatures.recorded import Level
from cannoise_jax.signatures.response import by_mean, by_variance, of_flats
from tests.discovery.looks import RECORDED, white

SPAN, GAIN, READ = 4000.0, 0.5, 3.0
LIGHT = np.array([0.1, 0.2, 0.4, 0.6, 0.8]) * SPAN
PIXELS, FRAMES = 40_000, 8


def recorded(rng, loss=0.0, lost=0.0, lamp=0.0, light=LIGHT, channels=range(4), order=1.0, pixels=PIXELS):
    """Levels of flats under a lamp that scatters by so much between them. loss: of the signal at white;
    lost: of the variance there, without one of the signal; order: by which power of the signal both grow."""
    steady = 1 + lamp * rng.standard_normal(len(light))
    levels = []
    for n, x in enumerate(light * steady):
        for c in channels:
            at = (1.0, 0.6, 0.6, 0.7)[c] * x
            share = (at / SPAN) ** order
            variance = (
                READ**2 + 1 / 12 + GAIN * at * (1 - (1 + order) * loss * share) ** 2 * (1 - lost * share)
            )
            error = variance * np.sqrt(2 / (pixels * (FRAMES - 1)))
            signal = at * (1 - loss * share)
            seen = variance + error * rng.standard_normal()
            levels.append(Level(n, c, signal, seen, error, pixels, full=False, sure=True, alone=0.0, part=0))
    base = dataclasses.replace(RECORDED.baselines[0], read_noise=np.full(4, READ), levels=tuple(levels))
    return RECORDED._replace(baselines=(base,), span=SPAN)


def lit(exposures):
    fields = white(np.random.default_rng(0), kinds=("flat",) * len(exposures), size=(32, 32))
    return tuple(f._replace(exposure_s=t / SPAN, clean=None) for f, t in zip(fields, exposures, strict=True))


def signature(baselines):
    said = RECORDED._replace(baselines=tuple(baselines), span=SPAN)
    return of_flats(said, name="x", parameter="loss", order="order", covers=(), lifted_by=())


def loose(levels):
    """Of so few pixels that a straight line is good enough."""
    return tuple(p._replace(error=30 * p.error) for p in levels)


FIELDS = lit(LIGHT)


def score_of(said, exposures=None):
    return signature(said.baselines).score(FIELDS if exposures is None else lit(exposures))


@pytest.mark.parametrize("order", [1.0, 1.5, 3.0])
@pytest.mark.parametrize("loss", [-0.1, -0.02, 0.02, 0.1])
def test_the_linear_signal_is_the_inverse_of_the_response(loss, order):
    x = np.linspace(0, SPAN, 9)
    assert np.allclose(signal_of_order(x * (1 - loss * (x / SPAN) ** order), loss, SPAN, order), x)


@pytest.mark.parametrize("order", [1.5, 2.0, 3.0])
def test_a_curve_that_is_no_parabola_is_found_and_measured(order):
    """As a parabola its variance tells more than its means, which spoke against any bend."""
    rng = np.random.default_rng(7)
    scores = [score_of(recorded(rng, loss=0.05, lamp=2e-3, order=order)) for _ in range(20)]
    assert np.mean([s.gain > 50 for s in scores]) > 0.8
    assert all(order_of(s.parameters) == order for s in scores)
    off = [(s.parameters["curvature"][0] - 0.05) / s.parameters["curvature"][2] for s in scores]
    assert abs(np.mean(off)) < 0.8 and np.max(np.abs(off)) < 4
    # Fewer frames, which do not tell the order, are asked for that which was found.
    said = recorded(rng, loss=0.05, lamp=2e-3, order=order)
    few = signature(dataclasses.replace(b, levels=loose(b.levels)) for b in said.baselines)
    assert order_of(few.score(FIELDS).parameters) == 1
    assert order_of(few.score_again(FIELDS, scores[0]).parameters) == order


@pytest.mark.parametrize("order", [2.0, pytest.param(3.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("light", [LIGHT, SPAN * np.array([0.11, 0.22, 0.45, 0.9])])
def test_where_the_variance_does_not_choose_the_order_the_means_do(order, light):
    rng = np.random.default_rng(31)
    scores = [
        score_of(recorded(rng, loss=0.03, order=order, light=light, pixels=4200), light) for _ in range(12)
    ]
    assert all(s.gain > 20 for s in scores)
    off = [(s.parameters["curvature"][0] - 0.03) / s.parameters["curvature"][2] for s in scores]
    assert np.max(np.abs(off)) < 4 and abs(np.mean(off)) < 1.5
    assert abs(np.mean([order_of(s.parameters) for s in scores]) - order) < 0.5
    first = next(s for s in scores if "order" in s.parameters)
    said = recorded(rng, loss=0.03, order=order, light=light, pixels=4200)
    again = signature(said.baselines).score_again(lit(light), first)
    assert again.parameters["order"] == first.parameters["order"] and again.parameters["order"][2] > 0


def test_a_lamp_bears_out_a_variance_that_bends_by_itself_by_chance_alone():
    rng = np.random.default_rng(32)
    light = SPAN * np.array([0.11, 0.22, 0.45, 0.9])
    scores = [
        score_of(recorded(rng, lost=0.1, lamp=0.005, light=light, pixels=4200), light) for _ in range(80)
    ]
    # One in twenty as a parabola, one in twenty as any other curve, less where the losses do not agree.
    assert sum(s.gain > 0 for s in scores) <= stats.binom.ppf(0.999, 80, 0.1)


@pytest.mark.parametrize(
    "order", [pytest.param(1.0, marks=pytest.mark.slow), pytest.param(2.0, marks=pytest.mark.slow), 3.0]
)
def test_a_variance_that_bends_by_itself_is_no_curve_of_any_order(order):
    """The order is that of the variance, where it tells one: the means are asked once, with one chance in
    twenty. Here it does."""
    rng = np.random.default_rng(8)
    lamps = np.repeat([1e-3, 3e-3, 0.01, 0.03], 30)
    named = [score_of(recorded(rng, lost=0.15, lamp=lamp, order=order)).gain > 0 for lamp in lamps]
    assert np.mean(named) < 0.08


def test_the_loss_of_a_photon_transfer_curve_is_told_with_its_error():
    rng = np.random.default_rng(1)
    off = []
    for _ in range(80):
        (base,) = recorded(rng, loss=0.04).baselines
        curves = [
            (
                np.array([p.signal for p in base.levels if p.channel == c]),
                np.array([p.variance for p in base.levels if p.channel == c]) - READ**2 - 1 / 12,
                np.array([p.error for p in base.levels if p.channel == c]),
            )
            for c in range(4)
        ]
        told = by_variance(curves, SPAN)
        off.append((told.loss - 0.04) / told.error)
    assert abs(np.mean(off)) < 0.35 and 0.75 < np.std(off) < 1.2


def test_the_loss_of_means_follows_students_law_whatever_the_lamp():
    rng = np.random.default_rng(2)
    t, group = [], np.array([0, 0, 0, 0, 1, 1, 1, 1, 1, 2, 2])  # too few of the last for a line
    for _ in range(2000):
        bend = -rng.uniform(0.1, 0.8, 11)
        told = by_mean(3.0 * group + 0.05 * bend + 0.01 * rng.standard_normal(11), bend, group)
        assert told is not None and told.freedom == 9 - 2 - 1
        t.append((told.loss - 0.05) / told.error)
    assert stats.kstest(t, "t", args=(6,)).pvalue > 1e-3


def test_a_response_that_bends_is_found_and_measured():
    rng = np.random.default_rng(3)
    for loss in (0.05, -0.04):
        score = score_of(recorded(rng, loss=loss, lamp=1e-3))
        told, _, error = score.parameters["curvature"]
        assert score.gain > 50 and abs(told - loss) < 4 * error < 0.02


def test_a_lamp_or_a_variance_that_bends_by_itself_is_none():
    """The steadiness of the lamp is as often above as below that of means which would follow the loss."""
    rng = np.random.default_rng(4)
    named = [
        score_of(recorded(rng, lost=0.15, lamp=lamp)).gain > 0 for lamp in (1e-3, 0.01) for _ in range(20)
    ]
    assert np.mean(named) < 0.15  # of one in twenty: as many have a probability of 0.014
    straight = [score_of(recorded(rng, lamp=lamp)).log_p for lamp in (1e-3, 0.01) for _ in range(20)]
    assert min(straight) > np.log(1e-3)
    # Flats that get too bright too soon, as of a lamp that warms up: the variance knows of nothing.
    assert score_of(recorded(rng, light=LIGHT * (1 - 0.1 * LIGHT / SPAN))).gain < 4


def test_a_flat_in_which_a_colour_is_full_tells_nothing_of_the_others():
    """The brightest channel of the last flat is missing: what is left of that flat is darker on average."""
    rng = np.random.default_rng(6)
    gains = []
    for _ in range(40):
        said = recorded(rng, lost=0.1, lamp=1e-3)
        (base,) = said.baselines
        shown = tuple(p for p in base.levels if (p.recording, p.channel) != (4, 0))
        gains.append(score_of(said._replace(baselines=(dataclasses.replace(base, levels=shown),))).gain)
    assert np.mean(np.array(gains) > 0) < 0.15


def test_few_exposures_tell_nothing():
    rng = np.random.default_rng(5)
    assert score_of(recorded(rng, loss=0.05, light=LIGHT[:2]), LIGHT[:2]) is None
    assert score_of(recorded(rng, loss=0.05), np.full(5, SPAN)) is None
    # Three under a lamp that is not steady are one freedom.
    few = [0, 2, 4]
    gains = [
        score_of(recorded(rng, loss=0.01, lamp=0.02, light=LIGHT[few]), LIGHT[few]).gain for _ in range(40)
    ]
    assert np.mean(np.array(gains) > 0) < 0.3


def test_dark_charge_in_the_black_level_is_no_bend_of_the_light():
    """A shortest dark of a thirtieth of the longest flat, and so much charge that a thousandth of the light
    is in it: the flats of few milliseconds seem to have too little light."""
    seconds, rate = LIGHT / SPAN, 0.03 * SPAN  # DN/s, of flats of SPAN DN/s
    darks = tuple(
        f._replace(exposure_s=t, mean=np.full_like(f.mean, 100.0 + rate * t))
        for f, t in zip(
            white(np.random.default_rng(1), kinds=("dark",) * 3, size=(32, 32)), (0.05, 0.1, 0.8), strict=True
        )
    )
    assert charge_in_black(darks, seconds.max()) == {0: pytest.approx(0.05 * rate, rel=0.05)}
    bias = darks[0]._replace(exposure_s=0.0, mean=np.full_like(darks[0].mean, 100.0))
    assert charge_in_black((bias, *darks), seconds.max()) == {}
    found, missed = 0, 0
    for seed in range(10):
        said = recorded(np.random.default_rng(seed), loss=0.015)
        lowered = [
            dataclasses.replace(b, levels=tuple(p._replace(signal=p.signal - 0.05 * rate) for p in b.levels))
            for b in said.baselines
        ]
        known = RECORDED._replace(baselines=tuple(lowered), span=SPAN, unlit=darks)
        for unlit in (darks, ()):
            told = of_flats(
                known._replace(unlit=unlit),
                name="x",
                parameter="loss",
                order="order",
                covers=(),
                lifted_by=(),
            ).score(FIELDS)
            found += bool(unlit) and told.gain > 10
            missed += not unlit and not told.gain > 10
    assert found >= 9 and missed >= 9
