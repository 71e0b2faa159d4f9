"""Correlation between neighbouring pixels of the unpacked mosaic: charge sharing, filtering, lag in time."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy import fft

from cannoise_jax.discovery.fields import Fields, map_contrasts
from cannoise_jax.discovery.statistics.score import Probe, Score, normal_log_p, sidak

LAGS = tuple((dy, dx) for dy in range(5) for dx in range(-4, 5) if dy > 0 or dx > 0)
TEMPLATES: dict[str, dict[tuple[int, int], float]] = {
    "crosstalk": {(0, 1): 0.5, (1, 0): 0.5},
    "brighter_fatter": {(0, 1): 0.25, (1, 0): 0.25},
    "in_camera_denoising": {(0, 2): 0.5, (2, 0): 0.5},
    "in_camera_denoising_8": {(0, 2): 0.25, (2, 0): 0.25, (2, 2): 0.25, (2, -2): 0.25},
    "demosaicing": {(0, 1): 1.0, (1, 0): 1.0, (1, 1): 0.5, (1, -1): 0.5},
}
"""Correlation at each lag per unit of the mechanism's amplitude, to first order, times the template's
weight. Brighter-fatter: what a pixel loses of its variance is the covariance with its four neighbours."""


def pair_weight(field: Fields, law: str) -> np.ndarray:
    """Square root of the weight of a pair: 1, the share of shot noise, or that times the electrons."""
    if law == "white":
        return field.usable.astype(np.float32)
    share = np.sqrt(np.clip(field.shot, 0, 1)) * field.usable
    if law == "shot":
        return share.astype(np.float32)
    electrons = field.signal / np.maximum(np.mean(field.gain), 1e-9)
    return (share * np.sqrt(electrons / 1e4)).astype(np.float32)


def lag_sums(fields: tuple[Fields, ...], law: str) -> tuple[np.ndarray, np.ndarray]:
    """Per lag: U = sum of weighted products of neighbours, and its null variance I."""
    score, information = np.zeros(len(LAGS)), np.zeros(len(LAGS))
    for f in fields:
        if not len(f.contrasts) or (law != "white" and not f.lit):
            continue
        g = pair_weight(f, law)
        # Row and column offsets are mechanisms of their own: they are taken out, and what that does to the
        # covariance of white noise is known exactly.
        c = f.contrasts
        c = c - c.mean(1, keepdims=True) - c.mean(2, keepdims=True) + c.mean((1, 2), keepdims=True)
        x = c * g
        h, w = f.mean.shape
        shape = (fft.next_fast_len(h + 5), fft.next_fast_len(w + 5))
        power = sum(np.abs(fft.rfft2(v, shape)) ** 2 for v in x)
        auto = fft.irfft2(power, shape)
        squares = fft.irfft2(np.abs(fft.rfft2(g**2, shape)) ** 2, shape) * len(x)
        pairs = fft.irfft2(np.abs(fft.rfft2(g, shape)) ** 2, shape) * len(x)
        for k, (dy, dx) in enumerate(LAGS):
            bias = 1 / (h * w) - (1 / w if dy == 0 else 0.0) - (1 / h if dx == 0 else 0.0)
            score[k] += auto[dy, dx] - bias * pairs[dy, dx]
            information[k] += squares[dy, dx]
    return score, information


def template_score(fields: tuple[Fields, ...], *, probe: str, law: str, template: str) -> Score | None:
    """Correlation at the lags of one template, in its proportions."""
    score, information = lag_sums(fields, law)
    if not information.max() > 0:
        return None
    t = np.array([TEMPLATES[template].get(lag, 0.0) for lag in LAGS])
    i = float(np.sum(t**2 * information))
    if i <= 0:
        return None
    u = float(np.sum(t * score))
    z = u / np.sqrt(i)
    value = u / i
    if template.startswith("in_camera"):
        value = _blend_weight(value, 4 if template.endswith("ing") else 8)
    elif template == "crosstalk":
        value = 1 - np.sqrt(max(1 - 2 * value, 0.0)) if value > 0 else value
    amplitude = max(value, 0.0) * (1e-4 if law == "charge" else 1.0)
    unit = "1/e-" if law == "charge" else "1"
    error = float(1 / np.sqrt(i)) * (1e-4 if law == "charge" else 1.0)
    gain = 0.5 * z**2 if z > 0 else 0.0
    return Score(
        probe,
        normal_log_p(z, 1),
        gain,
        float(0.5 * np.log(information.max())),
        amplitude,
        error,
        error,
        1,
        {"fraction": (amplitude, unit, error)},
        {"axis": "pixel", "lags": [list(lag) for lag in TEMPLATES[template]]},
        (template, law, amplitude),
    )


def _blend_weight(first_order: float, neighbours: int) -> float:
    """Blend weight w from rho = 2 w (1 - w) / n / ((1 - w)^2 + w^2 / n) per neighbour lag, template
    weight 2/n."""
    if first_order <= 0:
        return 0.0
    grid = np.linspace(0, 0.9, 1801)
    rho = grid * (1 - grid) / ((1 - grid) ** 2 + grid**2 / neighbours)
    rho[np.argmax(rho) :] = rho.max()
    return float(np.interp(first_order, rho[: np.argmax(rho) + 1], grid[: np.argmax(rho) + 1]))


def any_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """The largest correlation at any lag, of either sign."""
    score, information = lag_sums(fields, "white")
    if not information.max() > 0:
        return None
    z = score / np.sqrt(np.maximum(information, 1e-30))
    k = int(np.argmax(np.abs(z)))
    rho = score / np.maximum(information, 1e-30)
    log_p = sidak(normal_log_p(float(z[k])), len(LAGS))
    strong = np.abs(z) > 3.5
    gain = 0.5 * float(np.sum(z[strong] ** 2))
    penalty = float(strong.sum() * (0.5 * np.log(information.max()) + np.log(len(LAGS)) / 2))
    where = {
        "axis": "pixel",
        "lags": [list(LAGS[i]) for i in np.flatnonzero(strong)],
        "correlations": [float(rho[i]) for i in np.flatnonzero(strong)],
    }
    error = float(1 / np.sqrt(information[k]))
    return Score(
        probe,
        log_p,
        gain,
        penalty,
        float(abs(rho[k])),
        error,
        error,
        1,
        {"correlation": (float(rho[k]), "1", error)},
        where,
        ("any", "white", rho),
    )


def absorb(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Whitens the fields by the inverse square root of the measured spectrum of neighbour correlations."""
    template, law, _ = score.payload
    u, i = lag_sums(fields, law)
    rho = u / np.maximum(i, 1e-30)
    used = np.abs(u) > 2.0 * np.sqrt(np.maximum(i, 1e-30))
    if template in TEMPLATES:
        used |= np.array([lag in TEMPLATES[template] for lag in LAGS])
    rho = np.where(used, rho, 0.0)
    return tuple(_whiten(f, rho, law) if f.lit or law == "white" else f for f in fields)


def _whiten(field: Fields, rho: np.ndarray, law: str) -> Fields:
    g = pair_weight(field, law)
    h, w = field.mean.shape
    kernel = np.zeros((h, w))
    for (dy, dx), value in zip(LAGS, rho, strict=True):
        kernel[dy % h, dx % w] += value
        kernel[-dy % h, -dx % w] += value
    spectrum = np.real(fft.rfft2(kernel))
    filt = 1 / np.sqrt(np.maximum(1 + spectrum, 0.05)) - 1

    def function(x: np.ndarray) -> np.ndarray:
        change = np.stack([fft.irfft2(fft.rfft2(v * g) * filt, (h, w)) for v in x]) if len(x) else x
        return (x + g * change).astype(np.float32)

    out = map_contrasts(field, function)
    if field.static is None:
        return out
    return out._replace(static=None if field.kind == "scene" else out.static)


def probes() -> tuple[Probe, ...]:
    """The probes of this signature."""
    out = []
    for name, law, template in (
        ("crosstalk", "shot", "crosstalk"),
        ("brighter_fatter", "charge", "brighter_fatter"),
        ("in_camera_denoising", "white", "in_camera_denoising"),
        ("in_camera_denoising", "white", "in_camera_denoising_8"),
        ("demosaicing", "white", "demosaicing"),
    ):
        axes = {
            "enters": "pixel" if law != "white" else "digital",
            "varies_over": "pixel",
            "time": "redrawn",
            "scales": {"shot": "signal", "charge": "signal squared"}.get(law, "all noise"),
            "law": "neighbours",
        }
        probe = f"lags_{template}"
        score = partial(template_score, probe=probe, law=law, template=template)
        bent = ("variance_curve",) if law == "charge" else ()  # the variance that is lost bends the curve
        out.append(Probe(probe, name, axes, score, absorb, bent))
    axes = {
        "enters": "readout",
        "varies_over": "pixel",
        "time": "redrawn",
        "scales": "all noise",
        "law": "neighbours",
    }
    out.append(Probe("lags_any", None, axes, partial(any_score, probe="lags_any"), absorb))
    return tuple(out)
