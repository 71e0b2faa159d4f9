"""What the sites of a sensor without colours have apart in the light.

Rows, columns or diagonals that are read by turns have converters of their own, whose gains differ, or bend
at another signal. A sensor with colours has other light at every site, so that its flats cannot tell; one
without has the same, but for a gradient, which the mean of the neighbours on both sides has as well. What
pixels, rows and columns have apart by chance is told by the scatter of bands of the frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.recording import mosaic_map
from cannoise_jax.signatures.added import placed
from cannoise_jax.signatures.channel_levels import CONTRASTS, parted_errors, shortest_dark
from cannoise_jax.signatures.fields import Fields, mean_of_frames, native
from cannoise_jax.signatures.handed import Addition, Found, Many
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.remembered import remembered
from cannoise_jax.signatures.scatter import scatter
from cannoise_jax.signatures.score import ONE_PARAMETER, Score, sidak, student_log_p
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_CLOSED_FORM,
    NO_LAW,
    NOT_SIMULATED,
    STATIC,
    Axes,
    Signature,
    unchanged,
)

_AROUND = (
    ("rows", np.array([[0.0, 1, 0], [0, 0, 0], [0, 1, 0]]) / 2),
    ("columns", np.array([[0.0, 0, 0], [1, 0, 1], [0, 0, 0]]) / 2),
    ("diagonals", np.array([[0.0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4),
)
"""What is read by turns, in the order of `CONTRASTS`, and the mean of the neighbours of the other kind."""
_FAR = 6.0
"""Standard deviations from the median to which a pixel counts."""
_STEADY = 1e-3
"""Chance below which a share of the light is another one in other flats."""


class Parted(NamedTuple):
    """By how much the sites of one flat differ, as shares of the light: half the difference of each kind [3],
    the variance of each by the noise of the pixels, the level, DN, and what every cell of 2 x 2 pixels adds
    to each beyond the mean [3, h, w]."""

    value: Float[np.ndarray, "3"]
    noise: float
    level: float
    cells: Float[np.ndarray, "3 h w"]


class Sites(NamedTuple):
    """Half the difference of even and odd rows, columns and diagonals as shares of the light; by flat, its
    level, DN, and these; whether all flats have the same."""

    shares: Float[np.ndarray, "3"]
    by_level: tuple[tuple[float, tuple[float, ...]], ...]
    steady: bool


def _parted(f: Fields, light: Float[np.ndarray, "h w"]) -> Parted | None:
    """Of the usable pixels of one flat; None where it shows no light."""
    rows, columns = (n // 2 * 2 for n in light.shape)
    if min(rows, columns) < 8 or not f.usable.any():
        return None
    level = float(np.mean(light[f.usable]))
    if level <= 0:
        return None
    values, cells = [], []
    smooth = np.maximum(ndimage.uniform_filter(light, 16, mode="nearest"), 0.1 * level)
    for (_, around), signs in zip(_AROUND, CONTRASTS, strict=True):
        apart = (light - ndimage.correlate(light, around, mode="nearest")) / (2 * smooth)
        known = f.usable & (ndimage.correlate(f.usable.astype(np.float64), around, mode="nearest") > 0.999)
        known[[0, -1]] = known[:, [0, -1]] = False
        apart *= mosaic_map(signs.astype(np.float64), f.mean.shape)
        middle = median(apart[known]) if known.any() else 0.0
        limit = _FAR * robust_std(apart[known], 0.0) if known.any() else 0.0
        apart = np.where(known, np.clip(apart, middle - limit, middle + limit), 0.0)
        number = max(int(known.sum()), 1)
        values.append(float(apart.sum()) / number)
        away = np.where(known, apart - values[-1], 0.0)[:rows, :columns] / number
        cells.append(away.reshape(rows // 2, 2, columns // 2, 2).sum((1, 3)))
    noise = float(np.mean(f.sigma[f.usable].astype(np.float64) ** 2)) / f.frames / level**2
    return Parted(np.array(values), noise / f.usable.sum(), level, np.array(cells))


Look = Callable[[Fields], Parted | None]


def looking_at(flats: Sequence[Fields]) -> Look:
    """`_parted` of the light of these flats as they were recorded, whatever was taken out of them since, by
    the pixels that are usable now; of other flats, as draws of a simulator, of what is left of them."""
    recorded = {f.number: (native(f).mean, _light(native(f))) for f in flats if f.static is not None}

    @remembered("usable", "mean", "static", "sigma")
    def look(f: Fields) -> Parted | None:
        if f.kind != "flat" or f.static is None:
            return None
        own = native(f)
        mean, light = recorded.get(f.number, (None, None))
        alike = mean is not None and mean.shape == own.mean.shape and np.allclose(mean, own.mean, 1e-5, 1e-3)
        return _parted(own, light if light is not None and alike else _light(own))

    return look


def _light(f: Fields) -> Float[np.ndarray, "h w"]:
    """Mean of all frames above black, DN."""
    black = mosaic_map(np.asarray(f.black, np.float64), f.mean.shape)
    return (mean_of_frames(f) - black).astype(np.float32)


def errors_of_black(darks: Sequence[Fields]) -> dict[int, Float[np.ndarray, "3"]]:
    """By gain setting, by how much the black levels of even and odd rows, columns and diagonals may part by
    the scatter of its shortest dark, which they were told by; half the difference, DN."""
    told = [f for f in darks if f.static is not None]
    groups = {f.group for f in told}
    return {g: parted_errors(native(shortest_dark([f for f in told if f.group == g]))) for g in groups}


def sites_score(
    fields: tuple[Fields, ...], *, look: Look, black: Mapping[int, Float[np.ndarray, "3"]]
) -> Score[Sites] | None:
    """Differences of the sites in the flats, the same share of the light in all or not. black: see
    `errors_of_black`; flats of a setting without darks tell nothing, for their black level is what was
    stated."""
    seen = [(f, p) for f in fields if f.lit and f.group in black and (p := look(f)) is not None]
    if not seen:
        return None
    told = [p for _, p in seen]
    level, noise = np.array([p.level for p in told]), np.array([p.noise for p in told])
    # Of each flat and kind, by what the black level of its setting may be off.
    off = np.array([black[f.group] for f, _ in seen]) / level[:, None]
    weight = 1 / (noise + np.mean(off**2, 1))
    weight /= weight.sum()
    mean = np.tensordot(weight, [p.value for p in told], 1)
    cells = np.tensordot(weight, [p.cells for p in told], 1)
    groups = np.array([f.group for f, _ in seen])
    log_p, errors, gain = [], [], 0.0
    for k in range(3):
        variance, freedom = scatter(cells[k])
        # What the black level is off by is the same in all flats of a setting.
        shared = sum(float(weight[groups == g] @ off[groups == g, k]) ** 2 for g in set(groups))
        variance = max(variance, float(np.sum(weight**2 * noise))) + shared
        if not np.isfinite(variance) or freedom < 1:
            return None
        z = mean[k] / np.sqrt(variance)
        log_p.append(student_log_p(z, freedom))
        errors.append(variance)
        gain += _gain(z, freedom)
    changes = _changes(told, weight, mean, cells, off)
    log_p += [p for p, _ in changes]
    # One flat less than there are can differ from their mean.
    gain += sum(g for _, g in changes) * (len(told) - 1) / len(told)
    steady = bool(changes) and min(p for p, _ in changes) > np.log(_STEADY / len(changes))
    amplitude, error = float(np.sqrt(np.sum(mean**2))), float(np.sqrt(np.mean(errors)))
    names = [name for name, *_ in _AROUND]
    largest = int(np.argmax(np.abs(mean)))
    return Score(
        log_p=sidak(min(log_p), len(log_p)),
        gain=gain,
        penalty=len(log_p) * ONE_PARAMETER / 2,
        amplitude=amplitude,
        error=error,
        shift=error,
        power=1,
        parameters={"sigma": (amplitude, "1", error)},
        where={"axis": "channel", "channel": f"even and odd {names[largest]}"},
        payload=Sites(mean, tuple((p.level, tuple(map(float, p.value))) for p in told), bool(steady)),
    )


def _changes(
    told: list[Parted], weight: np.ndarray, mean: np.ndarray, cells: np.ndarray, off: np.ndarray
) -> list[tuple[float, float]]:
    """Log p and nats of what each flat differs by from all of them, of each kind: frozen patterns that are
    the same share of the light are in none of it. off: by what the black level may be, see `sites_score`."""
    out = []
    for n, p in enumerate(told if len(told) > 1 else []):
        for k in range(3):
            variance, freedom = scatter(p.cells[k] - cells[k])
            variance = max(variance, p.noise * max(1 - weight[n], 0.0))
            variance += float(off[n, k] - weight @ off[:, k]) ** 2
            if not np.isfinite(variance) or variance <= 0 or freedom < 1:
                continue
            z = (p.value[k] - mean[k]) / np.sqrt(variance)
            out.append((float(student_log_p(z, freedom)), _gain(z, freedom)))
    return out


def _gain(z: float, freedom: float) -> float:
    """Nats of a value whose variance the scatter of a few bands tells, over none: the likelihood ratio of
    Student's law."""
    return float(0.5 * (freedom + 1) * np.log1p(z**2 / freedom))


def apart(recorded: Recorded, *, name: str, covers: tuple[str, ...]) -> tuple[Signature, ...]:
    """Sites that answer to the light apart, of a sensor without colours."""
    if not recorded.mono:
        return ()
    look = looking_at(recorded.flats)

    def pattern(fields: Many, score: Score[Sites], rng: np.random.Generator) -> np.ndarray:
        return mosaic_map(score.payload.shares @ CONTRASTS, fields[0].mean.shape)

    steadily = placed(Point("photons", "mean", "channel", "frozen", "multiply"))

    def place(found: Found) -> Addition | None:
        return steadily(found) if found.score.payload.steady else None

    def kind(score: Score[Sites]) -> str:
        k = int(np.argmax(np.abs(score.payload.shares)))
        what = f"even and odd {_AROUND[k][0]} differ by"
        if score.payload.steady:
            return f"{what} {200 * score.payload.shares[k]:.2g} % of the light"
        by = sorted((level, 200 * values[k]) for level, values in score.payload.by_level)
        shares = ", ".join(f"{percent:.2g} % at {level:.0f} DN" for level, percent in by)
        return f"{what} a share of the light that may be another one at another signal: {shares}"

    return (
        Signature(
            name=name,
            axes=Axes("photons", "channel", "frozen", "signal", "contrast"),
            reads=STATIC | {"mean"},
            score=partial(sites_score, look=look, black=errors_of_black(recorded.unlit)),
            absorb=unchanged,
            covers=covers,
            predict=NO_LAW,
            pattern=pattern,
            simulate=NOT_SIMULATED,
            place=place,
            detectable=BY_SHIFT,
            least=NO_CLOSED_FORM,
            kind=kind,
        ),
    )
