"""Whether a map that a name says is of single pixels, or of single lines, is: each by itself, not a structure
of many.

A map is estimated from two halves of the recordings, whose noise is independent. Their products, in the
orthonormal basis of `signatures.bank`, are what the map itself has at every scale, without noise. Pixels that
have nothing to do with each other have the same at all scales; what fringes, spots, shadows or a texture add
lies at those of many pixels. Whole rows and columns, and what is as smooth as light, are others' to tell.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage, stats

from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.robust import median
from cannoise_jax.signatures import bank
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.pixels import read_share
from cannoise_jax.signatures.returning import halves
from cannoise_jax.signatures.signature import BLINKING
from cannoise_jax.signatures.squares import square_map

_STRUCTURED = 0.5
"""Share of the map's variance at scales of many pixels, beyond what single pixels have there, from which on
it is no map of single pixels."""
_SURE = 5.0
"""Standard deviations from which on that is no chance."""
NOISE = "log-normal variance"
"""The law of maps of noise."""
_FEW = 0.2
"""Share of the frame beyond which pixels are no few."""
_BLOCK = 16
"""Pixels along a side of the blocks that are counted in."""
_CROWDED = 1e-4
"""Chance that a line or block of those of a frame holds as many."""
_FEWEST = 16
"""Lines below which nothing is told of their order."""
_ORDERS = 4000
"""Orders by chance that are looked at."""
_PLACES = 8
"""Places of lines that lie side by side."""
_SMOOTH = 8
"""Parts of the frame that are as smooth as light along a side."""
_BESIDE = 9
"""Frequencies beside each other, along each axis, over which a spectrum is smoothed."""
_IN_A_LINE = 9.0
"""Nats beyond the log of the number of frequencies from which on the power at one is no chance."""
_REPEATED = 0.25
"""Share of the map's variance in such lines from which on it is no map of single pixels: white, hot and
blurred ones have none, tiles of 6 x 10 and checks of 7.3 x 11.1 pixels 0.3 to 1."""
_CAPPED = 5.0
"""Typical power at which others count beside a line, so that lines beside each other do not hide."""

_APART, _ACROSS = (4, 6, 8), (1, 2, 3, 4, 6, 8)
"""Pixels between those along a line that are compared, farther than light and charge reach over; and between
those across it, which may have nothing alike: of fringes and rings they have at one distance or another."""

_FARTHEST = 1e-3
"""Share of the pixels, the noisiest, that count as the next one does."""
_AGAIN = 0.5
"""Of the correlation between frames that a noise of each pixel's own makes, that it must have at least: maps
of a spread of 0.25 to 0.36 have all of it and more."""


class NoisyHalves(NamedTuple):
    """Mean squares of every pixel in either half of the frames, the farthest ones cut, the pixels that tell,
    and the number of contrasts of all."""

    one: Float[np.ndarray, "h w"]
    other: Float[np.ndarray, "h w"]
    usable: Bool[np.ndarray, "h w"]
    number: int


def noisy_halves(step: Step) -> NoisyHalves | None:
    """Those that a step gives a noise of each pixel's own from; None: it gives none, or too few frames do."""
    if step.named.mechanism == UNKNOWN or step.named.signature.axes.law != NOISE:
        return None
    found, seen = halves(step.before), square_map(step.before)
    if found is None or seen is None:
        return None
    one, other = (np.minimum(h, np.quantile(h[seen[1]], 1 - _FARTHEST)) for h in found)
    return NoisyHalves(one, other, seen[1], seen[2])


def noisy_again(step: Step) -> Doubt | None:
    """What speaks against a step that gives every pixel a noise of its own: that pixels noisy in some frames
    are hardly so in the others, as where hits make them."""
    found = noisy_halves(step)
    if found is None:
        return None
    one, other = found.one[found.usable], found.other[found.usable]
    shared = float(np.corrcoef(one, other)[0, 1])
    own = read_share(step.before) ** 2 * ((1 + step.named.score.amplitude**2) ** 4 - 1)
    expected = own / (own + (1 + own) * 2 / max(found.number / 2, 1))
    if shared > _AGAIN * expected or (expected - shared) * np.sqrt(one.size) < _SURE:
        return None
    what = f"the noise of pixels in some frames and in others correlates by {shared:.2f}, not {expected:.2f}"
    return Doubt(1 - max(shared, 0.0) / expected, (what,), instead=True)


def patterned(step: Step) -> Doubt | None:
    """What speaks against a step that names a map of single pixels; None: nothing does, it names none, or
    only one recording shows it."""
    axes = step.named.signature.axes
    if step.named.mechanism == UNKNOWN or (axes.time, axes.varies_over) != ("frozen", "pixel"):
        return None
    if axes.law not in ("white", NOISE):
        return None
    one, two = (_map(step, half, n) for n, half in enumerate(_halves(step.before)))
    if one is None or two is None:
        return None
    noise = axes.law == NOISE
    parts = _of_parts(one, two)
    if parts.share > _STRUCTURED:
        said = f"{100 * parts.share:.0f} % of the map is of parts of {parts.axis}s, not of single pixels"
        return Doubt(parts.share, (said,), instead=True)
    found = max(_of_blocks(one, two, noise), _of_waves(one, two, noise), key=lambda f: f.share)
    if found.share <= _STRUCTURED:
        repeated = 0.0 if noise else _of_lines(one, two)
        said = f"{100 * repeated:.0f} % of the map repeats: lines of its spectrum, not single pixels"
        return Doubt(repeated, (said,), instead=True) if repeated > _REPEATED else None
    structures = f"structures some {found.length} px wide"
    said = f"{100 * found.share:.0f} % of the map is of {structures}, not of single pixels"
    return Doubt(found.share, (said,), instead=True)


class _Structured(NamedTuple):
    """Share of a map's variance that is of no single pixels, 0 where that may be chance, and how wide it
    is, pixels."""

    share: float
    length: int


def _structured(every: float, alone: float, error: float, length: Callable[[], int]) -> _Structured:
    """every, alone: mean power of the map, and that of single pixels; error: of their difference."""
    sure = every > 0 and every - max(alone, 0.0) >= max(_STRUCTURED * every, _SURE * error)
    return _Structured(1 - max(alone, 0.0) / every, length()) if sure else _Structured(0.0, 0)


def _of_blocks(one: Float[np.ndarray, "h w"], two: Float[np.ndarray, "h w"], noise: bool) -> _Structured:
    """Structure in blocks: by the scales of the bank, of which single pixels have the finest as the others.
    one, two: the map by each half of the recordings."""
    each, other, both = (bank.energies(m.astype(np.float32)) for m in (one, two, one + two))
    shared = (both - each - other) / 2
    weight = bank.counts(one.shape) * _local(one.shape, noise)
    fine = np.zeros_like(weight)
    fine[:, 0, 0] = weight[:, 0, 0]
    if not weight.any() or not fine.any():
        return _Structured(0.0, 0)
    every, alone = (float(np.sum(w * shared) / w.sum()) for w in (weight, fine))
    more = weight / weight.sum() - fine / fine.sum()
    # The map is what it is: by chance is only the noise of both estimates, which single pixels show.
    first, second = (max(float(np.sum(fine * (e - shared)) / fine.sum()), 1e-12) for e in (each, other))
    scatter = first * second + np.maximum(shared, 0) * (first + second)
    error = float(np.sqrt(np.sum(more**2 * scatter / np.maximum(weight, 1))))
    return _structured(every, alone, error, lambda: _length(shared, weight, one.shape))


def _of_waves(one: Float[np.ndarray, "h w"], two: Float[np.ndarray, "h w"], noise: bool) -> _Structured:
    """Structure that repeats: by the cross-spectrum of both halves, of which single pixels have the same at
    all frequencies, so as much as the median one has. Waves of a few pixels, as the rings of a wafer make
    them, are of the bank's finest scale as single pixels are."""
    first, second = (np.fft.fft2(m - m.mean()) / np.sqrt(m.size) for m in (one, two))
    cross = _smoothed((first * second.conj()).real)
    apart = float(np.mean(np.abs(first - second) ** 2)) / 2
    local = ~_whole_or_smooth(one.shape, noise)
    alone = float(median(cross[local]))
    # Of all frequencies: single pixels have as much at those of whole lines and of light.
    every = alone + float(np.sum(cross[local] - alone)) / cross.size
    scatter = apart**2 + 2 * max(every, 0.0) * apart
    error = float(np.sqrt(scatter * (1 + np.pi / 2) * local.sum())) / cross.size

    def length() -> int:
        down, across = (np.fft.fftfreq(n) for n in one.shape)
        at = np.unravel_index(int(np.argmax(np.where(local, cross, -np.inf))), cross.shape)
        return max(round(0.5 / float(np.hypot(down[at[0]], across[at[1]]))), 1)

    return _structured(every, alone, error, length)


def _of_lines(one: Float[np.ndarray, "h w"], two: Float[np.ndarray, "h w"]) -> float:
    """Share of the map's variance at single frequencies that stand far out of those beside them, as what
    repeats has it; 0 where there are none. Whole lines and light aside."""
    first, second = (np.fft.fft2(m - m.mean()) / np.sqrt(m.size) for m in (one, two))
    power, cross = np.abs(first + second) ** 2, (first * second.conj()).real
    beside = _smoothed(np.minimum(power, _CAPPED * median(power)))
    out = power > (np.log(power.size) + _IN_A_LINE) * beside
    down, across = (np.abs(np.fft.fftfreq(n, 1 / n)) for n in power.shape)
    out &= (down[:, None] > _SMOOTH) | (across > _SMOOTH)
    out[[0, len(out) // 2]] = False
    out[:, [0, out.shape[1] // 2]] = False
    every = float(cross.sum())
    return float(cross[out].sum()) / every if every > 0 else 0.0


class _Parts(NamedTuple):
    """Share of a map's variance that is of parts of lines, 0 where that may be chance, and of which lines."""

    share: float
    axis: str


def _of_parts(one: Float[np.ndarray, "h w"], two: Float[np.ndarray, "h w"]) -> _Parts:
    """What pixels some way along a line have alike, beyond those across it. What whole lines share is taken
    out of the map; where halves are read by amplifiers of their own, what these differ by stays in it, and is
    of no scale that single pixels are told by."""
    found = _Parts(0.0, "")
    if min(one.shape) <= max(*_APART, *_ACROSS):
        return found
    one, two = one - one.mean(), two - two.mean()
    own = float(np.mean(one * two))
    error = float(np.sqrt(np.mean(one**2) * np.mean(two**2) / one.size))
    for axis, (a, b) in (("column", (one, two)), ("row", (one.T, two.T))):
        along = np.mean([_alike(a, b, k) for k in _APART])
        more = float(along - np.sqrt(np.mean([_alike(a.T, b.T, k) ** 2 for k in _ACROSS])))
        if own > 0 and more > _SURE * error:
            found = max(found, _Parts(min(more / own, 1.0), axis))
    return found


def _alike(one: Float[np.ndarray, "h w"], two: Float[np.ndarray, "h w"], apart: int) -> float:
    """The mean product of pixels so many rows apart."""
    return float(np.mean(one[apart:] * two[:-apart]) + np.mean(two[apart:] * one[:-apart])) / 2


def _smoothed(power: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The mean over frequencies beside each other, of which each by itself is chance."""
    return ndimage.uniform_filter(power, _BESIDE, mode="wrap")


def _whole_or_smooth(size: tuple[int, int], noise: bool) -> Bool[np.ndarray, "h w"]:
    """Frequencies of whole lines, of one parity or both, and those as smooth as light, as `_local` has it."""
    cycles = [np.abs(np.fft.fftfreq(n, 1 / n)) for n in size]
    whole = [(c < _BESIDE) | (c > n // 2 - _BESIDE) for c, n in zip(cycles, size, strict=True)]
    slow = [np.minimum(c, n // 2 - c) <= _SMOOTH + _BESIDE for c, n in zip(cycles, size, strict=True)]
    if noise:
        return whole[0][:, None] & whole[1]
    return whole[0][:, None] | whole[1] | (slow[0][:, None] & slow[1])


def ranged(step: Step) -> Doubt | None:
    """What speaks against a step that names a frozen pattern of single rows or columns: that neighbours are
    alike, as steps and slopes have them, or that most of it lies in one place, where other orders of the same
    lines have neither."""
    axes = step.named.signature.axes
    if step.named.mechanism == UNKNOWN or (axes.time, axes.law) != ("frozen", "white"):
        return None
    if axes.varies_over not in ("row", "column"):
        return None
    halves = [step.named.signature.predict(half, step.named.score) for half in _halves(step.before)]
    one, two = (None if p is None or p.pattern is None else np.ravel(p.pattern) for p in halves)
    if one is None or two is None or one.size != two.size or one.size < _FEWEST:
        return None
    rng, at, wide = np.random.default_rng(0), np.arange(one.size), one.size // _PLACES

    def told(order: np.ndarray) -> tuple[float, float]:
        """What neighbours differ by, and what the fullest place holds."""
        a, b = one[order], two[order]
        held = np.cumsum(np.concatenate([[0.0], a * b]))
        return float(np.mean(np.diff(a) * np.diff(b))), float(np.max(held[wide:] - held[:-wide]))

    apart, most = told(at)
    others = np.array([told(rng.permutation(at)) for _ in range(_ORDERS)])
    usual, whole = float(others[:, 0].mean()), float(np.sum(one * two))
    if usual <= 0 or whole <= 0:
        return None
    alike, held = 1 - max(apart, 0.0) / usual, min(most / whole, 1.0)
    if alike > _STRUCTURED and (others[:, 0] > apart).all():
        what = f"{100 * alike:.0f} % of the pattern is shared by neighbouring {axes.varies_over}s"
        return Doubt(alike, (f"{what}, not of single ones",), instead=True)
    if held > _STRUCTURED and (others[:, 1] < most).all():
        what = f"{100 * held:.0f} % of the pattern lies in {wide} neighbouring {axes.varies_over}s"
        return Doubt(held, (f"{what}, not in any",), instead=True)
    return None


def gathered(step: Step) -> Doubt | None:
    """What speaks against a step that names a few pixels anywhere: that most of them lie in few lines or
    blocks, where chance puts as few."""
    signature = step.named.signature
    few = signature.single_pixels or signature.axes.time == BLINKING.time
    if step.named.mechanism == UNKNOWN or not few:
        return None
    pattern = signature.pattern(step.before, step.named.score, np.random.default_rng(0))
    if pattern is None or np.ndim(pattern) != 2:
        return None
    sites = np.abs(pattern) > 0
    if not 0 < sites.sum() < _FEW * sites.size:
        return None
    counts = {
        "columns": sites.sum(0),
        "rows": sites.sum(1),
        f"blocks of {_BLOCK} px": _blocks(sites).ravel(),
    }
    for what, found in counts.items():
        dense = stats.poisson.sf(found - 1, found.mean()) < _CROWDED / found.size
        share = float(found[dense].sum() / sites.sum() - dense.mean())
        if share > _STRUCTURED:
            lines = int(dense.sum())
            where = f"one {what[:-1]}" if lines == 1 and what[-1] == "s" else f"{lines} {what}"
            said = f"{100 * share:.0f} % of these pixels lie in {where}, not anywhere"
            return Doubt(share, (said,), instead=True)
    return None


def _blocks(sites: np.ndarray) -> np.ndarray:
    h, w = (n - n % _BLOCK for n in sites.shape)
    return sites[:h, :w].reshape(h // _BLOCK, _BLOCK, w // _BLOCK, _BLOCK).sum((1, 3))


def _halves(fields: Many) -> tuple[Many, Many]:
    """The recordings in two halves, of the dark and of the lit ones alike."""
    known = sorted((f for f in fields if f.static is not None), key=lambda f: f.lit)
    return tuple(known[0::2]), tuple(known[1::2])


def _map(step: Step, fields: Many, number: int) -> Float[np.ndarray, "h w"] | None:
    """The map of some of the recordings; of noise, its logarithm, drawn as far as they leave it open."""
    signature, score = step.named.signature, step.named.score
    if signature.axes.law == NOISE:
        dark = tuple(f for f in fields if not f.lit and len(f.contrasts))
        factor = signature.pattern(dark, score, np.random.default_rng(number)) if dark else None
        return None if factor is None else np.log(np.maximum(factor, 1e-3)) - np.mean(np.log(factor))
    found = signature.predict(fields, score) if fields else None
    return None if found is None or found.pattern is None or np.ndim(found.pattern) != 2 else found.pattern


def _local(size: tuple[int, int], noise: bool) -> Bool[np.ndarray, "4 i j"]:
    """Scales along neither side of which the structure is a whole line, or smooth along both, as light is; of
    noise, all but that of the whole frame."""
    rows, columns = (bank.scales(bank.cropped_side(n) // 2) for n in size)
    slow_rows = np.array([s.length * _SMOOTH > size[0] for s in rows])
    slow_columns = np.array([s.length * _SMOOTH > size[1] for s in columns])
    whole = np.array([s.whole for s in rows])[:, None] | np.array([s.whole for s in columns])
    out = ~(whole | (slow_rows[:, None] & slow_columns))
    if noise:
        out = np.ones_like(out)
        out[-1, -1] = False
    return np.broadcast_to(out, (4, *out.shape))


def _length(shared: np.ndarray, weight: np.ndarray, size: tuple[int, int]) -> int:
    """Pixels of the blocks that hold most of the structure."""
    _, i, j = np.unravel_index(int(np.argmax(shared * weight)), weight.shape)
    rows, columns = (bank.scales(bank.cropped_side(n) // 2) for n in size)
    return 2 * max(min(rows[i].length, columns[j].length), 1)
