"""What the EMVA 1288 sheet of a camera shows, as plain numbers: its table, and the points of its figures.

Symbols and definitions follow EMVA 1288 release 4.0; whatever needs the number of photons stays in electrons,
and what the recordings do not show says what to record.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable, Outcome
from cannoise_jax.physics.transfer.fit import robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.full_well import full_signal
from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer, channels_of, of_all_pixels
from cannoise_jax.physics.transfer.table import format_outcome
from cannoise_jax.physics.transfer.views import pixel_variance, with_all_sites
from cannoise_jax.recordings.packing import ALL, site
from cannoise_jax.recordings.recording import DARK, per_channel

Channels = Sequence[int]
"""Those that are shown: the mosaic's sites, or `ALL` of a sensor without colours."""
_RANGE = (0.05, 0.95)
"""Share of saturation between which linearity is judged (EMVA 1288, section 6.7)."""
_OTHER_LIGHT = 10.0
"""Mean deviation, %, from which flats are not of one light rather than of a bent response."""
_STEADY = NotMeasurable(
    "record flats of one steady light at three exposure times or more, below 95 % of saturation"
)
_NOISE = "temporal dark noise, rows included"
_ROWS = (
    ("system gain", "DN/e-", "K, overall system gain"),
    ("inverse gain", "e-/DN", "1/K, inverse of the gain"),
    ("temporal dark noise, as recorded", "DN", "sigma_y.dark, temporal dark noise, quantisation included"),
    (_NOISE, "DN", "temporal dark noise without quantisation"),
    (_NOISE, "e-", "sigma_d, temporal dark noise without quantisation"),
    ("sensitivity threshold", "e-", "mu_e.min, absolute sensitivity threshold"),
    ("saturation level", "e-", "mu_e.sat, saturation capacity"),
    ("SNR max", "", "SNR max, as a ratio"),
    ("SNR max", "dB", "SNR max"),
    ("dynamic range", "dB", "DR, dynamic range"),
    ("DSNU1288", "e-", "DSNU1288, dark signal nonuniformity"),
    ("PRNU1288", "%", "PRNU1288, photo response nonuniformity"),
    ("linearity error", "%", "LE, linearity error"),
    ("dark current, by mean", "e-/s", "mu_c.mean, dark current"),
    ("dark current, by variance", "e-/s", "mu_c.var, dark current"),
    ("quantum efficiency", "e-/photon", "eta, quantum efficiency"),
)


def sheet_data(transfers: Sequence[PhotonTransfer]) -> list[dict[str, Any]]:
    """For each ISO: the table, outcome by channel, and the points of every figure, plain numbers."""
    return [_setting(t) for t in transfers]


def _setting(t: PhotonTransfer) -> dict[str, Any]:
    t = of_all_pixels(t)
    statistics, names = t.statistics, channels_of(t)
    first = statistics[0].recording
    base = t.baseline if isinstance(t.baseline, Baseline) else None
    # Without a baseline the level of the darks, where there are any, is still better than what was stated.
    black: tuple[float, ...] = per_channel(base.black_level) if base else first.black_level
    channels: Channels = range(4)
    if len(names) == 1:
        statistics, channels = tuple(map(with_all_sites, statistics)), (ALL,)
        black = (*black, float(np.mean(black)))
    lit = [s for s in statistics if s.recording.kind == "flat"]
    lit = lit or [s for s in statistics if s.recording.kind == "scene"]
    dark = [s for s in statistics if s.recording.kind in DARK]
    points = _points(lit, black, channels)
    straight = _linearity(lit, black, first.white_level, channels)
    return {
        "iso": t.iso,
        "gain_db": first.gain_db,
        "channels": list(names),
        "size": list(first.size),
        "cfa": t.cfa,
        "recordings": sorted((_recording(s, channels) for s in statistics), key=_order),
        "table": _table(t, straight, len(names)),
        "gain": base.gain[: len(names)].tolist() if base else None,
        "read_noise_dn": base.read_noise[: len(names)].tolist() if base else None,
        "transfer": points,
        "linearity": straight,
        "dark": _dark_points(dark, channels),
        "spectra": _spectra(lit, dark, black, first.white_level, channels),
    }


def _recording(s: FrameStatistics, channels: Channels) -> dict[str, Any]:
    r = s.recording
    return {
        "kind": r.kind,
        "frames": r.count,
        "exposure_s": r.exposure_s,
        "temperature_c": r.temperature_c,
        "level_dn": [float(s.level[c]) for c in channels],
    }


def _order(recording: dict[str, Any]) -> tuple[str, bool, float, float]:
    seconds = recording["exposure_s"]
    return recording["kind"], seconds is None, seconds or 0.0, max(recording["level_dn"])


def _points(
    lit: Sequence[FrameStatistics], black: Sequence[float], channels: Channels
) -> dict[str, list[list[float]]]:
    """Mean above black and temporal variance of every lit recording, DN and DN^2, by channel."""
    mean: list[list[float]] = [[] for _ in channels]
    variance: list[list[float]] = [[] for _ in channels]
    for s in (s for s in lit if s.variance is not None):
        for at, c in enumerate(channels):
            usable = ~site(s.clipped, c)
            if not usable.any():
                continue
            square, _ = robust_mean_square(pixel_variance(s, c)[usable], s.dof)
            mean[at].append(float(site(s.mean, c)[usable].mean() - black[c]))
            variance[at].append(float(square))
    return {"mean": mean, "variance": variance}


def _linearity(
    lit: Sequence[FrameStatistics], black: Sequence[float], white: float, channels: Channels
) -> dict[str, Any] | None:
    """Signal over exposure of flats under one light, with a line of least relative deviations, by channel;
    None for fewer than three exposures, and for flats that lie far off any line. error: mean absolute
    deviation, %, between `_RANGE` of saturation; None, as are the points of its line, of a channel that has
    fewer than three exposures below that."""
    flats = [s for s in lit if s.recording.kind == "flat" and s.recording.exposure_s]
    if len({s.recording.exposure_s for s in flats}) < 3:
        return None
    seconds = np.array([s.recording.exposure_s for s in flats], float)
    out: dict[str, Any] = {"seconds": seconds.tolist(), "signal": [], "fit": [], "deviation": [], "error": []}
    for c in channels:
        signal = np.array([s.frame_means[:, c].mean() - black[c] for s in flats])
        # Saturation is where codes pile up or pixels are full, which may be below the white level.
        ends = (s.high[c] for s in flats if np.isfinite(s.high[c]))
        top = min([white, full_signal(flats, c), *ends]) - black[c]
        judged = (signal > _RANGE[0] * top) & (signal < _RANGE[1] * top)
        judged = judged if judged.sum() >= 3 else (signal > 0) & (signal < _RANGE[1] * top)
        out["signal"].append(signal.tolist())
        if len(set(seconds[judged])) < 3:
            out["deviation"].append([None] * len(seconds))
            out["fit"].append(None)
            out["error"].append(None)
            continue
        design = np.stack([np.ones_like(seconds), seconds], -1)[judged] / signal[judged, None]
        line = np.linalg.lstsq(design, np.ones(judged.sum()), rcond=None)[0]
        fitted = line[0] + line[1] * seconds
        deviation = 100 * (signal - fitted) / np.where(fitted == 0, np.nan, fitted)
        shown = np.where(judged, deviation, np.nan)
        out["deviation"].append([float(v) if np.isfinite(v) else None for v in shown])
        out["fit"].append([float(v) for v in line])
        out["error"].append(float(np.nanmean(np.abs(deviation[judged]))))
    told = [error for error in out["error"] if error is not None]
    return out if told and max(told) < _OTHER_LIGHT else None


def _dark_points(dark: Sequence[FrameStatistics], channels: Channels) -> dict[str, Any]:
    known = sorted(
        (s for s in dark if s.recording.exposure_s is not None), key=lambda s: s.recording.exposure_s or 0
    )
    return {
        "seconds": [s.recording.exposure_s for s in known],
        "mean": [[float(s.frame_means[:, c].mean()) for s in known] for c in channels],
        "variance": [
            [
                float("nan") if s.variance is None else robust_mean_square(pixel_variance(s, c), s.dof)[0]
                for s in known
            ]
            for c in channels
        ],
    }


def _spectra(
    lit: Sequence[FrameStatistics], dark: Sequence[FrameStatistics], black: Sequence[float], white: float,
    channels: Channels,
) -> dict[str, Any]:  # fmt: skip
    """Root mean power along rows and columns of the mean dark frame (DN) and the mean flat (%), every channel
    about its mean, and the level that temporal noise leaves in such a mean."""
    out: dict[str, Any] = {}
    shown = max((s for s in dark if s.variance is not None), key=lambda s: s.recording.count, default=None)
    if shown is not None:
        out["dark"] = _spectrum(shown, np.zeros(5), np.ones(5), channels)
    flats = [s for s in lit if s.recording.kind == "flat" and s.variance is not None]
    flat = min(flats, key=lambda s: abs(s.level[0] / (white - black[0]) - 0.5), default=None)
    if flat is not None and min(flat.level) > 0:
        levels = flat.frame_means.mean(0) - np.asarray(black)
        out["flat"] = _spectrum(flat, np.asarray(black), levels / 100, channels)
    return out


def _spectrum(s: FrameStatistics, offset: np.ndarray, unit: np.ndarray, channels: Channels) -> dict[str, Any]:
    power: dict[str, list[np.ndarray]] = {"rows": [], "columns": []}
    noise = []
    for c in channels:
        plane = (site(s.mean, c) - offset[c]) / unit[c]
        plane = np.clip(plane - np.median(plane), *np.quantile(plane - np.median(plane), (0.001, 0.999)))
        plane = plane - plane.mean()
        for name, values in (("rows", plane), ("columns", plane.T)):
            power[name].append(np.mean(np.abs(np.fft.rfft(values, axis=1)) ** 2, 0) / values.shape[1])
        noise.append(robust_mean_square(pixel_variance(s, c), s.dof)[0] / s.recording.count / unit[c] ** 2)
    out: dict[str, Any] = {"noise": float(np.sqrt(np.mean(noise)))}
    for name, values in power.items():
        mean = np.sqrt(np.mean(values, 0))[1:]
        keep = np.unique(np.round(np.geomspace(1, len(mean), 240)).astype(int)) - 1
        # Cycles per pixel of the mosaic: one of four channels has every second one.
        pitch = 1 if len(channels) == 1 else 2
        frequency = 0.5 * np.arange(1, len(mean) + 1) / (pitch * len(mean))
        out[name] = {"frequency": frequency[keep].tolist(), "amplitude": mean[keep].tolist()}
    return out


def _table(t: PhotonTransfer, straight: dict[str, Any] | None, count: int) -> list[dict[str, Any]]:
    rows = []
    for name, unit, title in _ROWS:
        outcomes: Sequence[Outcome] = _derived(t, straight, name, unit) or t.outcomes(name, unit)
        if not outcomes:
            continue
        outcomes = outcomes if len(outcomes) == count else list(outcomes) * count
        missing = [o.record for o in outcomes if isinstance(o, NotMeasurable)]
        rows.append(
            {
                "name": title,
                "unit": unit,
                "values": [o.value if isinstance(o, Estimate) else None for o in outcomes],
                # A number that is no estimate, as the linearity error, has no interval.
                "ci90": [
                    list(o.ci90) if isinstance(o, Estimate) and o.ci90[0] < o.ci90[1] else None
                    for o in outcomes
                ],
                "text": [format_outcome(o) if isinstance(o, Estimate) else "" for o in outcomes],
                "record": missing[0] if len(missing) == len(outcomes) else "",
            }
        )
    return rows


def _derived(t: PhotonTransfer, straight: dict[str, Any] | None, name: str, unit: str) -> list[Outcome]:
    """Quantities that follow from others, by the standard's own equations."""
    saturation = t.outcomes("saturation level", "e-")
    recorded = t.outcomes("temporal dark noise, as recorded", "e-")
    if name == _NOISE:  # without darks that of the pixels is what is known
        return t.outcomes(name, unit) or t.outcomes("temporal dark noise", unit)
    if name == "linearity error":
        if straight is None:
            return [_STEADY] * 4
        errors = [v if v is None else float(f"{v:.3g}") for v in straight["error"]]
        return [_STEADY if v is None else Estimate(v, 0.0, (v, v)) for v in errors]
    if name == "sensitivity threshold":
        return list(map(_threshold, recorded))
    if name == "SNR max":
        return [_of_saturation(o, lambda e: np.sqrt(e) if not unit else 10 * np.log10(e)) for o in saturation]
    if name == "dynamic range":
        out: list[Outcome] = []
        for full, dark in zip(saturation, recorded, strict=True):
            least = _threshold(dark)
            if isinstance(full, NotMeasurable) or isinstance(least, NotMeasurable):
                out.append(full if isinstance(full, NotMeasurable) else least)
                continue
            out.append(_of_saturation(full, lambda e, least=least: 20 * np.log10(e / least.value)))
        return out
    return []


def _threshold(noise: Outcome) -> Outcome:
    """Signal of SNR 1, e-: sigma_y.dark / K + 1/2 (EMVA 1288, eq. 27, over eta)."""
    if isinstance(noise, NotMeasurable):
        return noise
    low, value, high = (v + 0.5 for v in (noise.ci90[0], noise.value, noise.ci90[1]))
    return Estimate(value, noise.stderr, (low, high))


def _of_saturation(full: Outcome, law: Any) -> Outcome:
    if isinstance(full, NotMeasurable) or full.ci90[0] <= 0:
        return full
    value, low, high = (float(law(v)) for v in (full.value, *full.ci90))
    return Estimate(value, (high - low) / 3.29, (low, high))
