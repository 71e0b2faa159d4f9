"""A glow of any smooth form is told from lines, tiles, steps and offsets that do not grow."""

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.signatures.even_glow import grows, smooth
from cannoise_jax.signatures.glow import glow_score
from tests.discovery.capture import SIZE, capture_set

Y, X = np.indices(SIZE)
RING = np.exp(-((np.hypot(Y - 0.8 * SIZE[0], X - 0.4 * SIZE[1]) - 30) ** 2) / 300)
RIDGE = np.exp(-((X - 0.45 * SIZE[1]) ** 2) / 400) * (1 + Y / SIZE[0])
SPOTS = np.exp(-np.hypot(Y - 20, X - 100) / 18) + 0.7 * np.exp(-np.hypot(Y - 70, X - 40) / 15)


def lines(rng):
    return rng.standard_normal((SIZE[0], 1)) + rng.standard_normal((1, SIZE[1]))


def tiles(rng):
    return np.kron(rng.standard_normal((6, 8)), np.ones((SIZE[0] // 6, SIZE[1] // 8)))


@pytest.mark.parametrize("form", [RING, RIDGE, SPOTS, X / SIZE[1] + 0 * Y])
def test_light_is_smooth(form):
    assert smooth(form)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("form", [lines, tiles, lambda rng: rng.standard_normal(SIZE)])
def test_lines_tiles_and_pixels_are_not(form, seed):
    assert not smooth(form(np.random.default_rng(seed)))


@pytest.mark.parametrize("at", [0.3, 0.5, 0.7])
def test_nor_is_a_step(at):
    assert not smooth((at * SIZE[1] < X) + 0.0 * Y)


def test_nothing_is_not():
    assert not smooth(np.ones(SIZE))


def glowing(form, *, dark=20.0, hot=0.004, growing=True):
    """Charge of this form, DN at the longer exposure, beside dark current, offsets of pixels and hot ones."""

    def alter(rng):
        offsets = rng.uniform(-4, 4, SIZE)
        charge = dark + form + 60 * (1 + rng.pareto(1.5, SIZE)).clip(0, 100) * (rng.random(SIZE) < hot)

        def change(dn, signal, kind, exposure):
            if kind != "dark":
                return dn + offsets
            grown = 1.5 * rng.poisson(charge / 1.5 * (exposure / 0.1 if growing else 1.0))
            return dn + offsets + grown

        return change

    return alter


@pytest.mark.parametrize("growing", [True, False])
def test_what_grows_with_the_exposure_is_told_from_what_does_not(growing):
    looking = splits_of(capture_set(8, glowing(60 * RING, growing=growing), kinds="d")).looking
    assert grows(looking.fields, RING) == growing
    score = glow_score(looking.fields)
    assert score is not None and score.payload.stands_out == growing


@pytest.mark.parametrize(
    "form", [pytest.param(RING, marks=pytest.mark.slow), pytest.param(SPOTS, marks=pytest.mark.slow)]
)
def test_a_glow_of_any_form_takes_no_name_with_it(form):
    found = diagnose(capture_set(9, glowing(150 * form, dark=60.0), kinds="df"), compare=False)
    sizes = {s.named.mechanism: s.named.score.amplitude for s in found.fitted.steps}
    own = {"amp_glow", "hot_pixels", "dark_current", "dsnu"}
    assert own <= set(found.findings)
    strength = 150 * np.sqrt(np.mean((form - np.quantile(form, 0.005)) ** 2))
    assert sizes["amp_glow"] == pytest.approx(strength, rel=0.05)
    # What its form, told from noisy pixels, leaves in lines and areas.
    assert all(size < 0.01 * strength for name, size in sizes.items() if name not in own)


@pytest.mark.parametrize("parts", [(2, 2), (1, 4), (3, 4), (4, 4)])
def test_amplifiers_are_no_light(parts):
    rng = np.random.default_rng(3)
    whole = [SIZE[0] // parts[0] * parts[0], SIZE[1] // parts[1] * parts[1]]
    tile = np.ones([n // k for n, k in zip(whole, parts, strict=True)])
    assert not any(smooth(np.kron(rng.standard_normal(parts), tile)) for _ in range(20))
