"""Where in the grammar each probe sits, for findings without a name, and with what strength and map."""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.battery import Prepared
from cannoise_jax.discovery.statistics.score import Score
from cannoise_jax.physics.core import registry
from cannoise_jax.physics.core.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.core.ranges import clipped
from cannoise_jax.physics.core.sensor import SensorModel

_OFFSETS = Point("readout", "signal", "pixel", "frozen")
_GAINS = Point("photons", "mean", "pixel", "frozen", "multiply")

POINTS = {
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
    "site_relative_redrawn": Point("photons", "mean", "channel", "redrawn", "multiply"),
    "pixel_additive_static": _OFFSETS,
    "pixel_thermal_static": _OFFSETS,
    "pixel_relative_static": _GAINS,
    "raster_slope": Point("readout", "signal", "raster", "redrawn", spectrum="power_law"),
    "row_slope": Point("readout", "signal", "row", "redrawn", spectrum="power_law"),
    "wave_redrawn": Point("readout", "signal", "raster", "redrawn", spectrum="sinusoid"),
    "wave_frozen": Point("readout", "signal", "raster", "frozen", spectrum="sinusoid"),
    "flicker": Point("photons", "mean", "row", "redrawn", "multiply", spectrum="sinusoid"),
    "step": _OFFSETS,
    "taps": _OFFSETS,
    "glow": _OFFSETS,
    "black_channels": Point("readout", "signal", "channel", "frozen"),
    "greens": Point("photons", "mean", "channel", "frozen", "multiply"),
    "curvature": Point("photons", "mean", "pixel", "frozen", "multiply", signal=1.0),
    "telegraph": Point("readout", "signal", "pixel", "telegraph"),
    "pixel_spread": Point("readout", "signal", "pixel", "telegraph"),
    "hot_additive": _OFFSETS,
    "hot_thermal": _OFFSETS,
    "light_tails": Point("readout", "signal", "pixel", "redrawn", distribution="tukey_lambda"),
    "kurtosis": Point("readout", "signal", "pixel", "redrawn", distribution="tukey_lambda"),
}
"""A sparse frozen pattern is an offset map with zeros; noisy pixels blink about their level."""


def point_of(probe: str, score: Score, size: tuple[int, int]) -> Point | None:
    """Where in the grammar a probe's finding sits; None where the grammar has no place for it."""
    name, _, time = probe.rpartition("_")
    if probe == "lags_any":
        kernel = neighbour_kernel(score.where["lags"], score.where["correlations"])[0]
        return Point("readout", "signal", "pixel", "redrawn", spectrum="kernel", kernel=kernel)
    if name.startswith("tile_"):
        side = int(name.removeprefix("tile_"))
        blocks = (-(-size[0] // side), -(-size[1] // side))
        return Point("readout", "signal", "block", time, blocks=blocks)  # type: ignore[arg-type]
    if name in ("diagonal", "antidiagonal"):
        return Point("readout", "signal", name, time)  # type: ignore[arg-type]
    if name in ("site", "row_parity", "column_parity"):
        return Point("readout", "signal", "channel", time)  # type: ignore[arg-type]
    return POINTS.get(probe)


def neighbour_kernel(lags, correlations, reach: int = 4) -> tuple[tuple[float, ...], float]:
    """The filter, of norm 1, that gives white noise these correlations at these lags (dy, dx) when it is a
    part of the noise, and that share of the variance: the least that leaves no frequency with less than
    nothing."""
    side = 32
    covariance = np.zeros((side, side))
    for (dy, dx), value in zip(lags, correlations, strict=True):
        covariance[dy % side, dx % side] = covariance[-dy % side, -dx % side] = value
    spectrum = np.real(np.fft.fft2(covariance))
    share = float(np.clip(-spectrum.min(), 1e-6, 0.9))
    root = np.real(np.fft.ifft2(np.sqrt(np.maximum(spectrum + share, 0))))
    window = np.roll(root, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    return tuple((window / np.linalg.norm(window)).round(6).ravel().tolist()), share


def grammar_maps(
    probe: str, score: Score, prepared: Prepared, field: np.ndarray | None
) -> tuple[float, dict[str, np.ndarray]]:
    """Strength of a point and its measured map, which together give the pattern that was found.

    field: the measured pattern in DN or fractions (`frozen.frozen_map`); None: the point draws its own.
    """
    value = float(score.amplitude)
    if probe == "lags_any":
        share = neighbour_kernel(score.where["lags"], score.where["correlations"])[1]
        return float(np.sqrt(share) * np.mean(prepared.baselines[0].read_dn)), {}
    if probe == "curvature":
        loss = score.parameters["curvature"][0]
        return abs(loss), {"field": np.full((1, *prepared.fields[0].mean.shape), -np.sign(loss))}
    if probe == "wave_frozen":
        return value, {} if field is None else {"field": field[None]}
    if field is None:
        return value, {}
    if probe in ("step", "taps", "glow", "greens"):  # these maps are per unit of the amplitude
        field = field * value
    if field.ndim == 2 and probe in ("step",):
        field = np.broadcast_to(field, prepared.fields[0].mean.shape)
    rms = float(np.sqrt(np.mean(np.asarray(field) ** 2))) or 1.0
    return rms, {"field": np.asarray(field / rms)[None]}


def with_found(model: SensorModel, id: str, *, point: Point | None = None, scaling=None, maps=None, **found):
    """The model with one more mechanism, its measured strengths moved into the ranges that it can have; the
    model as it was where one of them is no number."""
    record = registry.mechanism(id) if point is None else mechanism_from_grammar(point, id=id)
    values: dict = clipped(record, found)
    if not np.isfinite(list(values.values())).all():
        return model
    return model.with_mechanism(id, point=point, scaling=scaling, maps=maps, **values)
