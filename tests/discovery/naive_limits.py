"""Naive likelihood ratios of the effects, in plain NumPy: each knows the effect's form and is drawn with and
without it, with black level, gain and read noise as the frames show them."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy import ndimage

from cannoise_jax.discovery.search.limits import mde
from cannoise_jax.recordings.recording import CaptureSet
from tests.discovery.capture import capture_set

SIZE = (48, 64)
GAIN, READ, BLACK, WHITE = 1.5, 3.0, 200.0, 16383.0
NULLS, PAIRS = 1000, 120
Y, X = np.indices(SIZE)
SITE = 2 * (Y % 2) + X % 2
LONGEST = 0.1


@cache
def plan() -> CaptureSet:
    """Scenes with independent references, darks of two exposures, flats of unknown light."""
    return capture_set(5, size=SIZE, gain=GAIN, read=READ, black=BLACK)


@cache
def signals() -> list[np.ndarray]:
    """Light of every recording, DN."""
    levels = iter((0.03, 0.1, 0.3, 0.6))
    lights = {"dark": lambda r: 0.0, "scene": lambda r: r.clean, "flat": lambda r: next(levels)}
    return [np.broadcast_to(lights[r.kind](r), SIZE) * (WHITE - BLACK) for r in plan().recordings]


def variances() -> list[np.ndarray]:
    return [GAIN * s + (GAIN * READ) ** 2 + 1 / 12 for s in signals()]


def shares(power: np.ndarray) -> list[np.ndarray]:
    return [p / v for p, v in zip(power, variances(), strict=True)]


class Draw:
    """Noise of one set: what an effect may change is kept apart until the frames are read out."""

    def __init__(self, seed: int):
        self.rng = np.random.default_rng([seed, 11])
        shapes = [(r.count, *SIZE) for r in plan().recordings]
        self.charge = [GAIN * self.rng.poisson(s / GAIN, n) for s, n in zip(signals(), shapes, strict=True)]
        self.read = [GAIN * READ * self.rng.standard_normal(n) for n in shapes]

    def residuals(self, added=None, charge=None, read=None) -> list[np.ndarray]:
        """Frames as read out and rounded, less black level and light."""
        out = []
        for k, s in enumerate(signals()):
            analog = BLACK + (charge or self.charge)[k] + (read or self.read)[k]
            out.append(np.round(analog + (0 if added is None else added[k])) - BLACK - s)
        return out


# Statistics: what is quadratic leaves out each pixel's own square, what is linear is projected off black
# level and signal, what looks at shapes is standardised by the noise that the frames show.


def template(loads, common=False):
    """Score of a known pattern in the mean, as one filter for every recording."""
    rows, roots, known = [], [], []
    for r, s, v, m in zip(plan().recordings, signals(), variances(), loads, strict=True):
        root = np.sqrt(r.count / v)
        m = np.broadcast_to(m, SIZE).astype(float)
        if r.kind == "flat":
            left = m.copy()
            for c in range(4):
                at = c == SITE
                u, w = Y[at] / SIZE[0], X[at] / SIZE[1]
                basis = np.stack([u**i * w**j for i in range(5) for j in range(5 - i)], 1) * root[at][:, None]
                left[at] -= (basis @ np.linalg.lstsq(basis, m[at] * root[at], rcond=None)[0]) / root[at]
            rows.append(np.zeros((5, *SIZE)))
            m = np.where(np.abs(left) > 1e-6 * max(np.abs(m).max(), 1e-30), left, 0)
        else:
            levels = [np.ones(SIZE) * (c == 0) if common else 1.0 * (c == SITE) for c in range(4)]
            rows.append(np.stack([*levels, s]))
        roots.append(root)
        known.append(m)
    nuisance = np.concatenate([(b * r).reshape(5, -1) for b, r in zip(rows, roots, strict=True)], 1).T
    nuisance = nuisance / np.maximum(np.linalg.norm(nuisance, axis=0), 1e-30)
    target = np.concatenate([(m * r).ravel() for m, r in zip(known, roots, strict=True)])
    left = target - nuisance @ np.linalg.lstsq(nuisance, target, rcond=1e-10)[0]
    filters = [f.reshape(SIZE) * r for f, r in zip(np.split(left, len(roots)), roots, strict=True)]
    return lambda x: sum(float(np.sum(f * y.mean(0))) for f, y in zip(filters, x, strict=True))


def grouped(loads, subs, frozen=False):
    """Score of random offsets shared by a row, a column, a frame, or, frozen, by all frames."""

    def score(x):
        total, unit = 0.0, 0.0
        for v, m, y in zip(variances(), loads, x, strict=True):
            weighted = m * y / v
            if frozen:
                total -= np.sum(weighted**2)
                unit = unit + np.einsum(f"tij->{subs}", weighted)
            else:
                total += np.sum(np.einsum(f"tij->t{subs}", weighted) ** 2) - np.sum(weighted**2)
        return float(total + np.sum(np.square(unit)))

    return score


def drifting(x):
    """Score of an offset per frame about an unknown black level."""
    weighted = [(y / v).sum((1, 2)) for y, v in zip(x, variances(), strict=True)]
    information = np.concatenate(
        [np.full(len(w), np.sum(1 / v)) for w, v in zip(weighted, variances(), strict=True)]
    )
    u = np.concatenate(weighted)
    u = u - information * u.sum() / information.sum()
    return float(np.sum(u**2) - sum(np.sum((y / v) ** 2) for y, v in zip(x, variances(), strict=True)))


def waves(x):
    turn = np.exp(-2j * np.pi * 0.137 * (Y * SIZE[1] + X))
    return float(
        sum(
            np.sum(np.abs(np.einsum("tij,ij->t", y / v, turn)) ** 2) - np.sum((y / v) ** 2)
            for y, v in zip(x, variances(), strict=True)
        )
    )


def pink(x, rows):
    total = 0.0
    for y, v in zip(x, variances(), strict=True):
        series = (y / v).sum(2) if rows else (y / v).reshape(len(y), -1)
        f = np.abs(np.fft.fftfreq(series.shape[1]))
        power = np.divide(1, f, out=np.zeros_like(f), where=f > 0)
        power /= power.mean()
        total += np.sum(power * np.abs(np.fft.fft(series)) ** 2) / series.shape[1] - np.sum((y / v) ** 2)
    return float(total)


def standardised(x):
    for y, v in zip(x, variances(), strict=True):
        z = y / np.sqrt(v)
        yield z / np.sqrt(np.mean(z**2))


def kurtosis(x):
    share = shares([(GAIN * READ) ** 2] * len(x))
    squares = (np.square(z) for z in standardised(x))  # a fourth power is slow to take at once
    return float(sum(np.sum(s**2 * (q * q - 6 * q + 3)) for s, q in zip(share, squares, strict=True)))


def neighbours(x, distance):
    """Covariance of neighbours, in proportion to the noise that both give away together."""
    total = 0.0
    for light, v, y in zip(signals(), variances(), x, strict=True):
        given = GAIN * light if distance == 1 else v
        z = (
            y / v / np.sqrt(np.mean(y**2 / v))
        )  # by the noise that the frames show: gain and read noise are fitted
        for g, u in ((given, z), (given.T, z.transpose(0, 2, 1))):
            total += np.sum((g[distance:] + g[:-distance]) * u[:, distance:] * u[:, :-distance])
    return float(total)


def read_map(x):
    share = shares([(GAIN * READ) ** 2] * len(x))
    first, second = 0.0, 0.0
    for s, z in zip(share, standardised(x), strict=True):
        first = first + np.sum(s * (z**2 - 1) / 2, axis=0)
        second += np.sum(s**2 * (0.5 - z**2))
    return float(np.sum(first**2) + second)


def read_map_of_lines(along):
    """What the pixels of a line share, beyond the squares of each alone."""

    def form(x):
        share = shares([(GAIN * READ) ** 2] * len(x))
        each = sum(np.sum(s * (z**2 - 1) / 2, axis=0) for s, z in zip(share, standardised(x), strict=True))
        return float(np.sum(each.sum(along) ** 2) - np.sum(each**2))

    return form


# Effects: the residuals with an effect of amplitude a, on the same noise.


def adds(field):
    """DN + a * field(rng, recording, light)."""

    def effect(draw, a):
        frozen = np.random.default_rng(draw.rng.integers(2**31))
        unit: dict = {"draw": lambda name, n: unit.setdefault(name, frozen.standard_normal(n))}
        added = [
            a * field(draw.rng, r, s, unit["draw"]) for r, s in zip(plan().recordings, signals(), strict=True)
        ]
        return draw.residuals(added=added)

    return effect


def coloured(rng, n, length):
    f = np.abs(np.fft.fftfreq(length))
    power = np.divide(1, f, out=np.zeros_like(f), where=f > 0)
    spectrum = np.fft.fft(rng.standard_normal((n, length))) * np.sqrt(power / power.mean())
    return np.fft.ifft(spectrum).real


def smeared(draw, a):
    kernel = np.array([[0, a / 4, 0], [a / 4, 1 - a, a / 4], [0, a / 4, 0]])[None]
    noise = [q - s for q, s in zip(draw.charge, signals(), strict=True)]
    return draw.residuals(
        charge=[s + ndimage.convolve(n, kernel, mode="wrap") for s, n in zip(signals(), noise, strict=True)]
    )


def blended(draw, a):
    kernel = np.zeros((1, 5, 5))
    kernel[0, 0, 2] = kernel[0, 4, 2] = kernel[0, 2, 0] = kernel[0, 2, 4] = a / 4
    kernel[0, 2, 2] = 1 - a
    noise = [q - s + n for q, s, n in zip(draw.charge, signals(), draw.read, strict=True)]
    blend = [ndimage.convolve(n, kernel, mode="mirror") for n in noise]
    return draw.residuals(
        charge=[s + b for s, b in zip(signals(), blend, strict=True)], read=[0.0] * len(blend)
    )


def tailed(draw, a):
    freedom = 4 + 6 / a
    scaled = [n * np.sqrt((freedom - 2) / draw.rng.chisquare(freedom, n.shape)) for n in draw.read]
    return draw.residuals(read=scaled)


def uneven(size):
    def noisier(draw, a):
        width = np.sqrt(np.log1p(a**2))
        scale = np.exp(width * draw.rng.standard_normal(size) - width**2)
        return draw.residuals(read=[n * scale for n in draw.read])

    return noisier


def step(*_):
    return (SIZE[1] // 2 <= X) - 0.5


def glow(r):
    fall = np.exp(-np.hypot(Y, X) / (0.2 * max(SIZE)))
    return fall / np.sqrt(np.mean(fall**2)) * r.exposure_s / LONGEST


def ones():
    return [1.0] * len(plan().recordings)


def over(function):
    return [function(r, s) for r, s in zip(plan().recordings, signals(), strict=True)]


GREENS = np.array([0.0, 1.0, -1.0, 0.0])[SITE]
SITES = np.array([1.0, -1.0, -1.0, 1.0])[SITE]
CASES = {
    "row_noise": (
        lambda: grouped(ones(), "i"),
        adds(lambda rng, r, s, unit: rng.standard_normal((r.count, SIZE[0], 1))),
    ),
    "column_noise": (
        lambda: grouped(ones(), "j"),
        adds(lambda rng, r, s, unit: rng.standard_normal((r.count, 1, SIZE[1]))),
    ),
    "row_fpn": (
        lambda: grouped(ones(), "i", frozen=True),
        adds(lambda rng, r, s, unit: unit("row", (SIZE[0], 1))),
    ),
    "column_fpn": (
        lambda: grouped(ones(), "j", frozen=True),
        adds(lambda rng, r, s, unit: unit("column", SIZE[1])),
    ),
    "column_gain": (
        lambda: grouped(signals(), "j", frozen=True),
        adds(lambda rng, r, s, unit: s * unit("column", SIZE[1])),
    ),
    "dsnu": (
        lambda: grouped(ones(), "ij", frozen=True),
        adds(lambda rng, r, s, unit: unit("pixel", SIZE)),
    ),
    "prnu": (
        lambda: grouped(signals(), "ij", frozen=True),
        adds(lambda rng, r, s, unit: s * unit("pixel", SIZE)),
    ),
    "offset_drift": (
        lambda: drifting,
        adds(lambda rng, r, s, unit: rng.standard_normal((r.count, 1, 1))),
    ),
    "row_pink_noise": (
        lambda: lambda x: pink(x, True),
        adds(lambda rng, r, s, unit: coloured(rng, r.count, SIZE[0])[:, :, None]),
    ),
    "pink_noise": (
        lambda: lambda x: pink(x, False),
        adds(lambda rng, r, s, unit: coloured(rng, r.count, SIZE[0] * SIZE[1]).reshape(-1, *SIZE)),
    ),
    "banding": (
        lambda: waves,
        adds(
            lambda rng, r, s, unit: np.sin(
                2 * np.pi * (0.137 * (Y * SIZE[1] + X) + rng.random((r.count, 1, 1)))
            )
        ),
    ),
    "channel_offset": (
        lambda: template([SITES] * len(plan().recordings), common=True),
        adds(lambda rng, r, s, unit: SITES),
    ),
    "amplifier_mismatch": (lambda: template(over(step)), adds(lambda rng, r, s, unit: step())),
    "green_imbalance": (
        lambda: template(over(lambda r, s: s * GREENS)),
        adds(lambda rng, r, s, unit: s * GREENS),
    ),
    "nonlinearity": (
        lambda: template(over(lambda r, s: s**2)),
        adds(lambda rng, r, s, unit: s**2 / (WHITE - BLACK)),
    ),
    "amp_glow": (lambda: template(over(lambda r, s: glow(r))), adds(lambda rng, r, s, unit: glow(r))),
    "dark_current": (
        lambda: template(over(lambda r, s: np.full(SIZE, r.exposure_s))),
        adds(lambda rng, r, s, unit: GAIN * r.exposure_s),
    ),
    "heavy_tails": (lambda: kurtosis, tailed),
    "pixel_read_noise_map": (lambda: read_map, uneven(SIZE)),
    "row_read_noise_map": (lambda: read_map_of_lines(1), uneven((SIZE[0], 1))),
    "column_read_noise_map": (lambda: read_map_of_lines(0), uneven((1, SIZE[1]))),
    "crosstalk": (lambda: lambda x: neighbours(x, 1), smeared),
    "in_camera_denoising": (lambda: lambda x: neighbours(x, 2), blended),
}


@cache
def limit(mechanism: str) -> float:
    amplitude = mde(mechanism, plan())
    assert amplitude is not None and amplitude > 0
    return amplitude


@cache
def shifts(mechanisms: tuple[str, ...], nulls: int, pairs: int) -> dict[str, tuple[float, float]]:
    """Shift of every statistic, null standard deviations, and its standard error."""
    scores = {m: CASES[m][0]() for m in mechanisms}
    null: dict[str, list[float]] = {m: [] for m in mechanisms}
    more: dict[str, list[float]] = {m: [] for m in mechanisms}
    for seed in range(nulls):
        draw = Draw(seed)
        plain = draw.residuals()
        for m in mechanisms:
            null[m].append(scores[m](plain))
            if seed < pairs:
                more[m].append(scores[m](CASES[m][1](draw, limit(m))) - null[m][-1])
    return {
        m: (
            float(np.mean(more[m]) / np.std(null[m])),
            float(np.hypot(np.std(more[m]) / np.std(null[m]) / np.sqrt(pairs), 5 / np.sqrt(2 * nulls))),
        )
        for m in mechanisms
    }
