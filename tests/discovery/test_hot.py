"""Hot pixels: what is known of each, against integration, and their strength on new frames."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings, splits_of
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.discovery.search.locate import Located
from cannoise_jax.discovery.search.maps import one_draw
from cannoise_jax.discovery.search.name import name
from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.heat import Heat, known_heat
from cannoise_jax.signatures.hot import heat_again, hot_score, mask_hot
from cannoise_jax.signatures.rare import hot_log_p, level_counts, log_mixture, spread_of
from cannoise_jax.signatures.score import Score
from tests.discovery.capture import capture_set
from tests.discovery.looks import SIGNATURES

SIZE = (96, 128)
TOGETHER = ["hot_additive", "pixel_additive_static"]


def dark(static: np.ndarray, frames: int) -> Fields:
    """A dark of unit noise: only the sum of its frames, of standard deviation 1."""
    one = np.ones(static.shape, np.float32)
    return Fields(
        "d", "dark", frames, 0, 0, 1.0, 1.0, one, 0 * one, one, 0 * one, one > 0,
        np.zeros((0, *static.shape), np.float32), static.astype(np.float32), None, np.ones(4), np.zeros(4),
    )  # fmt: skip


def split(rng, share: float, mean: float, frames=(6, 2)):
    """Heat of every pixel, DN, and the same camera in two groups of frames."""
    heat = (rng.random(SIZE) < share) * rng.exponential(mean, SIZE)
    return heat, *(dark(np.sqrt(n) * heat + rng.standard_normal(SIZE), n) for n in frames)


@pytest.mark.parametrize("u", [-2.0, 1.0, 3.5, 6.0, 40.0])
def test_what_is_known_of_a_pixel_agrees_with_integration(u):
    share, mean, frames = 0.01, 0.8, 4
    known = known_heat((dark(np.full((2, 2), u), frames),), Heat(share, mean, "additive"))
    assert known is not None

    def moment(k):
        def density(x):
            likelihood = stats.norm.pdf(u - np.sqrt(frames) * x) / stats.norm.pdf(u)
            return x**k * likelihood * stats.expon.pdf(x, scale=mean)

        at = max(u / np.sqrt(frames), 0.0)
        return integrate.quad(density, 0, at + 6, points=[at], epsabs=0, epsrel=1e-9, limit=400)[0]

    if u < 10:
        odds = share * moment(0) / (1 - share)
        chance = odds / (1 + odds)
        first, second = (chance * moment(k) / moment(0) for k in (1, 2))
    else:  # surely hot: a normal law about the value, drawn towards zero by the mean
        chance, first = 1.0, u / 2 - 1 / (4 * mean)
        second = first**2 + 1 / 4
    assert known.chance[0, 0] == pytest.approx(chance, rel=1e-6)
    assert known.mean[0, 0] == pytest.approx(first, rel=1e-5)
    assert known.variance[0, 0] == pytest.approx(second - first**2, rel=1e-4)


def test_draws_have_the_strength_of_the_camera_and_lie_where_it_is_known():
    rng = np.random.default_rng(1)
    heat, first, _ = split(rng, 3e-3, 5.0)
    known = known_heat((first,), Heat(3e-3, 5.0, "additive"))
    assert known is not None
    drawn = known.draw(rng)
    assert np.mean(drawn**2) == pytest.approx(np.mean(heat**2), rel=0.1)
    hot = heat > 3
    assert np.max(np.abs(drawn - heat)[hot]) < 5 / np.sqrt(6)
    assert np.all(drawn >= 0)


@pytest.mark.parametrize(
    ("share", "mean", "cameras"),
    [
        (5e-4, 5.0, 30),
        pytest.param(1.5e-3, 1.2, 100, marks=pytest.mark.slow),
        pytest.param(5e-4, 5.0, 100, marks=pytest.mark.slow),
    ],
)
def test_strength_on_new_frames_covers_the_truth(share, mean, cameras):
    """Hot pixels just seen, and well seen: the estimate is centred and its interval holds the truth. The mean
    of the errors, of unit variance each, is held to four of its own standard deviations."""
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(cameras):
        heat, first, second = split(rng, share, mean)
        looked = hot_score((first,), scaling="additive")
        assert looked is not None
        if looked.log_p > -9:
            continue
        again = heat_again(looked, (first,), (second,))
        assert again is not None
        errors.append((again.amplitude - float(np.sqrt(np.mean(heat**2)))) / again.error)
    assert len(errors) > 0.8 * cameras
    assert abs(np.mean(errors)) < 4 / np.sqrt(cameras)
    low, high = stats.binom.ppf([1e-3, 0.999], len(errors), 0.91)
    assert low <= np.sum(np.abs(errors) < 1.645) <= high


@pytest.mark.slow
def test_strength_covers_the_truth_where_hot_pixels_have_shot_noise_of_their_own():
    """Heat of up to a hundred standard deviations, whose own noise is then ten times that of other pixels."""
    rng = np.random.default_rng(21)
    errors = []
    for _ in range(40):
        heat = (rng.random(SIZE) < 1e-3) * rng.exponential(30.0, SIZE)
        own = [dark(np.sqrt(n) * heat + np.sqrt(1 + heat) * rng.standard_normal(SIZE), n) for n in (6, 2)]
        looked = hot_score((own[0],), scaling="additive")
        again = heat_again(looked, *((f,) for f in own))
        errors.append((again.amplitude - float(np.sqrt(np.mean(heat**2)))) / again.error)
    assert abs(np.mean(errors)) < 4 / np.sqrt(40)
    low, high = stats.binom.ppf([1e-3, 0.999], len(errors), 0.91)
    assert low <= np.sum(np.abs(errors) < 1.645) <= high


def test_where_nothing_is_known_nothing_is_said():
    rng = np.random.default_rng(3)
    _, first, _ = split(rng, 0.0, 1.0)
    score = strong(0.1, payload=Heat(1e-4, 1.0, "additive"))
    assert heat_again(score, (first,), (first._replace(static=None),)) is None


def test_p_of_hot_pixels_is_uniform_under_noise():
    rng = np.random.default_rng(4)
    p = []
    for _ in range(600):
        value = float(log_mixture(level_counts(rng.standard_normal(SIZE).ravel())))
        p.append(np.exp(hot_log_p(value, SIZE[0] * SIZE[1])))
    for level in (0.3, 0.1, 0.02):  # neither too small nor, as the inverse ratio is, far too large
        low, high = stats.binom.ppf([1e-4, 0.9999], 600, level)
        assert low <= np.sum(np.array(p) <= level) <= high


def test_p_falls_with_the_ratio_and_stays_below_its_inverse():
    values = np.array([-3.0, -1.0, 0.0, 2.0, 8.0, 30.0, 60.0, 5000.0])
    p = [hot_log_p(float(v), 49152) for v in values]
    assert np.all(np.diff(p) < 0)
    assert np.all(np.array(p)[2:] < -values[2:] - 3)  # the inverse alone gives three nats away
    assert p[-1] > -values[-1] - 15


@pytest.mark.parametrize("step", [0.3, 0.7, 1.1])
def test_spread_of_a_coarse_lattice_with_far_values(step):
    rng = np.random.default_rng(6)
    u = np.rint(1.3 * rng.standard_normal(40_000) / step) * step
    expected = np.sqrt(1.3**2 + step**2 / 12)
    u[:40] += rng.exponential(50, 40)
    assert spread_of(u) == pytest.approx(expected, rel=0.02)
    assert spread_of(0.5 * u) == 1.0


@pytest.mark.parametrize(("share", "mean"), [(0.1, 700.0), (0.02, 3000.0), (0.3, 20.0)])
def test_many_and_far_hot_pixels_have_their_share_and_height(share, mean):
    rng = np.random.default_rng(8)
    heat, first, _ = split(rng, share, mean)
    score = hot_score((first,), scaling="additive")
    assert score is not None
    drawn = np.mean(heat > 0)
    assert score.parameters["fraction"][0] == pytest.approx(drawn, rel=0.1)
    assert score.payload.mean == pytest.approx(heat[heat > 0].mean(), rel=0.05)
    assert score.amplitude == pytest.approx(np.sqrt(np.mean(heat**2)), rel=0.25)


def test_hot_pixels_beside_a_map_of_every_pixels_level():
    """Where every pixel has a level of its own, those that stand out from these are hot and no others, and
    the map is left to be found without them."""
    rng = np.random.default_rng(9)
    spread, share, mean = 6.0, 0.02, 150.0
    heat = (rng.random(SIZE) < share) * rng.exponential(mean, SIZE)
    level = spread * rng.standard_normal(SIZE)
    first, second = (dark(np.sqrt(n) * (level + heat) + rng.standard_normal(SIZE), n) for n in (6, 2))
    looked = hot_score((first,), scaling="additive")
    assert looked is not None and looked.log_p < -100
    assert looked.payload.beside_map
    assert looked.payload.core.spread == pytest.approx(spread * np.sqrt(6), rel=0.1)
    assert looked.parameters["fraction"][0] == pytest.approx(share, rel=0.3)
    left = mask_hot((first,), looked)[0]
    far = heat > 6 * spread
    assert not left.usable[far].any()
    assert left.usable[heat == 0].mean() > 0.995
    known = known_heat((first,), looked.payload)
    assert known is not None and set(np.unique(known.chance)) <= {0.0, 1.0}
    again = heat_again(looked, (first,), (second,))
    assert again is not None
    assert again.amplitude == pytest.approx(np.sqrt(np.mean(heat**2)), rel=0.1)
    # A pixel is hot or one of the map: drawn together it has the level that was recorded, noise apart.
    fitted = stepwise((first,), tuple(SIGNATURES[n] for n in TOGETHER), frozenset(MECHANISMS), -5.0)
    assert [s.named.signature.name for s in fitted.steps] == TOGETHER
    whole = np.sum(np.stack([m for m in one_draw(fitted.steps) if m is not None]), axis=0)
    off = (whole - level - heat)[known.chance == 1]
    assert np.sqrt(np.mean(off**2)) < 2 * np.sqrt(2 / 6)  # of the recording and of the draw
    assert judged_first("pixel_additive_static", "row_additive_static", looked) == "hot_additive"
    assert judged_first("row_additive_static", "pixel_additive_static", looked) == "hot_additive"
    # What is new in every frame is no imprint of theirs.
    assert judged_first("row_additive_temporal", "row_additive_static", looked) == "row_additive_temporal"


def strong(amplitude, gain=1e9, payload=None):
    """A score beyond doubt."""
    return Score(
        log_p=-500.0, gain=gain, penalty=1.0, amplitude=amplitude, error=0.1, shift=0.1, power=2,
        parameters={}, where={"axis": "row"}, payload=payload,
    )  # fmt: skip


def judged_first(strongest, second, hot):
    """Which of two patterns and hot pixels is judged first."""
    scores = {strongest: strong(1.0, 2e9), second: strong(1.0), "hot_additive": hot}
    located = Located(scores, dict.fromkeys(scores, -500.0), 3.0)
    found = name(located, tuple(SIGNATURES[n] for n in scores), frozenset(), -5.0)
    assert found is not None
    return found.signature.name


@pytest.mark.parametrize("jumping", [True, False])
def test_pixels_that_jump_are_off_in_the_mean_too(jumping):
    """Of the same pixels, jumps and offsets are one finding, of jumps; offsets without jumps stay offsets."""

    def alter(rng):
        chosen = rng.random((96, 128)) < 0.006
        size = 4.5 * rng.uniform(3, 9, chosen.shape) * chosen
        return lambda dn, signal, kind, t: dn + size * (rng.random(dn.shape) < 0.5 if jumping else 1)

    capture = capture_set(5, alter, kinds="d", frames=10)
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    scores = {s.name: score for s in prepared.signatures if (score := s.score(prepared.fields)) is not None}
    read = {
        s.name: s.read_as(scores[s.name], scores)[0]
        for s in prepared.signatures
        if s.name in ("telegraph", "hot_additive")
    }
    assert (read["telegraph"][1] > read["hot_additive"][1]) == jumping
    assert read["telegraph"][0] == "rts"
    assert scores["telegraph"].payload.mostly == jumping


@pytest.mark.parametrize("frames", [4, pytest.param(12, marks=pytest.mark.slow)])
def test_pixels_in_either_level_half_of_the_time_are_no_hot_ones(frames):
    """However many frames make their mean sure, beside row noise and column offsets."""

    def alter(rng):
        jump = 14.0 * rng.gamma(4, 0.25, (96, 128)) * (rng.random((96, 128)) < 0.008)
        columns = 1.0 * rng.standard_normal((1, 128))

        def change(dn, signal, kind, t):
            return dn + columns + rng.standard_normal((96, 1)) + jump * (rng.random(dn.shape) < 0.5)

        return change

    looking = splits_of(capture_set(6, alter, kinds="d", frames=frames)).looking
    found = stepwise(looking.fields, looking.signatures, frozenset(MECHANISMS), np.log(0.01))
    names = [step.named.mechanism for step in found.steps]
    assert "rts" in names and "hot_pixels" not in names


@pytest.mark.parametrize("grows", [True, False])
def test_far_pixels_have_the_law_that_their_levels_follow(grows):
    """A thousand standard deviations and more: both laws are as sure that these are hot."""

    def alter(rng):
        heat = (rng.random(SIZE) < 0.01) * rng.exponential(2000.0, SIZE)
        return lambda dn, signal, kind, t: dn + heat * (t / 0.1 if grows else 0.5) * (kind == "dark")

    capture = capture_set(7, alter, kinds="df")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    by_name = {s.name: s for s in prepared.signatures}
    scores = {law: by_name[f"hot_{law}"].score(prepared.fields) for law in ("thermal", "additive")}
    right, wrong = ("thermal", "additive") if grows else ("additive", "thermal")
    assert scores[right].log_p < -100 and scores[wrong].log_p == 0


def test_a_map_of_dark_current_holds_how_the_sites_of_the_mosaic_differ():
    """The level of each site is taken out of every recording before a map is looked for."""
    rate = 8 * np.random.default_rng(4).gamma(4.0, 0.25, SIZE)
    rate[::2, 1::2] += 3

    def alter(rng):
        return lambda dn, signal, kind, t: dn + rate * t / 0.1 * (kind == "dark")

    first = splits_of(capture_set(7, alter, kinds="df", frames=8)).looking
    signatures = (SIGNATURES["pixel_thermal_static"],)
    steps = stepwise(first.fields, signatures, frozenset(MECHANISMS), -5.0).steps
    (drawn,) = one_draw(steps)
    sites = [[float(m[y::2, x::2].mean()) for y in (0, 1) for x in (0, 1)] for m in (drawn, rate)]
    drawn_apart, apart = (np.subtract(s, np.mean(s)) for s in sites)
    np.testing.assert_allclose(drawn_apart, apart, atol=0.25)


@pytest.mark.parametrize("hot", [0.0, 1e-3])
def test_darks_cut_off_at_black_show_hot_pixels_and_make_none(hot):
    """Half of all values lie at code 0, offsets of pixels among them: the means of two frames are skewed."""
    rng = np.random.default_rng(11)
    for _ in range(2):
        heat = (rng.random(SIZE) < hot) * rng.exponential(20.0, SIZE)
        level = 0.5 + rng.normal(0, 0.3, SIZE) + heat
        frames = np.round(np.maximum(level + rng.normal(0, 1.75, (2, *SIZE)), 0))
        noise = float(np.std(frames[1] - frames[0])) / np.sqrt(2)
        static = np.sqrt(2) * (frames.mean(0) - np.median(frames)) / noise
        looked = hot_score((dark(static - static.mean(), 2),), scaling="additive", cut=True)
        assert looked is not None
        assert (looked.log_p < -50) if hot else (looked.log_p == 0.0)
        if hot:
            assert looked.amplitude * noise == pytest.approx(np.sqrt(np.mean(heat**2)), rel=0.35)
