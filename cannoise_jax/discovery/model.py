"""The extended simulator: the baseline and every finding as a `SensorModel`, named or from the grammar.

Everything comes from the frames that looked for effects, so that the frames that prove it have had no part
in it: strengths, measured maps of frozen patterns, and the noise of the baseline, which was fitted with the
effects in it and is lowered by what they now add.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from scipy import optimize, stats

from cannoise_jax.discovery.balance import balanced
from cannoise_jax.discovery.battery import Prepared
from cannoise_jax.discovery.fit import Step
from cannoise_jax.discovery.frozen import frozen_map, noise_factors
from cannoise_jax.discovery.grammar_points import POINTS, grammar_maps, point_of, with_found
from cannoise_jax.discovery.statistics.score import Score
from cannoise_jax.physics.core.mechanism import Scaling
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet, per_channel

STRENGTHS = {
    "row_noise": "sigma_dn",
    "column_noise": "sigma_dn",
    "row_fpn": "sigma_dn",
    "column_fpn": "sigma_dn",
    "dsnu": "sigma_dn",
    "prnu": "sigma",
    "column_gain": "sigma",
    "offset_drift": "sigma_dn",
    "illumination_drift": "sigma",
    "pink_noise": "sigma_dn",
    "row_pink_noise": "sigma_dn",
    "banding": "amplitude_dn",
    "flicker": "amplitude",
    "crosstalk": "fraction",
    "in_camera_denoising": "weight",
    "nonlinearity": "loss",
    "missing_codes": "period",
    "quantization": "step_dn",
    "dark_current": "e_per_s",
    "amplifier_mismatch": "step_dn",
    "green_imbalance": "sigma",
    "channel_offset": "sigma_dn",
    "black_clipping": "level_dn",
    "brighter_fatter": "a00",
    "demosaicing": "weight",
    "pixel_read_noise_map": "spread",
    "lens_shading": "sigma",
}
"""Name of the simulator's parameter that carries the amplitude."""

_SIGNED = {"nonlinearity": "curvature", "lens_shading": "corner_loss", "amplifier_mismatch": None}
"""Mechanisms whose parameter has a sign, and where the score keeps it."""


def baseline_model(capture: CaptureSet, prepared: Prepared, stated: tuple | None = None) -> SensorModel:
    """The fitted Poisson-Gaussian baseline of the recordings; with gain and read noise (DN) as `stated` per
    gain setting where given."""
    first = capture.recordings[0]
    order = np.argsort([prepared.isos[b.iso] for b in prepared.baselines])
    gains, reads = [], []
    for n in order:
        baseline = prepared.baselines[n]
        gain, read = stated[n] if stated is not None and stated[n][0] is not None else (None, None)
        gains.append(np.maximum(baseline.gain if gain is None else gain, 1e-6))
        reads.append((baseline.read_dn if read is None else read) / gains[-1])
    baselines = [prepared.baselines[n] for n in order]
    return SensorModel.poisson_gaussian(
        np.stack(gains),
        np.stack(reads),
        per_channel(baselines[0].black),
        min(first.white_level, 65535.0),  # a wrong one may lie above every code
        first.cfa,
        iso=tuple(prepared.isos[b.iso] for b in baselines),
        code_step=prepared.step,
        camera=capture.camera,
    )


def extended_model(
    capture: CaptureSet,
    prepared: Prepared,
    steps: tuple[Step, ...],
    start: SensorModel | None = None,
    seed: int = 0,
) -> SensorModel:
    """The baseline of the recordings with every finding that can be simulated added, sorted along the chain.

    steps: the accepted findings. start: the camera model that was judged; what was found is added to it.
    seed: of the part of frozen maps that the frames leave open. Capture and bookkeeping errors are not the
    camera's: they are not in the model.
    """
    bare = baseline_model(capture, prepared)
    model = bare if start is None else start
    if not steps:
        return model
    rng = np.random.default_rng(seed)
    if any(s.named.mechanism == "bookkeeping" for s in steps):
        model = dataclasses.replace(model, black_level=bare.black_level)
    for step in steps:
        model = _add(model, step, prepared, rng)
    matched = start is None or np.size(model.iso) == np.size(bare.iso)
    return balanced(bare, model, prepared) if matched else model


def _add(model: SensorModel, step: Step, prepared: Prepared, rng: np.random.Generator) -> SensorModel:
    mechanism, score, fields = step.named.mechanism, step.named.score, step.before
    probe = step.named.probe.name
    field = frozen_map(probe, score, prepared, fields, rng)
    if mechanism == "unknown":
        return _add_unknown(model, probe, score, prepared, field)
    gain = float(np.mean(prepared.baselines[0].gain)) or 1.0
    seconds = max((f.exposure_s or 1.0) for f in prepared.fields)
    value = score.amplitude
    if mechanism in _SIGNED and _SIGNED[mechanism] in score.parameters:
        value = score.parameters[str(_SIGNED[mechanism])][0]
    if mechanism == "heavy_tails":
        return with_found(model, "heavy_tails", tukey_lambda=_lambda_of(value))
    if mechanism == "pixel_read_noise_map":
        factor = noise_factors(fields, value, rng)
        return with_found(model, mechanism, spread=value, maps={"factor": _map(factor)})
    if mechanism == "rts":
        jump, share = score.parameters["jump"][0], score.parameters["fraction"][0]
        sites = {"sites": _map(field / (jump / 2))} if field is not None else {}
        return with_found(model, "rts", jump_dn=jump, fraction=share, rate=0.5, maps=sites)
    if mechanism == "hot_pixels":
        heat = np.zeros(fields[0].mean.shape) if field is None else field
        return _hot(model, heat / gain / seconds, probe, score, seconds)
    if mechanism == "missing_codes" and (score.parameters["shortfall"][0] < 0.7 or value % 1):
        return model  # codes that are only rarer, or doubled: the camera model knows of none
    if mechanism == "saturation":
        return with_found(model, "saturation", full_well_e=value * prepared.span / gain)
    if mechanism == "amp_glow" and field is not None:
        peak = float(field.max())
        strength = value * peak / gain / seconds
        return with_found(model, "amp_glow", e_per_s=strength, maps={"glow": _map(field / peak)})
    if mechanism == "channel_offset" and field is not None:
        black = per_channel(np.asarray(model.black_level) - np.asarray(score.payload))
        model = dataclasses.replace(model, black_level=np.asarray(black, np.float32))
        rms = float(np.sqrt(np.mean(field**2)))
        return with_found(model, mechanism, sigma_dn=rms, maps={"field": _map(field / rms)})
    parameter = STRENGTHS.get(mechanism)
    if parameter is None:
        return model
    known: dict = {parameter: value, **_shape_of(score, fields[0].mean.shape[1])}
    if probe == "wave_frozen":
        point = POINTS[probe]
        maps = {} if field is None else {"field": _map(field)}
        return with_found(model, mechanism, point=point, maps=maps, **known)
    scaling = _thermal(prepared) if probe.endswith("_thermal_static") else None
    maps = {}
    if field is not None:
        unit = 1.0 if mechanism in ("amplifier_mismatch", "green_imbalance") else max(value, 1e-12)
        maps = {"field": _map(field / unit)}
    return with_found(model, mechanism, scaling=scaling, maps=maps, **known)


def _add_unknown(
    model: SensorModel, probe: str, score: Score, prepared: Prepared, field: np.ndarray | None
) -> SensorModel:
    """A finding without a name at its place in the grammar; the model as it was where the grammar has
    none."""
    point = point_of(probe, score, prepared.fields[0].mean.shape)
    if point is None:
        return model
    strength, maps = grammar_maps(probe, score, prepared, field)
    parameter = "amplitude" if point.spectrum == "sinusoid" else "sigma"
    if point.combine == "add":
        parameter += "_e" if point.acts_on == "mean" else "_dn"
    known = {parameter: strength, **_shape_of(score, prepared.fields[0].mean.shape[1])}
    if point.time == "telegraph":
        known["rate"] = 0.5
    if point.distribution == "tukey_lambda":
        # The field carries most of the read noise, whose Gaussian part is lowered to make room.
        share = 0.9
        known[parameter] = share * float(np.mean(prepared.baselines[0].read_dn))
        known["tukey_lambda"] = _lambda_of(float(score.parameters["excess_kurtosis"][0]) / share**4)
    thermal = probe.endswith("thermal_static") or probe in ("hot_thermal", "glow", "dark_level")
    return with_found(
        model,
        f"unknown_{probe}",
        point=point,
        scaling=_thermal(prepared) if thermal else None,
        maps={name: jnp.asarray(m, jnp.float32) for name, m in maps.items()},
        **known,
    )


def _map(values: np.ndarray):
    """As the chain stores a map: `[1, H, W]`, lines as `[1, H, 1]` or `[1, 1, W]`."""
    values = np.asarray(values, np.float32)
    return jnp.asarray(values.reshape((1,) * (3 - values.ndim) + values.shape))


def _shape_of(score: Score, width: int) -> dict[str, float]:
    """Exponent or frequency of a spectrum, by the grammar's names."""
    out = {}
    if "exponent" in score.parameters:
        out["exponent"] = score.parameters["exponent"][0]
    if "frequency" in score.parameters:
        out["frequency"] = abs(score.parameters["frequency"][0])
    if "frequency_x" in score.parameters:
        fy, fx = score.parameters["frequency_y"][0], score.parameters["frequency_x"][0]
        out["frequency"] = _raster_frequency(fy, fx, width)
    return out


def _thermal(prepared: Prepared) -> Scaling:
    seconds = max(f.exposure_s or 0.0 for f in prepared.fields)
    return Scaling(exposure=1.0, reference_exposure_s=seconds or 1.0)


def _raster_frequency(fy: float, fx: float, width: int) -> float:
    """Cycles per pixel of the scan whose aliases are the plane wave (fy, fx): f = fx + n / width
    nearest to fy."""
    turns = np.round(fx * width - fy)
    f = abs((turns + fy) / width)
    return float(min(f, 1 - f) if f <= 1 else f % 0.5)


def _lambda_of(kurtosis: float) -> float:
    """Shape of the Tukey lambda distribution with this excess kurtosis."""

    def miss(shape: float) -> float:
        return float(stats.tukeylambda.stats(shape, moments="k")) - kurtosis

    return float(optimize.brentq(miss, -0.24, 1.0)) if miss(1.0) < 0 < miss(-0.24) else 0.0


def _hot(model: SensorModel, heat: np.ndarray, probe: str, score: Score, seconds: float) -> SensorModel:
    """Hot pixels at their places, e-/s; what does not grow with the exposure is an offset map."""
    share = float(np.clip(np.mean(heat > 0), 1e-7, 0.5))
    mean = float(heat.sum() / max((heat > 0).sum(), 1)) or 1e-6
    scaling = None if probe == "hot_thermal" else Scaling(reference_exposure_s=seconds)
    strength = mean if scaling is None else mean * seconds
    return with_found(
        model,
        "hot_pixels",
        e_per_s=strength,
        fraction=share,
        scaling=scaling,
        maps={"heat": _map(heat / mean)},
    )
