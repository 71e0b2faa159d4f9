"""The law of strength against simulation: the likelihood ratio that knows the effect, on drawn frames."""

from dataclasses import replace

import numpy as np
import pytest

from cannoise_jax.blind import sparse
from cannoise_jax.blind.chain import Shot, expose
from cannoise_jax.blind.effects import LISTED, UNLISTED, effect
from cannoise_jax.blind.sets import Design, draw_camera
from cannoise_jax.blind.strength import reachable, strength

SIZE = (48, 64)
FRAMES = 6


def design() -> Design:
    """A small set with a fine converter, so that the shift can be simulated quickly."""
    camera = replace(draw_camera(np.random.default_rng(0)), gain=2.0, read_e=3.0, step=1.0, white=60000.0)
    shots = tuple(
        Shot(f"s{i}", kind, np.full(SIZE, level), FRAMES, seconds)
        for i, (kind, level, seconds) in enumerate(
            [("dark", 0.0, 8.0), ("flat", 0.02, 1.0), ("flat", 0.2, 1.0)]
        )
    )
    return Design(camera, shots, "independent", True, "full")


def groups_statistic(plan: Design, frames: list[np.ndarray], group: str) -> float:
    """Sum over groups of (weighted sum)^2 - its expectation: the score for a variance component, unscaled."""
    total = 0.0
    frozen = 0.0
    for seen, exposed in zip(frames, plan.exposed(), strict=True):
        variance = exposed.variance(plan.camera)
        mean = plan.camera.black_map(SIZE) + plan.camera.gain * exposed.electrons
        load = plan.camera.gain * exposed.electrons if group == "prnu" else np.ones(SIZE)
        weighted = load * (seen.astype(np.float64) - mean) / variance
        if group == "row":
            total += np.sum(weighted.sum(2) ** 2 - np.sum(weighted**2, axis=2))
        elif group == "frame":
            total += np.sum(weighted.sum((1, 2)) ** 2 - np.sum(weighted**2, axis=(1, 2)))
        else:
            frozen = frozen + weighted.sum(0)
            total -= np.sum(weighted**2)
    return float(total + np.sum(np.square(frozen)))


@pytest.mark.parametrize(
    ("mechanism", "group"),
    [
        ("row_noise", "row"),
        pytest.param("offset_drift", "frame", marks=pytest.mark.slow),
        pytest.param("dsnu", "pixel", marks=pytest.mark.slow),
        ("prnu", "prnu"),
    ],
)
def test_the_minimum_detectable_effect_shifts_its_own_score_by_five(mechanism, group):
    plan = design()
    amplitude = strength(mechanism, plan.camera, plan.exposed()).amplitude_at(1.0)

    def draw(effects, seed):
        rng = np.random.default_rng([seed, 7])
        camera = replace(plan.camera, unit=seed)
        moved = replace(plan, camera=camera)
        return groups_statistic(moved, [expose(camera, s, effects, rng) for s in plan.shots], group)

    null = np.array([draw((), seed) for seed in range(150)])
    with_it = np.array([draw((effect(mechanism, amplitude),), seed) for seed in range(150)])
    shift = (with_it.mean() - null.mean()) / null.std()
    error = np.hypot(with_it.std(), 5 * null.std() / np.sqrt(2)) / null.std() / np.sqrt(150)
    assert abs(shift - 5) < 3.5 * error + 0.3, (shift, error)


def test_few_hot_pixels_shift_their_likelihood_ratio_as_tabulated():
    information, pixels = 0.8, 4000
    law = sparse.hot(information, pixels)
    amplitude = law.amplitude_at(1.0)
    assert law.shift(amplitude) == pytest.approx(5, rel=1e-6) and law.amplitude_at(0.5) < amplitude
    mean_height = amplitude / np.sqrt(2 * sparse.HOT_FRACTION) * np.sqrt(information)
    heights = np.linspace(0.01, 14, 150) * mean_height
    weights = np.exp(-heights / mean_height)
    weights /= weights.sum()
    rng = np.random.default_rng(2)

    def statistic(hot: bool) -> float:
        z = rng.standard_normal(pixels)
        if hot:
            z += (rng.random(pixels) < sparse.HOT_FRACTION) * rng.exponential(mean_height, pixels)
        ratio = np.exp(z[:, None] * heights - heights**2 / 2) @ weights
        return float(np.log1p(sparse.HOT_FRACTION * (ratio - 1)).sum())

    null = np.array([statistic(False) for _ in range(300)])
    hot = np.array([statistic(True) for _ in range(300)])
    shift = (hot.mean() - null.mean()) / null.std()
    assert abs(shift - 5) < 4 * (hot.std() / null.std() / 17 + 0.3), shift


def test_few_telegraph_pixels_shift_their_likelihood_ratio_as_tabulated():
    frames, pixels = 8, 12000
    law = sparse.telegraph(1.0, frames, pixels)
    amplitude = law.amplitude_at(1.0)
    mean_height = amplitude / np.sqrt(sparse.TELEGRAPH_FRACTION)
    heights = np.linspace(0.1, 13.9, 70) * mean_height
    weights = np.exp(-heights / mean_height)
    weights /= weights.sum()
    rng = np.random.default_rng(3)

    def log_ratio(z):
        up_down = np.cosh(heights[:, None, None] * z) * np.exp(-(heights[:, None, None] ** 2) / 2)
        each = np.log(0.5 + 0.5 * up_down).sum(2)
        return np.log(weights @ np.exp(each)), each

    def change_and_spread(batches):
        """Pixels of every height, and of none, alike often; weights make them quiet or affected ones."""
        rows = []
        for _ in range(batches):
            height = np.concatenate([np.zeros(200), heights])
            z = rng.standard_normal((270, frames)) + height[:, None] * rng.choice(
                (-1, 0, 0, 1), (270, frames)
            )
            log, each = log_ratio(z)
            drawn = (200 + np.exp(each).sum(0)) / 270
            value = np.log1p(sparse.TELEGRAPH_FRACTION * np.expm1(log))
            rows.append(np.stack([1 / drawn, np.exp(log) / drawn, value, (z**2 - 1).sum(1)]))
        quiet, loud, value, squares = np.concatenate(rows, axis=1)
        value = value - np.average(value, weights=quiet)
        value -= squares * np.average(value * squares, weights=quiet) / np.average(squares**2, weights=quiet)
        value -= np.average(value, weights=quiet)
        return np.average(value, weights=loud), np.sqrt(np.average(value**2, weights=quiet))

    change, spread = change_and_spread(160)
    shift = sparse.TELEGRAPH_FRACTION * np.sqrt(pixels) * change / spread
    assert shift == pytest.approx(5, abs=0.3)
    assert sparse.telegraph(1.0, 2 * frames, pixels).amplitude_at(1.0) < 0.9 * amplitude


@pytest.mark.parametrize("mechanism", ["nonlinearity", "green_imbalance", "lens_shading"])
def test_darks_fix_the_black_level_that_lit_frames_are_seen_against(mechanism):
    plan = design()
    scene = Shot("s", "scene", 0.01 + 0.5 * np.random.default_rng(1).random(SIZE), 4, 1.0)
    lit, dark = replace(plan, shots=(scene,)).exposed(), plan.exposed()[:1]
    alone = strength(mechanism, plan.camera, lit).amplitude_at(1.0)
    together = strength(mechanism, plan.camera, lit + dark).amplitude_at(1.0)
    assert together < alone
    assert mechanism != "nonlinearity" or together < 0.9 * alone


@pytest.mark.parametrize("reference", ["independent", "burst_mean"])
def test_what_no_recording_shows_has_no_strength(reference):
    camera = draw_camera(np.random.default_rng(0))
    flat = Shot("f", "flat", np.full(SIZE, 0.3), 4, 1.0)
    scene = Shot("s", "scene", 0.1 + 0.5 * np.random.default_rng(1).random(SIZE), 4, 1.0)
    sets = Design(camera, (flat, scene), reference, False, "no_darks").exposed()
    assert (reachable("nonlinearity", 1.0, camera, sets) is None) == (reference == "burst_mean")
    assert reachable("prnu", 1.0, camera, sets) is not None
    assert reachable("dark_current", 1.0, camera, sets[:1]) is None


@pytest.mark.parametrize("name", sorted({**LISTED, **UNLISTED}))
def test_every_effect_changes_frames_and_keeps_them_valid(name):
    plan = design()
    amplitude = {"missing_codes": 4, "quantization": 8, "saturation": 0.1, "black_clipping": -1.0}.get(
        name, 0.2
    )
    differs = False
    for shot in plan.shots:
        plain = expose(plan.camera, shot, (), np.random.default_rng(1))
        changed = expose(plan.camera, shot, (effect(name, amplitude),), np.random.default_rng(1))
        assert changed.dtype == np.uint16 and changed.shape == plain.shape
        differs |= bool(np.any(changed != plain))
    assert differs or name == "cosmic_rays"  # a track at this rate is rarer than one in all these frames


def test_frozen_patterns_belong_to_the_unit():
    plan = design()
    shot = replace(plan.shots[2], frames=40)

    def mean(unit, seed):
        camera = replace(plan.camera, unit=unit)
        return expose(camera, shot, (effect("dsnu", 40.0),), np.random.default_rng(seed)).mean(0).ravel()

    assert np.corrcoef(mean(1, 1), mean(1, 2))[0, 1] > 0.5
    assert abs(np.corrcoef(mean(1, 1), mean(2, 2))[0, 1]) < 0.1
