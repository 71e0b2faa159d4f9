"""Pixels that jump between levels where every pixel has a read noise of its own: how noisy a pixel is does
not tell them there, how its frames lie does.

The frames of a normal pixel over their own standard deviation have one law, whatever that is (Basu's
theorem), so the likelihood of two levels over that of normal noise of the same variance is drawn from one law
for all pixels that do not jump. The noisiest are held against pixels as loud as most; of each pixel the frame
that is farthest off is left out, which may be a hit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import special

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.charge_noise import own_charge
from cannoise_jax.signatures.fields import Fields, without_pixels
from cannoise_jax.signatures.handed import Addition, Found, Many
from cannoise_jax.signatures.jumps import at_levels, frames_of
from cannoise_jax.signatures.known_shape import darks
from cannoise_jax.signatures.plain import plain
from cannoise_jax.signatures.score import SHARE_OF_FEW, Score, normal_log_p
from cannoise_jax.signatures.signature import BLINKING, Axes, Signature
from cannoise_jax.signatures.squares import READS, dark_sigma, square_map

_NOISY = 0.04
"""Share of the pixels, the noisiest, that are looked at: of one in a hundred that jumps nearly all."""
_FRAMES, _FEWEST = 8, 40
"""Frames of all darks together, and pixels, from which on they are."""
_MOST = 200_000
"""Values that are looked at."""
_HIGH = (0.2, 0.35, 0.5, 0.65, 0.8)
"""Shares of the time in the higher of two levels that are tried: rarer ones are single outliers."""
_WITHIN = (0.1, 0.22, 0.4)
"""Of a pixel's variance, that within a level, shares that are tried."""
_PLACES = 8
"""Places of the mean of a recording between the levels that are tried."""
_MOST_NATS = 8.0
"""What one pixel may count."""
_ROUGH = 0.2
"""Share of strength, number and size that is not known beyond counting: of planted ones 0.7 to 1.15 of the
strength came back, less where jumps are small or of three levels."""
_AGAIN, _ORDINARY = 4, 5000
"""Contrasts of other frames from which on they tell whether pixels jump, and ordinary pixels beside them."""
_SURELY = 0.5
"""Of the pixels that are found, that are taken to show in other frames that they jump: of planted ones 0.85
and more jump, but not all do so in a few frames."""
_SHARE = 0.05
"""Of the pixels that are looked at, that are taken to jump."""


class Levels(NamedTuple):
    """Of every pixel the log-likelihood of the best two levels over that of normal noise of its own variance,
    and the distance of these levels over its standard deviation."""

    ratio: Float[np.ndarray, "k"]
    jump: Float[np.ndarray, "k"]


def levels_over_normal(frames: list[Float[np.ndarray, "t k"]]) -> Levels:
    """frames: of each recording, in any unit."""
    kept = _without_farthest(frames)
    number = [k.sum(0) for k in kept]
    about = [
        (x - np.sum(x * k, 0) / np.maximum(n, 1)) * k for x, k, n in zip(frames, kept, number, strict=True)
    ]
    freedom = sum(len(x) - 1 for x in frames) - 1
    scale = np.sqrt(np.maximum(sum(np.sum(x**2, 0) for x in about) / freedom, 1e-30))
    best, jump = np.full(scale.shape, -np.inf), np.zeros(scale.shape)
    for within in _WITHIN:
        for share in _HIGH:
            apart = float(np.sqrt((1 - within) / (share * (1 - share))))
            levels = np.log([1 - share, share])
            found = sum(
                at_levels(x / scale, apart, levels, within, k, _PLACES)
                for x, k in zip(about, kept, strict=True)
            )
            jump, best = np.where(found > best, apart, jump), np.maximum(best, found)
    return Levels(best + 0.5 * freedom, jump)


def _without_farthest(frames: list[Float[np.ndarray, "t k"]]) -> list[Bool[np.ndarray, "t k"]]:
    """Which frames are kept: all but the one that lies farthest off the median of its recording."""
    off = np.concatenate([np.abs(x - median(x, 0)) for x in frames])
    kept = np.ones(off.shape, bool)
    kept[np.argmax(off, 0), np.arange(off.shape[1])] = False
    return np.split(kept, np.cumsum([len(x) for x in frames])[:-1])


class _Jumping(NamedTuple):
    """Of the pixels that are looked at: where, the chance that each jumps, and by how much, in units of the
    noise of most. above: by how much they speak for levels more than ordinary ones do, and its error."""

    at: np.ndarray
    chance: np.ndarray
    jump: np.ndarray
    above: tuple[float, float]


def _of_several(fields: Many) -> list[Fields]:
    """The darks in which a level shows."""
    return [f for f in darks(fields) if f.frames > 2]


def _against_ordinary(
    fields: Many, pixels: Int[np.ndarray, "k"], order: Int[np.ndarray, "n"], most: int
) -> tuple[Levels, Float[np.ndarray, "m"], float]:
    """What some pixels speak for levels, and what ordinary ones do, each bounded, and the logarithm of the
    mean likelihood of the latter: of the best of many laws it is to be one there. order: of pixels by how
    noisy they are; most: ordinary ones that are looked at, of the middle half."""
    middle = order[len(order) // 4 : -len(order) // 4]
    ordinary = middle[np.linspace(0, len(middle) - 1, min(len(middle), most)).astype(int)]
    seen, charge = _of_several(fields), own_charge(fields)
    own, others = (
        v._replace(ratio=np.minimum(v.ratio, _MOST_NATS))
        for v in (levels_over_normal(frames_of(seen, at, charge)) for at in (pixels, ordinary))
    )
    return own, others.ratio, float(special.logsumexp(others.ratio)) - float(np.log(ordinary.size))


def _look(fields: Many) -> _Jumping | None:
    found, seen = square_map(fields), _of_several(fields)
    if found is None or sum(f.frames for f in seen) < _FRAMES:
        return None
    squares, usable, freedom = found
    most = min(int(_NOISY * usable.sum()), _MOST // sum(f.frames for f in seen))
    order = np.flatnonzero(usable)[np.argsort(squares[usable])]
    if most < _FEWEST:
        return None
    noisy = order[-most:]
    own, b, mean = _against_ordinary(fields, noisy, order, most)
    a = own.ratio
    each, others = (np.log1p(_SHARE * np.expm1(v - mean)) for v in (a, b))
    error = float(np.sqrt((np.var(each) + np.var(others)) / most))
    ratio, share = a - mean, _SHARE
    for _ in range(50):
        chance = share * np.exp(ratio) / (1 - share + share * np.exp(ratio))
        share = float(np.clip(chance.mean(), 1e-6, 0.9))
    spread = np.sqrt(squares.ravel()[noisy] / freedom)
    return _Jumping(noisy, chance, own.jump * spread, (float(np.mean(each) - np.mean(others)), error))


def beside_score(fields: Many) -> Score[np.ndarray] | None:
    """Payload: the jumps, DN, at the pixels that more likely jump than not `[h, w]`."""
    found = _look(fields)
    if found is None:
        return None
    size = fields[0].mean.shape
    sigma, (above, error) = dark_sigma(tuple(darks(fields))), found.above
    z = above / max(error, 1e-12)
    number = float(found.chance.sum())
    jumps = np.zeros(size[0] * size[1])
    jumps[found.at] = np.where(found.chance > 0.5, found.jump * sigma, 0.0)
    mean = float(np.sum(found.chance * found.jump)) / max(number, 1e-12)
    share = number / jumps.size
    # A pixel is as often in either level as not: its variance is a quarter of the square of the jump.
    amplitude = sigma * float(np.sqrt(np.sum(found.chance * found.jump**2) / 4 / jumps.size))
    doubt = float(np.hypot(_ROUGH, 1 / np.sqrt(max(number, 1.0))))
    return Score(
        log_p=normal_log_p(z, 1),
        gain=0.5 * max(z, 0.0) ** 2,
        penalty=SHARE_OF_FEW,
        amplitude=amplitude,
        error=amplitude * doubt,
        shift=amplitude / max(z, 1.0),
        power=1,
        parameters={
            "fraction": (share, "1", share * doubt),
            "jump": (mean * sigma, "DN", mean * sigma * doubt),
        },
        where={"axis": "pixel", "pixels": int(np.count_nonzero(jumps))},
        payload=jumps.reshape(size),
    )


def beside_again(fields: Many, found: Score[np.ndarray]) -> Score[np.ndarray] | None:
    """Other frames, which had no part in choosing the pixels: whether those of the pixels that jump lie on
    levels more than those of ordinary ones, whose law all have that do not, and how noisy they are again."""
    squares = square_map(fields)
    if squares is None or sum(len(f.contrasts) for f in _of_several(fields)) < _AGAIN:
        return None
    whole, usable, freedom = squares
    sites = np.flatnonzero((found.payload > 0) & usable)
    order = np.flatnonzero(usable & (found.payload == 0))
    order = order[np.argsort(whole.ravel()[order], kind="stable")]
    if not sites.size or order.size < _FEWEST:
        return None
    levels, others, mean = _against_ordinary(fields, sites, order, _ORDINARY)
    own = levels.ratio
    each = np.log1p(_SURELY * np.expm1(own - mean))
    z = float(np.mean(own) - np.mean(others)) / (float(np.std(others)) / np.sqrt(sites.size))
    gain = float(np.sum(each))
    # What they have beyond ordinary pixels, against what they were found to.
    expected = (found.payload.ravel()[sites] / dark_sigma(tuple(darks(fields)))) ** 2 / 4
    excess = whole.ravel()[sites] / freedom - 1
    share = float(expected @ excess) / max(float(np.sum(expected**2)), 1e-12)
    root = float(np.sqrt(np.clip(share, 0.0, 4.0)))
    amplitude = found.amplitude * root
    return found.replace(
        log_p=normal_log_p(z, 1), gain=gain, penalty=SHARE_OF_FEW, amplitude=amplitude,
        error=max(found.error * root, found.amplitude * _ROUGH / np.sqrt(sites.size)),
        shift=amplitude / max(z, 1.0),
    )  # fmt: skip


def _without(fields: Many, score: Score[np.ndarray]) -> Many:
    return without_pixels(tuple(fields), score.payload > 0)


def beside_a_map(
    *, name: str, after: str, simulate: Callable[[Found], Addition], covers: tuple[str, ...]
) -> Signature:
    """Pixels that jump, looked for once each has a read noise of its own. after: the signature of that, in
    which they are counted until then."""

    def pattern(fields: Many, score: Score[np.ndarray], rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
        return score.payload / 2

    return plain(
        name=name,
        axes=Axes("readout", "pixel", BLINKING.time, "additive", "two levels"),
        reads=READS,
        score=beside_score,
        again=beside_again,
        absorb=_without,
        pattern=pattern,
        simulate=simulate,
        covers=covers,
        after=after,
        found_in=(after,),
        single_pixels=True,
    )
