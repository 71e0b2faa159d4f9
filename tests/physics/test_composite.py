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
    parts = ("log_bins", "log_codes", "mean_squares")
    for part, more in zip(parts, ({"tail": 0.05}, {"missing": True}, {"row": 3.0}), strict=True):
        observed, model = draw(20, **more), profile(draw(60, **more), by)
        before = composite_score(baseline, observed, by)
        after = composite_score(model, observed, by)
        error = np.std(after.per_frame - before.per_frame) / np.sqrt(20)
        assert after.total - before.total > 5 * error
        alone = {p: baseline._replace(**{p: getattr(model, p)}) for p in parts}
        gains = {p: composite_score(m, observed, by).total - before.total for p, m in alone.items()}
        assert max(gains, key=gains.__getitem__) == part
    # Frames of the baseline itself score no better under a model with rows.
    observed = draw(20)
    wrong = composite_score(profile(draw(60, row=3.0), by), observed, by)
    assert composite_score(baseline, observed, by).total > wrong.total
