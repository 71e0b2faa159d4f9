"""Mechanisms together: each acts on what the earlier ones leave, in the closed form as in the draws."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core import chain
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import context_of, resolve

SIZE, FRAMES = (12, 16), 1200
SETTINGS = Settings(exposure_s=1.0, frames=FRAMES)
BASE = SensorModel.poisson_gaussian(2.0, 4.0, 64, 16383, "MONO", unit_key=jax.random.key(3))
INSIDE = (slice(4, -4), slice(4, -4))  # at the edge a pixel stands in for its missing neighbour
PAIRS = {
    "saturation": {"saturation": {"full_well_e": 1000.0}},
    "full at the mean": {"saturation": {"full_well_e": 1632.0}},
    "nonlinearity": {"nonlinearity": {"loss": 0.4}},
    "dark + saturation": {"dark_current": {"e_per_s": 200.0}, "saturation": {"full_well_e": 1000.0}},
    "dark + nonlinearity": {"dark_current": {"e_per_s": 1500.0}, "nonlinearity": {"loss": 0.4}},
    "prnu + saturation": {"prnu": {"sigma": 0.05}, "saturation": {"full_well_e": 1650.0}},
    "prnu + dsnu + dark": {
        "prnu": {"sigma": 0.2}, "dsnu": {"sigma_dn": 30.0}, "dark_current": {"e_per_s": 300.0},
    },
    "offsets + nonlinearity": {"channel_offset": {"sigma_dn": 50.0}, "nonlinearity": {"loss": 0.3}},
    "saturation + nonlinearity": {"saturation": {"full_well_e": 1500.0}, "nonlinearity": {"loss": 0.4}},
    "stretch + saturation": {"bookkeeping": {"white_error": 0.5}, "saturation": {"full_well_e": 1500.0}},
    "stretch + row": {"bookkeeping": {"white_error": 0.5}, "row_noise": {"sigma_dn": 40.0}},
    "row + denoising": {"row_noise": {"sigma_dn": 40.0}, "in_camera_denoising": {"weight": 0.6}},
    "light + nonlinearity": {"illumination_drift": {"sigma": 0.03}, "nonlinearity": {"loss": 0.4}},
    "light + dark": {"illumination_drift": {"sigma": 0.03}, "dark_current": {"e_per_s": 1500.0}},
    "clip + row": {"row_noise": {"sigma_dn": 40.0}, "black_clipping": {"level_dn": 3260.0}},
}  # fmt: skip


def model_of(name: str) -> SensorModel:
    model = BASE
    for id, parameters in PAIRS[name].items():
        model = model.with_mechanism(id, **parameters)
    return model


def drawn(model: SensorModel, clean: np.ndarray) -> np.ndarray:
    """Frames, eagerly: compiling every chain takes longer; unrounded but where codes are acted on."""
    context = context_of(model, jnp.asarray(clean)[None], SETTINGS)
    values = resolve(model, context)
    key = jax.random.key(11)
    y, step = chain.run_chain(model, key, context, values, FRAMES)
    if any(f.record.acts_on == "code" for f in model.mechanisms):
        y = chain.to_codes(model, key, y, step, context, values)
    return np.asarray(y, np.float64)


BY_DEFAULT = (
    "full at the mean",
    "nonlinearity",
    "prnu + saturation",
    "dark + nonlinearity",
    "row + denoising",
    "prnu + dsnu + dark",
    "stretch + row",
)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in BY_DEFAULT else pytest.mark.slow) for n in PAIRS]
)
def test_closed_form_of_a_composition_is_what_is_drawn(name):
    model, clean = model_of(name), np.full(SIZE, 0.2, np.float32)
    context = context_of(model, jnp.asarray(clean)[None], SETTINGS)
    mean, variance = (np.asarray(v)[0] for v in chain.closed_form(model, context, resolve(model, context)))
    y = drawn(model, clean)
    total = np.broadcast_to(variance, SIZE)[INSIDE]
    found = y.var(axis=0)[INSIDE]
    # Light moves all pixels of a frame: its mean is known to one part in the root of the frames.
    error = np.sqrt(total / FRAMES)
    assert (np.abs(y.mean(axis=0)[INSIDE] - mean[INSIDE]) < 5 * error + 0.5).all()
    assert found.mean() == pytest.approx(total.mean(), rel=0.18 if "light" in name else 0.04)
    if "light" not in name:
        assert np.abs(found / total - 1).max() < 0.3


@pytest.mark.parametrize(
    "name", [{"crosstalk": {"fraction": 0.01}}, {"demosaicing": {"weight": 0.05}}, {"saturation": {}}]
)
def test_noise_without_read_noise_left_passes_a_clamp_to_its_neighbours(name):
    """Where what comes before leaves less than the shot noise, the root of what is left has no slope."""
    model = BASE
    for id, parameters in {**name, "hot_pixel_suppression": {"weight": 0.2}}.items():
        model = model.with_mechanism(id, **parameters)
    context = context_of(model, jnp.full((1, *SIZE), 0.4), SETTINGS)
    mean, variance = chain.closed_form(model, context, resolve(model, context))
    assert np.isfinite(mean).all() and (np.asarray(variance) > 0).all()
