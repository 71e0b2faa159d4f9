"""A mosaic in which every so many pixels were interpolated from the others.

A pixel that holds a share w of its neighbours' mean has less noise and shares it with them. Blending of every
pixel does that as well; but here it is done on a lattice: minus the mean of its neighbours an interpolated
pixel leaves (1 - w) of itself, its neighbours nearly all. Amplifiers of different noise alternate without
any correlation between neighbours.
"""

from __future__ import annotations

from functools import partial, reduce

import numpy as np

from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.defects import KERNELS, MONO_KERNELS
from cannoise_jax.signatures.fields import Fields, without_pixels
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import Score, normal_log_p, sidak
from cannoise_jax.signatures.signature import CONTRASTS, Axes, Signature

_ROWS, _COLUMNS = np.indices((4, 4))
_SITES: np.ndarray = 2 * (_ROWS % 2) + _COLUMNS % 2


def _site(number: int) -> np.ndarray:
    return np.isin(_SITES, [number])


LATTICES: dict[str, np.ndarray] = {
    "chess": (_ROWS // 2 + _COLUMNS // 2) % 2 == 1,
    "row pairs": _ROWS // 2 == 1,
    "column pairs": _COLUMNS // 2 == 1,
    "rows": _ROWS % 2 == 1,
    "columns": _COLUMNS % 2 == 1,
    "quincunx": (_ROWS + _COLUMNS) % 2 == 1,
    **{f"site {s}": _site(s) for s in range(4)},
    **{f"but site {s}": ~_site(s) for s in range(4)},
    "but one of four pairs": (_ROWS // 2 + _COLUMNS // 2) > 0,
}
"""Phases of 4 x 4 pixels that are interpolated; their complements are tried as well."""
_KERNELS = {**KERNELS, **MONO_KERNELS}
_EDGE = 2
"""Rows and columns at the border, whose neighbours are not all in the frame."""
_NAMES = ("four", "row", "column", "next_four", "next_row", "next_column", "eight", "next_eight")
_COST = 8.0
"""Nats of a lattice: log(240) = 5.5 of 8 kernels, 15 lattices and their complements, and 2.5 of the weight.
An Occam factor of a weight between 0 and 1, known to 0.0055 (measured, 32 frames of 96 x 128 pixels), would
be 4.3 instead of 2.5; many of the 240 are alike."""
_LEAST = 0.03
"""Relative difference of what is left on and off the lattice that gains of pixels may make."""
_MOSTLY = 0.5
"""Weight of the neighbours from which on an interpolated pixel is set aside."""
_SHARED = 0.99
"""What is left of a pixel over what would be if its neighbours were independent of it, at most."""


def _phases(values: np.ndarray, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the pixels of every phase `[4, 4]`, and their number."""
    mean, number = np.zeros((4, 4)), np.zeros((4, 4))
    for i in range(4):
        for j in range(4):
            part = usable[i::4, j::4]
            number[i, j] = part.sum()
            mean[i, j] = float(np.sum(values[i::4, j::4] * part)) / max(number[i, j], 1)
    return mean, number


Left = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Per phase: variance of pixels minus the mean of their neighbours over the variance of all, that of pixels
whose neighbours are independent, and how many values it is from."""


def _each_left(fields: tuple[Fields, ...]) -> list[tuple[Fields, list[Left]]]:
    """What each recording of even light shows by every kernel of `_NAMES`."""
    out = []
    for f in fields:
        if not len(f.contrasts) or median(f.sigma) < f.step or f.usable.mean() < 0.5 or f.kind == "scene":
            continue
        c = f.contrasts - f.contrasts.mean(2, keepdims=True)
        c = (c - c.mean(1, keepdims=True)).clip(-6, 6)
        # In units of the noise of the place, smooth over it: a lattice in sigma is part of the effect.
        values = c * (f.sigma / float(median(f.sigma)))
        own = np.einsum("nij,nij->ij", values, values) / len(c)
        usable = f.usable.copy()
        usable[:_EDGE], usable[-_EDGE:], usable[:, :_EDGE], usable[:, -_EDGE:] = False, False, False, False
        out.append((f, [_by_kernel(values, own, usable, _KERNELS[name]) for name in _NAMES]))
    return out


def _by_kernel(
    values: np.ndarray, own: np.ndarray, usable: np.ndarray, kernel: tuple[tuple[int, int], ...]
) -> Left:
    """One recording by one kernel; own: variance of every pixel. Pixels at the border have no neighbours."""
    h, w = own.shape
    inner = (slice(_EDGE, h - _EDGE), slice(_EDGE, w - _EDGE))

    def about(x: np.ndarray) -> np.ndarray:
        near = (x[..., _EDGE + i : h - _EDGE + i, _EDGE + j : w - _EDGE + j] for i, j in kernel)
        return reduce(np.add, near)

    rest = values[:, *inner] - about(values) / len(kernel)
    difference, alone = np.zeros(own.shape, own.dtype), np.zeros(own.shape, own.dtype)
    difference[inner] = np.einsum("nij,nij->ij", rest, rest) / len(values)
    alone[inner] = own[inner] + about(own) / len(kernel) ** 2
    d, number = _phases(difference, usable)
    return d, _phases(alone, usable)[0], number * len(values)


def _together(each: list[Left]) -> Left | None:
    """Of several recordings; None where a phase has no pixels."""
    left, alone, total = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    for d, a, weight in each:
        left, alone, total = left + weight * d, alone + weight * a, total + weight
    return (left / total, alone / total, total) if total.all() else None


def lattice_score(fields: tuple[Fields, ...], *, mono: bool) -> Score | None:
    """Pixels of a lattice that follow their neighbours. Amplitude: weight of the interpolated value."""
    best: tuple[float, float, str, str, float, float, np.ndarray] | None = None
    tried = 0
    each = _each_left(fields)
    for n, name in enumerate(_NAMES):
        kernel = _KERNELS[name]
        found = _together([by[n] for _, by in each])
        dark = _together([by[n] for f, by in each if f.kind in DARK])
        if found is None:
            return None
        left, alone, number = found
        shared = left / alone
        for label, phases in LATTICES.items():
            for on in (phases, ~phases):
                tried += 1
                inside, outside = _mean(left, number, on), _mean(left, number, ~on)
                own_in, own_out = _mean(alone, number, on), _mean(alone, number, ~on)
                # Noise of a lattice of amplifiers goes with the pixels' own variance.
                lost = 1 - inside / outside
                error = float(np.sqrt(3 / number[on].sum() + 3 / number[~on].sum()))
                together = _mean(shared, number, np.ones((4, 4), bool))
                z = (lost - _LEAST) / error
                z_shared = (_SHARED - together) / float(np.sqrt(3 / number.sum()))
                uneven = inside / own_in < outside / own_out - 2 * error
                if uneven and lost > 0 and _in_darks(dark, on, lost):
                    both = min(z, z_shared)
                    if best is None or both > best[0]:
                        weight = 1 - float(
                            np.sqrt(
                                np.clip(
                                    inside / max(1 + 1 / len(kernel), 1e-9) / _scale(own_out, kernel), 0, 1
                                )
                            )
                        )
                        best = (both, z**2 + z_shared**2, label, name, weight, error, on)
    if best is None:
        return _nothing(fields)
    z, power, label, kernel_name, weight, error, on = best
    return Score(
        log_p=sidak(normal_log_p(z, 1), tried),
        gain=0.5 * power if z > 0 else 0.0,
        penalty=_COST,
        amplitude=max(weight, 0.0),
        error=error,
        shift=error,
        power=1,
        parameters={"weight": (weight, "1", error)},
        where={"axis": "pixel", "lattice": label, "from": kernel_name},
        payload=on,
    )


def _in_darks(found: Left | None, on: np.ndarray, lost: float) -> bool:
    """Whether the darks, if there are any, show at least half of what is lost on a lattice: of lit frames
    a noise that neighbours share is another share of the noise where the light is another."""
    if found is None:
        return True
    left, _, number = found
    error = float(np.sqrt(3 / number[on].sum() + 3 / number[~on].sum()))
    return 1 - _mean(left, number, on) / _mean(left, number, ~on) > lost / 2 - 2 * error


def _scale(alone: float, kernel: tuple[tuple[int, int], ...]) -> float:
    """Variance of a pixel of its own from that of the sum with its neighbours' mean."""
    return alone / (1 + 1 / len(kernel))


def _mean(values: np.ndarray, number: np.ndarray, on: np.ndarray) -> float:
    return float(np.sum((values * number)[on]) / number[on].sum())


def _nothing(fields: tuple[Fields, ...]) -> Score:
    number = sum(len(f.contrasts) * f.mean.size for f in fields)
    error = float(np.sqrt(12 / max(number, 1)))
    return Score(
        log_p=0.0,
        gain=0.0,
        penalty=_COST,
        amplitude=0.0,
        error=error,
        shift=error,
        power=1,
        parameters={"weight": (0.0, "1", error)},
        where={"axis": "pixel"},
    )


def without_interpolated(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """The fields without the pixels that are mostly others' mean, which tell nothing of their own and make
    sums over places vary by more."""
    if score.payload is None or score.amplitude < _MOSTLY:
        return fields
    rows, columns = np.indices(fields[0].mean.shape)
    return without_pixels(fields, score.payload[rows % 4, columns % 4])


def interpolated(
    recorded: Recorded, *, name: str, covers: tuple[str, ...], lifted_by: tuple[str, ...]
) -> Signature:
    """Sites of a lattice that are the mean of those beside them."""
    return plain(
        name=name,
        axes=Axes("digital", "pixel", "redrawn", "all noise", "lattice"),
        reads=CONTRASTS,
        score=partial(lattice_score, mono=recorded.mono),
        absorb=without_interpolated,
        simulate=carried(lambda s: {"weight": s.amplitude}),
        covers=covers,
        lifted_by=lifted_by,
    )
