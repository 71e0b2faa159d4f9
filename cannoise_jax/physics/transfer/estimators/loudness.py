"""Why some values are loud: heavy tails (any pixel, any frame), noisy pixels, or telegraph pixels.

The three make the same histogram. They differ in what the values of one pixel have in common: nothing, their
size, or two levels. Each combination is a likelihood of whole pixels over the frames, fitted in full, and the
one with the best Bayesian information criterion (Schwarz, Ann. Stat. 6, 461, 1978) explains the dark.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import optimize, special

from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.robust import robust_std
from cannoise_jax.physics.transfer.dark_pixels import hessian
from cannoise_jax.physics.transfer.estimate import Z90, Estimate
from cannoise_jax.physics.transfer.estimator import Law
from cannoise_jax.physics.transfer.estimators.pick import odd_by_charge
from cannoise_jax.physics.transfer.estimators.telegraph import pixels_in_order, standardised, telegraph_odds
from cannoise_jax.physics.transfer.frames import FrameStatistics

LAWS: tuple[Law, ...] = ("tails", "spread", "telegraph")
_MOST_VALUES = 300_000
"""Times offsets, for the cost of a fit grows with both."""
_OFFSET_STEP = 0.4
"""Of the grid of offsets, in units of the noise. A sum of normal laws that wide apart is their integral to
0.1 % for 16 frames, whose mean is known to 0.25, and to 5 % for 32."""
_FROZEN = 4.0
"""Pixels whose average lies further out than so many times their own noise are hot, and do not count."""
_VISIBLE = 2.0
"""Least distance of two levels, in units of the noise: closer ones are any other shape of noise."""
_SCALES = 5.0
"""Logarithm of the noise over the measured one, at most: a first step of a fit may go anywhere."""
_NEARLY_GAUSSIAN = 0.12
"""Lambda of Tukey's law with an excess kurtosis of 0.08; it has none at 0.135."""
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(9)
"""Gauss-Hermite rule over the read noise of the pixels."""


class Explanation(NamedTuple):
    """The combination of laws that explains the loud values best, and its parameters by law and name."""

    laws: tuple[Law, ...]
    estimates: Mapping[Law, Mapping[str, Estimate]]


class _Part(NamedTuple):
    """Parameters of one law on the whole real line and back; the amplitude of a jump in units of noise."""

    names: tuple[str, ...]
    forward: tuple
    back: tuple
    step: tuple[float, ...]


_PARTS = {
    "tails": _Part(("tukey_lambda",), (float,), (lambda v: float(np.clip(v, -0.45, 0.3)),), (0.01,)),
    "spread": _Part(("spread",), (np.log,), (lambda v: float(np.exp(min(v, 1.0))),), (0.03,)),
    "telegraph": _Part(
        ("jump_dn", "fraction", "rate"),
        (lambda v: np.log(max(v - _VISIBLE, 0.1)), special.logit, lambda v: special.logit(min(2 * v, 0.95))),
        (lambda v: _VISIBLE + np.exp(min(v, 10.0)), special.expit, lambda v: special.expit(v) / 2),
        (0.03, 0.05, 0.05),
    ),
}


def explanation(
    dark: FrameStatistics,
    found: Mapping[Law, Mapping[str, Estimate]],
    seed: int = 0,
    gain: Float[np.ndarray, "4"] | None = None,
) -> Explanation:
    """Which of the laws found one by one explain the dark together, every one as a single cause or
    beside others. found: by law, with the estimates to start from. seed: of the pixels that are
    looked at, where there are too many. gain: DN/e-, by which warm pixels are told, whose own charge explains
    their noise."""
    series, sigma = standardised(dark)
    series = _without_hot(series[:, ~pixels_in_order(odd_by_charge(dark, gain))])
    offsets = _offsets(series)
    series = _sample(series, _MOST_VALUES // len(offsets[0]), seed)
    starts = {law: _start(law, found[law], sigma) for law in found}
    fits: dict[tuple[Law, ...], tuple[float, np.ndarray]] = {
        (law,): _fit(series, offsets, (law,), np.concatenate([[0.0], starts[law]])) for law in found
    }
    best = min(fits, key=lambda laws: fits[laws][0])
    while len(best) < len(found):
        # One more cause beside the best so far, as long as that pays.
        for law in set(found) - set(best):
            wider = tuple(k for k in LAWS if k in (*best, law))
            known = dict(zip(best, np.split(fits[best][1][1:], _ends(best)), strict=True))
            # Tails start near a Gaussian beside others, where they change nothing.
            known.setdefault("tails", np.array([_NEARLY_GAUSSIAN]))
            start = np.concatenate([fits[best][1][:1], *(known.get(k, starts[k]) for k in wider)])
            fits[wider] = _fit(series, offsets, wider, start)
        better = min(fits, key=lambda laws: fits[laws][0])
        if better == best:
            break
        best = better
    explained = Explanation(best, _estimates(series, offsets, best, fits[best][1], sigma))
    if len(best) == 1 or _told(explained.estimates):
        return explained
    others: dict[Law, Mapping[str, Estimate]] = {law: found[law] for law in best if law != "telegraph"}
    return explanation(dark, others, seed, gain)


def _told(estimates: Mapping[Law, Mapping[str, Estimate]]) -> bool:
    """Whether jumps among what explains the dark have a size: those whose interval spans more than a factor
    of two on either side stand for what is left of the spread of the noise."""
    if "telegraph" not in estimates:
        return True
    low, high = estimates["telegraph"]["jump_dn"].ci90
    return high < low * 4**Z90


def _ends(laws: Sequence[str]) -> np.ndarray:
    """Where the parameters of each law but the last end."""
    return np.cumsum([len(_PARTS[law].names) for law in laws])[:-1]


def _start(law: str, estimates: Mapping[str, Estimate], sigma: float) -> np.ndarray:
    part = _PARTS[law]
    values = [estimates[name].value / (sigma if name == "jump_dn" else 1.0) for name in part.names]
    return np.array([f(v) for f, v in zip(part.forward, values, strict=True)])


def _without_hot(series: Float[np.ndarray, "T n"]) -> Float[np.ndarray, "T n"]:
    own = series.std(0, ddof=1)
    return series[:, np.abs(series.mean(0)) < _FROZEN * np.maximum(own, 1.0)]


def _offsets(series: Float[np.ndarray, "T n"]) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Fixed offsets that a pixel may have, in units of its noise, with their log-chances: on a grid, of a
    normal law as wide as the averages of two halves of the frames have in common; none where that is
    little."""
    halves = [series[k::2].mean(0) for k in (0, 1)]
    total = robust_std(series.mean(0), 0) ** 2
    first, second = (np.clip(h, -2.5 * total**0.5, 2.5 * total**0.5) for h in halves)  # jumping pixels
    square = float(np.mean(first * second))
    if square < 0.3 * total:
        return np.zeros(1), np.zeros(1)
    width = np.sqrt(square)
    count = 2 * int(np.clip(np.ceil(3 * width / _OFFSET_STEP), 1, 8)) + 1
    places = np.linspace(-3 * width, 3 * width, count)
    logs = -0.5 * (places / width) ** 2
    return places, logs - special.logsumexp(logs)


def _sample(series: Float[np.ndarray, "T n"], values: int, seed: int) -> Float[np.ndarray, "T n"]:
    most = values // len(series)
    if series.shape[1] <= most:
        return series
    return series[:, np.random.default_rng(seed).choice(series.shape[1], most, replace=False)]


def _values(laws: Sequence[str], x: np.ndarray) -> dict[str, float]:
    """Parameters by name, the scale of the noise with them."""
    out, at = {"scale": float(np.exp(np.clip(x[0], -_SCALES, _SCALES)))}, 1
    for law in laws:
        for name, back in zip(_PARTS[law].names, _PARTS[law].back, strict=True):
            out[name] = float(back(x[at]))
            at += 1
    return out


def _negative(
    series: Float[np.ndarray, "T n"],
    offsets: tuple[np.ndarray, np.ndarray],
    laws: Sequence[str],
    x: np.ndarray,
) -> float:
    """Minus the log-likelihood, without the constant that a Gaussian has."""
    v = _values(laws, x)
    each = [logs + _loglik((series - place) / v["scale"], v) for place, logs in zip(*offsets, strict=True)]
    return float(-special.logsumexp(each, axis=0).sum() + series.size * np.log(v["scale"]))


def _loglik(values: Float[np.ndarray, "T n"], v: Mapping[str, float]) -> Float[np.ndarray, "n"]:
    """Log-likelihood of every pixel, of values in units of the noise."""
    frames, square = len(values), np.sum(values**2, 0)
    width = np.sqrt(np.log1p(v["spread"] ** 2)) if "spread" in v else 0.0
    nodes = np.exp(width * _NODES - width**2) if width else np.ones(1)
    weights = np.log(_WEIGHTS / _WEIGHTS.sum()) if width else np.zeros(1)
    if "tukey_lambda" in v:
        density = _tukey_table(v["tukey_lambda"])
        sums = np.stack([density(values / s).sum(0) for s in nodes])
    else:
        sums = -0.5 * square / nodes[:, None] ** 2
    each = special.logsumexp(sums - frames * np.log(nodes)[:, None] + weights[:, None], axis=0)
    if "fraction" in v:
        blinking = telegraph_odds(values, v["jump_dn"] / v["scale"], v["rate"]) - 0.5 * square
        each = np.logaddexp(np.log1p(-v["fraction"]) + each, np.log(v["fraction"]) + blinking)
    return each


def _tukey_table(shape: float):
    """Log-density of the distribution of unit variance over that of a Gaussian's constant, by a table."""
    p = special.expit(np.linspace(-34, 34, 801))
    q = special.expit(-np.linspace(-34, 34, 801))
    safe = shape if abs(shape) > 1e-6 else 1e-6
    scale = float(np.sqrt(tukey_lambda.variance(shape)))
    x = (p**safe - q**safe) / safe / scale
    logs = -np.log((p ** (safe - 1) + q ** (safe - 1)) / scale) + 0.5 * np.log(2 * np.pi)
    return lambda values: np.interp(values, x, logs)


def _fit(
    series: Float[np.ndarray, "T n"], offsets: tuple, laws: tuple[Law, ...], start: np.ndarray
) -> tuple[float, np.ndarray]:
    """The criterion in nats, and the parameters on the line."""
    found = optimize.minimize(
        lambda x: _negative(series, offsets, laws, x), start, method="L-BFGS-B",
        options={"eps": 1e-4, "ftol": 0.01 / series.size, "gtol": 1e-2, "maxiter": 60},
    )  # fmt: skip
    return float(found.fun + 0.5 * len(start) * np.log(series.size)), found.x


def _estimates(
    series: Float[np.ndarray, "T n"], offsets: tuple, laws: tuple[Law, ...], x: np.ndarray, sigma: float
) -> dict[Law, dict[str, Estimate]]:
    """Values with the errors of the observed information."""
    steps = np.concatenate([[0.01], *(_PARTS[law].step for law in laws)])
    curvature = hessian(lambda y: _negative(series, offsets, laws, y), x, steps)
    errors = np.sqrt(np.abs(np.diag(np.linalg.pinv(curvature))))
    out: dict[Law, dict[str, Estimate]] = {law: {} for law in laws}
    at = 1
    for law in laws:
        for name, back in zip(_PARTS[law].names, _PARTS[law].back, strict=True):
            unit = sigma if name == "jump_dn" else 1.0
            low, value, high = (unit * float(back(x[at] + errors[at] * z)) for z in (-Z90, 0.0, Z90))
            out[law][name] = Estimate(value, (high - low) / (2 * Z90), (low, high))
            at += 1
    return out
