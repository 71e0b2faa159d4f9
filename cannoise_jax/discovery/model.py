"""The extended simulator: the fitted baseline and every finding as a `SensorModel`, named or from the
grammar."""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.battery import Prepared
from cannoise_jax.discovery.statistics.score import Score
from cannoise_jax.physics.grammar import Point
from cannoise_jax.physics.mechanism import Scaling
from cannoise_jax.physics.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet, per_channel

_DIRECT = {
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
}
"""Name of the simulator's parameter that carries the amplitude."""

_GRAMMAR = {
    "row_additive_temporal": Point("readout", "signal", "row", "redrawn"),
    "column_additive_temporal": Point("readout", "signal", "column", "redrawn"),
    "row_additive_static": Point("readout", "signal", "row", "frozen"),
    "column_additive_static": Point("readout", "signal", "column", "frozen"),
    "row_relative_static": Point("photons", "mean", "row", "frozen", "multiply"),
    "column_relative_static": Point("photons", "mean", "column", "frozen", "multiply"),
    "row_relative_temporal": Point("photons", "mean", "row", "redrawn", "multiply"),
    "column_relative_temporal": Point("photons", "mean", "column", "redrawn", "multiply"),
    "frame_additive": Point("readout", "signal", "whole", "redrawn"),
    "frame_relative": Point("photons", "mean", "whole", "redrawn", "multiply"),
    "pixel_additive_static": Point("readout", "signal", "pixel", "frozen"),
    "pixel_thermal_static": Point("readout", "signal", "pixel", "frozen"),
    "pixel_relative_static": Point("photons", "mean", "pixel", "frozen", "multiply"),
    "raster_slope": Point("readout", "signal", "raster", "redrawn", spectrum="power_law"),
    "row_slope": Point("readout", "signal", "row", "redrawn", spectrum="power_law"),
    "wave_redrawn": Point("readout", "signal", "raster", "redrawn", spectrum="sinusoid"),
    "wave_frozen": Point("readout", "signal", "raster", "frozen", spectrum="sinusoid"),
    "flicker": Point("photons", "mean", "row", "redrawn", "multiply", spectrum="sinusoid"),
    "step": Point("readout", "signal", "block", "frozen"),
    "telegraph": Point("readout", "signal", "pixel", "telegraph"),
    "hot_additive": Point("readout", "signal", "pixel", "frozen", distribution="sparse"),
    "hot_thermal": Point("readout", "signal", "pixel", "frozen", distribution="sparse"),
}
"""Where in the grammar a probe sits, for findings without a name."""


def extended_model(capture: CaptureSet, prepared: Prepared, found: list[tuple[str, Score]]) -> SensorModel:
    """The baseline of the recordings with every finding that can be simulated added, sorted along the
    chain."""
    first = capture.recordings[0]
    baselines = sorted(prepared.baselines, key=lambda b: b.iso or 0.0)
    gains = np.stack([np.maximum(b.gain, 1e-6) for b in baselines])
    reads = np.stack([b.read_dn for b in baselines]) / gains
    isos = tuple(b.iso if b.iso is not None else 100.0 for b in baselines)
    model = SensorModel.poisson_gaussian(
        gains,
        reads,
        per_channel(baselines[0].black),
        first.white_level,
        first.cfa,
        iso=isos,
        code_step=prepared.step,
        camera=capture.camera,
    )
    for mechanism, score in found:
        model = _add(model, mechanism, score, prepared)
    return model


def _add(model: SensorModel, mechanism: str, score: Score, prepared: Prepared) -> SensorModel:
    value = score.amplitude
    extra: dict[str, float] = {}
    point = None
    name = mechanism
    parameter = _DIRECT.get(mechanism)
    if mechanism == "unknown":
        point = _GRAMMAR.get(score.probe)
        if point is None:
            return model
        name = f"unknown_{score.probe}"
        parameter = "amplitude" if point.spectrum == "sinusoid" else "sigma"
        parameter += "" if point.combine == "multiply" else "_dn"
    elif mechanism == "dsnu" and score.probe == "pixel_thermal_static":
        return model.with_mechanism("dsnu", sigma_dn=value, scaling=_thermal(prepared))
    elif mechanism == "heavy_tails":
        return model.with_mechanism("heavy_tails", tukey_lambda=_lambda_of(value))
    elif mechanism in ("rts", "hot_pixels", "amp_glow", "saturation"):
        return _special(model, mechanism, score, prepared)
    if parameter is None:
        return model
    if "exponent" in score.parameters:
        extra["exponent"] = score.parameters["exponent"][0]
    if "frequency" in score.parameters:
        extra["frequency"] = abs(score.parameters["frequency"][0])
    if "frequency_x" in score.parameters:
        width = prepared.fields[0].mean.shape[1]
        fy, fx = score.parameters["frequency_y"][0], score.parameters["frequency_x"][0]
        extra["frequency"] = _raster_frequency(fy, fx, width)
    known: dict = {parameter: value, **extra}
    try:
        return model.with_mechanism(name, point=point, **known)
    except ValueError:
        return model.with_mechanism(name, point=point)


def _thermal(prepared: Prepared) -> Scaling:
    seconds = max(f.exposure_s or 0.0 for f in prepared.fields)
    return Scaling(exposure=1.0, reference_exposure_s=seconds)


def _raster_frequency(fy: float, fx: float, width: int) -> float:
    """Cycles per pixel of the scan whose aliases are the plane wave (fy, fx): f = fx + n / width
    nearest to fy."""
    turns = np.round(fx * width - fy)
    f = abs((turns + fy) / width)
    return float(min(f, 1 - f) if f <= 1 else f % 0.5)


def _lambda_of(kurtosis: float) -> float:
    """Shape of the Tukey lambda distribution with this excess kurtosis."""
    from scipy import optimize, stats

    def miss(shape: float) -> float:
        return float(stats.tukeylambda.stats(shape, moments="k")) - kurtosis

    return float(optimize.brentq(miss, -0.24, 0.13)) if miss(0.13) < 0 < miss(-0.24) else 0.0


def _special(model: SensorModel, mechanism: str, score: Score, prepared: Prepared) -> SensorModel:
    gain = float(np.mean(prepared.baselines[0].gain)) or 1.0
    seconds = max((f.exposure_s or 1.0) for f in prepared.fields)
    if mechanism == "rts":
        return model.with_mechanism(
            "rts", jump_dn=score.parameters["jump"][0], fraction=score.parameters["fraction"][0]
        )
    if mechanism == "hot_pixels":
        share = max(score.parameters["fraction"][0], 1e-7)
        return model.with_mechanism(
            "hot_pixels", e_per_s=score.amplitude / gain / seconds / np.sqrt(2 * share), fraction=share
        )
    if mechanism == "saturation":
        span = prepared.span
        return model.with_mechanism("saturation", full_well_e=score.amplitude * span / gain)
    g = score.payload[0]
    return model.with_mechanism("amp_glow", e_per_s=score.amplitude * float(g.max()) / gain / seconds)
