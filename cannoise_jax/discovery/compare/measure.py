"""The bank of one recording: every family of statistics of its view, unit by unit."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.discovery.compare.compared import Measured, Statistics
from cannoise_jax.discovery.compare.families import (
    BY_PARITY,
    CODES,
    IN_ONE_FRAME,
    LEVEL,
    LEVELS,
    LINE_NOISE,
    MOMENTS,
    NEIGHBOURS,
    NEXT_FRAME,
    NEXT_LAGS,
    NEXT_LINES,
    QUIET_CHANCES,
    RAILS,
    SMOOTH_MAPS,
    SPARSITY,
    STANDING_OUT,
    STANDING_SIGMAS,
    STATIC,
    STRUCTURE,
    TAIL_SIGMAS,
    TAILS,
    TEMPORAL,
    UNSTEADY,
    UNSTEADY_CHANCES,
    of,
)
from cannoise_jax.discovery.compare.fixed_moments import moment_variance
from cannoise_jax.discovery.compare.moves import FINE, lines_after, noise_of_lines
from cannoise_jax.discovery.compare.view import RESIDUES, View
from cannoise_jax.discovery.frames.draws import within_codes
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures import bank
from cannoise_jax.signatures.fields import helmert

_OWN_FRAMES = 8
"""Frames whose products with themselves are taken: they are told far better than those with others."""


def of_sets(sets: list[Measured], family: str) -> list[Statistics]:
    """A family's statistics of those simulated sets that have them: one that is clipped all over has not."""
    return [s.families[family] for s in sets if family in s.families]


BROAD = 0.75
"""Codes modulo m are compared where the noise is as many times m: then no level can favour a residue (by
more than 2 exp(-2 pi^2 0.75^2) = 3e-5 of it, for a normal law)."""


def measure(
    seen: View,
    level_known: bool,
    degree: int,
    variance: Float[np.ndarray, "4"],
    step: float,
    follows: Bool[np.ndarray, "m"],
) -> Measured:
    """Every family of one view. level_known: whether the mean of the frames is the simulator's to tell;
    degree: of the surface that was taken out of the static map; variance: of a pixel of every site, DN^2;
    step: of the codes, DN; follows: whether every frame but the first was taken soon after the one before
    it. Of those that were not nothing tells what a frame keeps of another."""
    families: dict[str, Statistics] = {}
    n, size = len(seen.z), seen.kept.size
    coarse = is_coarse(variance, step)
    share = float(max(seen.kept.mean(), 1e-6))
    power = None
    if n and seen.kept.any():
        kept = seen.kept.astype(np.float32)
        grain = step / np.sqrt(float(np.mean(variance)))
        rows = _units(seen.z, kept, share, coarse, grain)
        for name, law, width in _unit_families(seen.kept.shape, size * share):
            families[of(TEMPORAL, name)] = Statistics(law, np.stack([r[name] for r in rows]), width)
        power = np.sum([bank.power(z, share) for z in seen.z], 0)
        families[UNSTEADY] = unsteady(seen.steadiness[seen.usable], n, grain)
        families[LEVELS] = _count(seen.levels[None])
        unlike, width = noise_of_lines(seen.z, seen.kept)
        families[LINE_NOISE] = Statistics("mean", unlike[None], width)
        frames = len(seen.single)
        if frames > 1:
            families[IN_ONE_FRAME] = _count(seen.single)
        pairs = follows[: frames - 1]
        if frames > 2 and pairs.any():
            inner = seen.z[: frames - 1]
            families[NEXT_FRAME] = _next(seen._replace(z=inner), share, pairs)
            lines, width = lines_after(inner, seen.kept, pairs)
            families[NEXT_LINES] = Statistics("mean", lines[None], width)
    families[RAILS] = _count(seen.rails)
    broad = np.repeat([np.sqrt(np.mean(variance)) > BROAD * m * step for m in RESIDUES], RESIDUES)
    families[CODES] = _count((seen.codes * broad)[None])
    if level_known and seen.static is not None:
        own = np.asarray(variance) / max(size * share / 4, 1)
        families[LEVEL] = Statistics("mean", seen.level, own)
    if seen.static is not None and seen.static_kept.any():
        share = float(max(seen.static_kept.mean(), 1e-6))
        kept = seen.static_kept.astype(np.float32)
        grain = step / np.sqrt(float(np.mean(variance)) * len(seen.single))
        # Means that hardly a frame moves off a code have no law that a map could be told by.
        still = float(np.mean(variance)) * len(seen.single) < _STILL * step**2
        # Of a map with a level the square moves with that of every frame, which `LEVEL` tells.
        levelled = _about_sites(seen.static, seen.static_kept)
        (row,) = _units(levelled[None], kept, share, coarse, grain)
        for name, law, width in () if still else _unit_families(seen.kept.shape, size * share):
            if name == STRUCTURE:
                width = width * ~absorbed(seen.kept.shape, degree).ravel()
            if name == MOMENTS:
                width = moment_variance(levelled, seen.static_kept, seen.z)
            families[of(STATIC, name)] = Statistics(law, row[name][None], width, len(seen.single))
        if degree == 0:  # else it is what the surface took out
            first = bank.maps(seen.static, seen.static_kept)[None, 1:-3]
            noise = _smooth_noise(seen, 1 / (size * share), first.size)
            families[of(STATIC, SMOOTH_MAPS)] = Statistics("mean", first, noise)
        values = seen.outlying[seen.usable]  # type: ignore[index]
        counts = [(values < t).sum() if t < 0 else (values > t).sum() for t in STANDING_SIGMAS]
        families[STANDING_OUT] = _count(np.array([counts]))
    return Measured(families, power, n, seen.static, coarse, seen.kept.shape[1])


def _about_sites(static: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """A static map less the mean of each site of the mosaic."""
    out = static.copy()
    for at in SITES:
        if kept[at].any():
            out[at] = np.where(kept[at], static[at] - static[at].mean(where=kept[at], dtype=float), 0.0)
    return out


def unsteady(steadiness: Float[np.ndarray, "p"], n: int, grain: float) -> Statistics:
    """Pixels noisier and quieter than the others. steadiness: mean square of n contrasts. grain: step of the
    codes, standard deviations. Of few codes a mean square has few values, and a limit between two of them
    would jump with the level: contrasts are moved at random by as much as rounding moves them."""
    if grain > FINE:
        rng, more = np.random.default_rng(1), grain**2 / 12
        along = np.sqrt(n * steadiness) + np.sqrt(more) * rng.standard_normal(steadiness.shape)
        across = more * rng.chisquare(n - 1, steadiness.shape) if n > 1 else 0.0
        steadiness = (along**2 + across) / (n * (1 + more))
    over = [(steadiness > stats.chi2.isf(p, n) / n).sum() for p in UNSTEADY_CHANCES]
    under = [(steadiness < stats.chi2.ppf(p, n) / n).sum() for p in QUIET_CHANCES]
    return _count(np.array([[*over, *under]]))


_STILL = 3.0
"""Variance of all frames of a recording together, codes squared, below which their mean is none: of noise of
a quarter of a code about a code, 12 frames, one pixel in two stays there in all. Draws of noise of 0.35 codes
give 3 in 20 frames."""


def _smooth_noise(seen: View, white: float, number: int) -> Float[np.ndarray, "k"]:
    """Variance of the smooth maps of a mean by noise: as white noise has it, or as the contrasts show, where
    rows or whole areas move together from frame to frame."""
    lent = 2.0  # degrees of freedom of white noise
    drawn = sum((bank.maps(z, seen.kept)[1:-3] ** 2 for z in seen.z), np.zeros(number))
    return np.maximum((lent * white + drawn) / (lent + len(seen.z)), white)


def absorbed(shape: tuple[int, int], degree: int) -> np.ndarray:
    """Coefficients of a static map that the fit of its mean has taken out, `bool[4, i, j]`: the whole
    frame of every site, and all that is as smooth both ways as the surface of the light."""
    sides = [bank.cropped_side(n) // 2 for n in shape]
    rows, columns = (
        np.array([s.whole or (degree > 0 and s.length > n / degree) for s in bank.scales(n)]) for n in sides
    )
    return np.broadcast_to(np.outer(rows, columns), (4, rows.size, columns.size))


def _count(values: np.ndarray) -> Statistics:
    values = np.asarray(values, float)
    return Statistics("count", values, np.ones(values.shape[1]))


def _unit_families(shape: tuple[int, int], pixels: float) -> list[tuple[str, str, np.ndarray]]:
    """Families of a unit: name, law, and the sizes of `Family`."""
    at = bank.lags()
    h, w = (m - m % 2 for m in shape)
    pairs = np.maximum((h - at[:, 0]) * (w - np.abs(at[:, 1])), 1) * pixels / (shape[0] * shape[1])
    near = np.tile(pairs[bank.near_lags()], 3)
    orders = np.repeat([2.0, 6.0, 24.0], len(bank.MOMENTS)) / pixels
    return [
        (STRUCTURE, "energy", bank.counts(shape).ravel()),
        (SPARSITY, "mean", bank.sparsity_variance() / bank.counts(shape).ravel()),
        (NEIGHBOURS, "mean", 1 / pairs),
        (BY_PARITY, "mean", 1 / near),
        (MOMENTS, "mean", orders),
        (TAILS, "count", np.ones(len(TAIL_SIGMAS))),
    ]


def is_coarse(variance: Float[np.ndarray, "4"], step: float) -> bool:
    """Whether the noise is less than a code."""
    return bool(np.sqrt(np.mean(variance)) < step)


def _unit(
    z: np.ndarray, kept: np.ndarray, share: float, coarse: bool, more: np.ndarray | None
) -> dict[str, np.ndarray]:
    """One field. Its level is the energies' and the second moment's to tell: all else is of the field divided
    by its own root mean square, so that a noisier one is not skewed, tailed or correlated for that. more:
    spreads its few values over the steps between them, so that no limit lies between two of them."""
    own = z / np.float32(np.sqrt(max(float(np.mean(z * z)) / share, 1e-9)))
    alone = bank.without_lines(own) * kept
    together, apart = bank.product_statistics(bank.products(alone, share))
    moments = bank.hermite(own, kept)
    moments[0] = bank.maps((z * z - 1) * kept, kept)
    # What a whole frame is off by is the energies' as well: it moves values over one limit, from the other.
    far = z if coarse else own - kept * np.float32(own.sum() / max(float(kept.sum()), 1.0))
    return {
        STRUCTURE: bank.energies(z, share).ravel(),
        NEIGHBOURS: together,
        BY_PARITY: apart,
        MOMENTS: moments.ravel(),
        TAILS: _tails(far if more is None else far + kept * more),
    }


def _units(
    fields: Float[np.ndarray, "u h w"], kept: np.ndarray, share: float, coarse: bool, grain: float
) -> list[dict[str, np.ndarray]]:
    """Several fields of a recording: how unevenly structures are spread is told over all of them. grain: the
    step of the codes in their units."""
    rng = np.random.default_rng(0)

    def more() -> np.ndarray | None:
        return within_codes(kept.shape, rng) * np.float32(grain)

    out = [_unit(z, kept, share, coarse, more() if grain > FINE else None) for z in fields]
    strength = np.mean([u[STRUCTURE] for u in out], 0).reshape(bank.counts(kept.shape).shape)
    return [
        {**u, SPARSITY: bank.sparsity(z, strength, share).ravel()} for u, z in zip(out, fields, strict=True)
    ]


def _tails(z: np.ndarray) -> np.ndarray:
    return np.array([(z < t).sum() if t < 0 else (z > t).sum() for t in TAIL_SIGMAS], float)


def _next(seen: View, share: float, pairs: Bool[np.ndarray, "m"]) -> Statistics:
    """Mean products of a frame with the next one at small lags, whole frames' means out; of these pairs.

    Frames about their mean are alike by the less the more of them there are: in products of N of them with
    others lies -1/(N - 1) of their products with themselves, which is put back. Neighbours that are alike in
    a frame would be unlike those of the next one by it."""
    n, kept = len(seen.z), seen.kept
    matrix, (h, w) = helmert(n + 1).astype(np.float32), kept.shape
    asked = min(n + 1, _OWN_FRAMES)

    def products(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        pairs = (
            (one[: h - dy, max(-dx, 0) : w - max(dx, 0)], other[dy:, max(dx, 0) : w - max(-dx, 0)])
            for dy, dx in NEXT_LAGS
        )
        return np.array([float(np.einsum("ij,ij->", a, b)) / (a.size * share) for a, b in pairs])

    total, own = np.zeros((2, len(NEXT_LAGS)))
    before = None
    for t in range(n + 1):
        frame = bank.without_lines(np.tensordot(matrix[:, t], seen.z, 1)) * kept
        if before is not None and pairs[t - 1]:
            total += products(before, frame)
        if t < asked:
            own += products(frame, frame)
        before = frame
    number = int(pairs.sum())
    variance = np.array([1 / ((h - dy) * (w - abs(dx)) * share * number) for dy, dx in NEXT_LAGS])
    total = total / number + own / asked / n
    total /= max(float(np.mean(seen.z**2)) / share, 1e-9)
    return Statistics("mean", total[None], variance)


def shared(first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "3"]:
    """Correlation of two static maps: pixel by pixel (lines out), of row means and of column means."""
    out = [_correlation(bank.without_lines(first), bank.without_lines(second))]
    for axis in (1, 0):
        out.append(_correlation(*(_rough(m.mean(axis, dtype=np.float64)) for m in (first, second))))
    return np.array(out)


def shared_variance(
    first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "3"]:
    """Of `shared` where the maps have nothing to do with each other: of lines by their spectra, as
    two waves of one frequency correlate by their phases, however many lines there are."""
    out = [1 / first.size]
    for axis in (1, 0):
        profiles = [_rough(m.mean(axis, dtype=np.float64)) for m in (first, second)]
        a, b = (np.abs(np.fft.rfft(p)) ** 2 + 1e-12 for p in profiles)
        out.append(max(float(a @ b / a.sum() / b.sum()) / 2, 1 / profiles[0].size))
    return np.array(out)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    scale = np.sqrt(np.mean(a * a, dtype=np.float64) * np.mean(b * b, dtype=np.float64))
    return float(np.mean(a * b, dtype=np.float64) / max(scale, 1e-12))


def _rough(profile: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """A profile without what is smooth: that may be light, whose colours differ from line to line of a
    mosaic."""
    out = np.empty(profile.shape)
    for own in (slice(0, None, 2), slice(1, None, 2)):
        at = np.linspace(-1, 1, profile[own].size)
        smooth = np.polynomial.legendre.legfit(at, profile[own], min(12, at.size - 1))
        out[own] = profile[own] - np.polynomial.legendre.legval(at, smooth)
    return out
