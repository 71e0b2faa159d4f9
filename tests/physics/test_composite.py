"""The composite score prefers the model that made the frames."""

import numpy as np

from cannoise_jax.physics.likelihood.composite import composite_score, profile, ruler


def test_composite_score_prefers_the_model_that_made_the_frames():
    rng = np.random.default_rng(1)
    mean = np.tile(np.linspace(100, 300, 48), (32, 1))
    sigma = np.sqrt(9 + (mean - 100) / 4)

    def draw(count, row=0.0, tail=0.0, missing=False):
        noise = rng.normal(size=(count, *mean.shape)) * np.where(
            rng.random((count, *mean.shape)) < tail, 3, 1
        )
        codes = np.round(mean + sigma * noise + row * rng.normal(size=(count, 32, 1)))
        return np.where(missing & (codes % 8 == 3), codes - 1, codes)

    by = ruler(mean, sigma)
    baseline = profile(draw(60), by)
    for part, more in (("means", {"row": 3.0}), ("marginal", {"tail": 0.05}), ("codes", {"missing": True})):
        observed = draw(20, **more)
        before = composite_score(baseline, observed, by)
        after = composite_score(profile(draw(60, **more), by), observed, by)
        error = np.std(after.per_frame - before.per_frame) / np.sqrt(20)
        assert after.total - before.total > 5 * error
        gains = {
            name: getattr(after, name) - getattr(before, name) for name in ("marginal", "codes", "means")
        }
        assert max(gains, key=gains.__getitem__) == part
    # Frames of the baseline itself score no better under a model with rows.
    observed = draw(20)
    wrong = composite_score(profile(draw(60, row=3.0), by), observed, by)
    assert composite_score(baseline, observed, by).total > wrong.total
