"""One call scores a model by the likelihood that its mechanisms declare, and prefers what made the data."""

from __future__ import annotations

import dataclasses
import warnings
import zlib

import jax
import numpy as np
import pytest

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.registry import MECHANISMS
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.likelihood.choice import (
    CodeStepWarning,
    compare,
    likelihood_of,
    likelihood_of_model,
    score,
)

SIZE = (24, 32)
SETTINGS = Settings(iso=100.0, exposure_s=0.5, frames=6)
BASE = SensorModel.poisson_gaussian(2.0, 4.0, (60, 61, 62, 63), 1060, "GRBG", unit_key=jax.random.key(5))
STRONG = {
    "gain_error": {"error": 0.5},
    "read_noise_error": {"error": 0.7},
    "dual_gain": {"iso_switch": 50.0, "read_ratio": 0.4},
    "prnu": {"sigma": 0.15},
    "column_gain": {"sigma": 0.15},
    "green_imbalance": {"sigma": 0.1},
    "dead_pixels": {"fraction": 0.1},
    "dark_current": {"e_per_s": 60.0},
    "amp_glow": {"e_per_s": 200.0, "length": 0.4},
    "hot_pixels": {"fraction": 0.1, "e_per_s": 100.0},
    "clock_induced_charge": {"charge_e": 10.0},
    "heavy_tails": {"tukey_lambda": -0.3},
    "poisson_skew": {"strength": 0.0},
    "saturation": {"full_well_e": 100.0},
    "nonlinearity": {"loss": 0.4},
    "reference_error": {"sigma_dn": 15.0, "scale": 0.1},
    "misregistration": {"shift_px": 6.0},
    "bookkeeping": {"black_dn": 6.0, "white_error": -0.1},
    "black_clipping": {"level_dn": 2.0},
    "quantization": {"step_dn": 8.0},
    "illumination_drift": {"sigma": 0.1},
    "offset_drift": {"sigma_dn": 4.0},
    "row_noise": {"sigma_dn": 6.0},
    "lens_shading": {"sigma": 0.3},
}
OTHERS = {"pixel_read_noise_map": {"spread": 0.8}, "channel_offset": {"sigma_dn": 5.0}}
# One for each way in which a mechanism enters the likelihood; the others take the same ways, or that of
# crossed terms, which takes long to compile.
FAST = (
    "gain_error", "prnu", "dsnu", "column_fpn", "bookkeeping", "black_clipping", "quantization",
    "pixel_read_noise_map", "heavy_tails", "row_noise", "nonlinearity",
)  # fmt: skip
SCORED = [
    pytest.param(id, marks=() if id in FAST else pytest.mark.slow)
    for id, m in MECHANISMS.items()
    if m.likelihood != "none"
]


def scene() -> np.ndarray:
    y, x = np.indices(SIZE)
    return (0.09 + 0.25 * x / SIZE[1] + 0.1 * np.sin(y / 3.0) ** 2).astype(np.float32)


def with_it(id: str) -> SensorModel:
    parameters = STRONG.get(id, OTHERS.get(id))
    if parameters is None:
        parameters = {p.name: 6.0 for p in MECHANISMS[id].parameters if p.name.endswith("_dn")}
    return BASE.with_mechanism(id, **parameters)


def taken(model: SensorModel, clean: np.ndarray, seed: int = 0, frames: int = 6) -> np.ndarray:
    key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(repr(model.mechanisms[:1]).encode()) % 1000)
    return np.asarray(model.sample(key, clean, dataclasses.replace(SETTINGS, frames=frames)), np.float32)


@pytest.mark.parametrize("id", SCORED)
def test_every_declared_likelihood_prefers_what_made_the_data(id):
    clean = scene() * np.float32(0.03 if id in ("black_clipping", "heavy_tails", "dual_gain") else 1.0)
    count = 60 if id == "poisson_skew" else 6
    clean = clean * np.float32(0.2 if id == "poisson_skew" else 1.0)  # few photons are skewed
    after = with_it(id)
    assert likelihood_of_model(after) == MECHANISMS[id].likelihood
    frames = taken(after, clean, frames=count)
    plain, right = compare(BASE, after, frames, clean, SETTINGS, jax.random.key(1))
    assert right.kind == plain.kind == MECHANISMS[id].likelihood
    assert right.total == pytest.approx(right.per_frame.mean()) and right.per_frame.shape == (count,)
    assert np.isfinite(right.per_frame).all()
    assert (right.total - plain.total) * frames.size > 10  # odds of e^10


@pytest.mark.slow
def test_crossed_and_grouped_offsets_are_integrated():
    pairs = Point("readout", "signal", "row", "redrawn", group=2, phase=1)
    full = BASE.with_mechanism("column_noise", sigma_dn=5.0).with_mechanism("offset_drift", sigma_dn=4.0)
    full = full.with_mechanism("pairs", point=pairs, sigma_dn=6.0).with_mechanism("dsnu", sigma_dn=5.0)
    assert likelihood_of_model(full) == "approximate"
    clean = scene()
    frames = taken(full, clean)
    right = score(full, frames, clean, SETTINGS, jax.random.key(0))
    white = full.without("pairs").with_mechanism("row_noise", sigma_dn=6.0)
    for other in (full.without("dsnu"), white):
        lower = score(other, frames, clean, SETTINGS, jax.random.key(0))
        assert (right.total - lower.total) * frames.size > 10


def test_the_weakest_member_decides():
    assert likelihood_of([]) == likelihood_of(["prnu", "gain_error"]) == "exact"
    for id in ("heavy_tails", "poisson_skew", "row_noise", "nonlinearity"):
        assert likelihood_of(["prnu", id]) == "approximate"
    assert likelihood_of(["row_noise", "missing_codes"]) == "none"
    with pytest.raises(ValueError, match="gremlins"):
        likelihood_of(["gremlins"])
    frames = np.zeros((1, *SIZE))
    with pytest.raises(ValueError, match="cannot be scored as exact"):
        score(with_it("row_noise"), frames, scene(), SETTINGS, jax.random.key(0), kind="exact")


def test_a_coarser_lattice_than_the_model_has_is_said_once():
    fine = SensorModel.poisson_gaussian(2.0, 40.0, 640, 65535)
    coarse, quantized = dataclasses.replace(fine, code_step=np.float32(16)), with_it("quantization")
    clean = np.zeros(SIZE, np.float32)
    frames = np.asarray(coarse.sample(jax.random.key(1), clean, SETTINGS), np.float32)
    with pytest.warns(CodeStepWarning, match="16 DN apart, the model's 1: .* code_step=16") as said:
        lost = score(fine, frames, clean, SETTINGS, jax.random.key(0)).total
    assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error", CodeStepWarning)
        right = score(coarse, frames, clean, SETTINGS, jax.random.key(0)).total
        # That the codes are coarser may be what the second model says.
        compare(BASE, quantized, taken(quantized, scene()), scene(), SETTINGS, jax.random.key(0))
    assert right - lost == pytest.approx(np.log(16), abs=0.02)


def test_without_a_likelihood_one_composite_score_serves_both_models():
    before = SensorModel.poisson_gaussian(1.0, 5.0, 200, 4095)
    after = before.with_mechanism("missing_codes", period=8.0)
    clean = np.full((32, 48), 0.1, np.float32)
    frames = np.asarray(after.sample(jax.random.key(0), clean, Settings(frames=8)))
    plain, comb = compare(before, after, frames, clean, Settings(), jax.random.key(1))
    assert plain.kind == comb.kind == "none"
    # One code in eight is moved onto its neighbour, which the flat histogram pays for with log(8/7) and more.
    assert comb.total - plain.total > 0.1
    exact = score(before, frames, clean, Settings(), jax.random.key(1))
    assert exact.kind == "exact" and exact.total != plain.total
    named = dataclasses.replace(after, mechanisms=())
    assert score(named, frames, clean, Settings(), jax.random.key(1)).total == pytest.approx(exact.total)
