"""What the static part of a recording answers to frozen patterns, once others were taken out of it.

A map of random values of variance v, one for every pixel (or line), with responses b in the recordings, is
whitened in their static parts s by the symmetric root of its covariance:

    s -> s - b (b.s / b.b) (1 - (1 + v b.b)^-1/2)

The noise of s has variance one again, and whatever else stays answers less: its responses go through the same
map. In these terms v b.s is the expectation of the map, given all that is seen, beside all other maps that
were taken out (the best linear unbiased prediction; Robinson 1991, Statistical Science 6, 15).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import cast

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.remembered import Kept

SCALINGS = ("additive", "signal", "exposure", "codes")
"""How a pattern grows: not, with the light, with the exposure. The last, of recordings at several gains, is
added behind the gain: the same number of codes at all of them."""
BY_TURNS = "column by turns"
"""Among the lines: columns of which a pattern turns its sign from row to row."""
_AT_ONE_GAIN = 3
"""How many of them recordings at one gain can tell apart: there the last is the first."""
_NONE = np.zeros((1, 1), np.float32)
"""What nothing answers, to add to."""
_PRODUCTS: Kept[dict[frozenset[str], np.ndarray]] = Kept(4)
"""The last few of `at_first`: those of the frames that look and of all, on two threads."""


def turns(count: int) -> Float[np.ndarray, "n"]:
    """1 and -1 in turn."""
    return (1 - 2 * (np.arange(count) % 2)).astype(np.float32)


def response(field: Fields, scaling: str) -> np.ndarray:
    """What the standardised field answers to a unit effect: 1/sigma (DN), seconds/sigma (DN/s),
    signal/sigma (fraction), or 1/sigma in DN of the recording."""
    # `relative` is the light by the weight, rounded once less.
    return field.relative if scaling == "signal" else field.weight * _unit_effect(field, scaling)


def shows(field: Fields, scaling: str) -> bool:
    """Whether what stays in a recording tells of an effect that scales so."""
    if field.static is None:
        return False
    if field.answers.mixed:  # what others share with it was taken out of all
        return True
    return _has(field, scaling)


def told(fields: Sequence[Fields], scaling: str) -> bool:
    """Whether recordings tell of a frozen pattern that scales so at all. Under light alone what grows with
    the exposure cannot be told from what the light brings: a dark of some exposure has to show it."""
    return scaling != "exposure" or any(
        f.kind in DARK and bool(f.exposure_s) and f.static is not None for f in fields
    )


def stays(field: Fields, axis: str, scaling: str) -> Float[np.ndarray, "h w"]:
    """What the static part, per root of the frames, answers to a unit of a frozen pattern of pixels, rows or
    columns."""
    return field.weight * _in_dn(field, axis, scaling)


def _in_dn(field: Fields, axis: str, scaling: str) -> Float[np.ndarray, "#h #w"]:
    """The same in DN, whatever the noise is taken to be."""
    answers, mixed = field.answers, _looks((field,), axis)
    if mixed is None:
        out = _unit_effect(field, scaling)
    else:
        first = zip(_row(mixed, scaling, field.unit), _told_apart(mixed), strict=True)
        out = sum((share * _unit_effect(field, s) for share, s in first if _has(field, s)), _NONE)
    return out * _as_lines(answers.kept[axis], axis) if axis in answers.kept else out


def _told_apart(mixed: Float[np.ndarray, "k k h w"]) -> tuple[str, ...]:
    """The scalings that patterns were told apart by."""
    return SCALINGS[: len(mixed)]


def _row(mixed: Float[np.ndarray, "k k h w"], scaling: str, unit: float) -> Float[np.ndarray, "k h w"]:
    """What a pattern of this scaling looks like; at one gain, of this unit, one behind it is an offset."""
    if scaling in _told_apart(mixed):
        return mixed[SCALINGS.index(scaling)]
    return mixed[SCALINGS.index("additive")] / np.float32(unit)


def _scalings(fields: tuple[Fields, ...], *asked: str) -> tuple[str, ...]:
    """Those that recordings can tell apart where nothing was taken out of them, and what is asked for."""
    several = "codes" in asked or any(f.unit != fields[0].unit for f in fields)
    return SCALINGS if several else SCALINGS[:_AT_ONE_GAIN]


def _looks(fields: tuple[Fields, ...], axis: str) -> Float[np.ndarray, "k k h w"] | None:
    """What patterns of pixels, rows or columns look like, the same in all recordings; None where nothing was
    taken out."""
    known = next((f.answers.mixed for f in fields if f.answers.mixed), {})
    return known.get(axis, known.get("pixel"))


def _unit_effect(field: Fields, scaling: str) -> Float[np.ndarray, "#h #w"]:
    """What an effect of one DN, of the light itself, of one DN per second, or of one DN of the recording adds
    to the mean, DN, before anything was taken out; light is none in darks."""
    if scaling == "signal":
        return field.signal if field.lit else np.zeros((1, 1), np.float32)
    each = {"additive": 1.0, "exposure": field.exposure_s or 0.0, "codes": 1 / field.unit}
    return np.full((1, 1), each[scaling], np.float32)


def _has(field: Fields, scaling: str) -> bool:
    """Whether an effect that scales so adds anything to the mean."""
    return {"signal": field.lit, "exposure": bool(field.exposure_s)}.get(scaling, True)


def _as_lines(values: np.ndarray, axis: str) -> np.ndarray:
    return values[:, None] if axis == "row" else values[None, :]


def as_it_stays(field: Fields, axis: str = "pixel") -> Fields:
    """The field with the weights that an offset of a single pixel, or of a whole row or column, has in its
    static part, for templates that are fitted to all pixels at once.

    Where maps were taken out that is what a template answers that stays the same in all recordings. Two
    things are left aside. What one of pixels shares with lines that were taken out counts as its own still,
    and one that grows with the exposure answers as an offset does, though of it a map takes another share.
    Pixels that answer the other way round, after maps of several scalings, are not used.
    """
    if not field.answers.mixed and axis not in field.answers.kept:
        return field
    weight = stays(field, axis, "additive")
    seen = field.usable & (weight > 0)
    return field._replace(usable=seen, sigma=np.where(seen, 1 / np.where(seen, weight, 1.0), field.sigma))


def less_map(
    fields: tuple[Fields, ...], scaling: str, variance: float, apart: Bool[np.ndarray, "h w"]
) -> tuple[Fields, ...]:
    """The fields with a map of pixels of this variance whitened. apart: pixels that are no part of it.

    The means of lines of which something was taken out before answer less to the map than single pixels do:
    they are whitened by their own answers."""
    shown = [f for f in fields if f.static is not None]
    axes = {axis for f in shown for axis in (*f.answers.mixed, *f.answers.kept)} - {"pixel"}
    static = {f.number: cast(np.ndarray, f.static) for f in shown}
    whitened = {n: np.zeros(values.shape) for n, values in static.items()}
    mixed = {}
    for axis in (*sorted(axes), "pixel"):
        answers = [stays(f, axis, scaling).astype(np.float64) for f in shown]
        information = sum((f.frames * b**2 for f, b in zip(shown, answers, strict=True)), np.float64(0))
        share = (1 - 1 / np.sqrt(1 + variance * information)) / np.maximum(information, 1e-30)
        share = np.where(apart, 0.0, share) if axis == "pixel" else share
        part = static
        if axis != "pixel":
            part = {f.number: _by_lines(static[f.number], stays(f, "pixel", scaling), axis) for f in shown}
            static = {n: static[n] - part[n] for n in static}
        roots = [np.sqrt(f.frames) * b for f, b in zip(shown, answers, strict=True)]
        fall = share * sum((b * part[f.number] for f, b in zip(shown, roots, strict=True)), np.float64(0))
        for f, b in zip(shown, roots, strict=True):
            whitened[f.number] += part[f.number] - b * fall
        along = along_fields(fields, axis, scaling)
        mixed[axis] = _mixed(fields, axis, scaling, along, partial(np.multiply, share))
    return tuple(
        f
        if f.static is None
        else f._replace(
            static=whitened[f.number].astype(np.float32),
            answers=f.answers._replace(mixed=mixed, apart={**f.answers.apart, scaling: apart}),
        )
        for f in fields
    )


def _by_lines(values: np.ndarray, response: np.ndarray, axis: str) -> Float[np.ndarray, "h w"]:
    """The part of the values that the pixels of a line share."""
    if axis == BY_TURNS:
        signs = turns(len(values))[:, None]
        return _by_lines(values * signs, response, "column") * signs
    along = 1 if axis == "row" else 0
    r = response.astype(np.float64)
    mean = np.sum(values * r, along, keepdims=True) / np.maximum(np.sum(r**2, along, keepdims=True), 1e-30)
    return mean * r


def less_lines(
    fields: tuple[Fields, ...],
    axis: str,
    scaling: str,
    *,
    along: Callable[[str], Float[np.ndarray, "h w"]],
    taken: Callable[[np.ndarray], Float[np.ndarray, "h w"]],
    score: Float[np.ndarray, "g"],
    told: tuple[Bool[np.ndarray, "h w"], Float[np.ndarray, "g"]],
) -> tuple[Fields, ...]:
    """The fields with a pattern of lines whitened. along: of `along_fields`. taken: of sums over the pixels
    of every line, or of products of two responses of pixels, what is taken out of each pixel; score: sums of
    response times static part; told: see `Answers.lines`."""
    mixed, spread = _mixed(fields, axis, scaling, along, taken), taken(score)
    out = []
    for f in fields:
        if f.static is None:
            out.append(f)
            continue
        b = stays(f, axis, scaling)
        static = (f.static - np.sqrt(f.frames) * spread * b).astype(np.float32)
        answers = f.answers._replace(
            mixed={**f.answers.mixed, axis: mixed}, lines={**f.answers.lines, axis: told}
        )
        out.append(f._replace(static=static, answers=answers))
    return tuple(out)


def _mixed(
    fields: tuple[Fields, ...],
    axis: str,
    scaling: str,
    along: Callable[[str], Float[np.ndarray, "h w"]],
    taken: Callable[[np.ndarray], np.ndarray],
) -> Float[np.ndarray, "k k h w"]:
    """What patterns look like once one that scales so is whitened. along: of `along_fields`. taken: of the
    sums over recordings of its response times another, the share of it that goes."""
    size = fields[0].mean.shape
    before = _looks(fields, axis)
    if before is None:
        k = len(_scalings(fields, scaling))
        before = np.broadcast_to(np.eye(k, dtype=np.float32)[:, :, None, None], (k, k, *size))
    own = _row(before, scaling, fields[0].unit)
    falls = np.stack([taken(along(s)) for s in _told_apart(before)])
    return (before - falls[:, None] * own).astype(np.float32)


def along_fields(
    fields: tuple[Fields, ...], axis: str, scaling: str
) -> Callable[[str], Float[np.ndarray, "h w"]]:
    """By scaling: the sum over recordings of what the static part answers to a pattern of pixels, rows or
    columns that scales so, times what it answers to this one.

    What a pattern looks like as those that are told apart, M, is the same in all recordings: the sum is
    M G M^T, with the sums G over recordings of products of these as they were at first.
    """
    mixed = _looks(fields, axis)
    if mixed is None:
        first = at_first(fields, axis, _scalings(fields, scaling))
        return lambda other: first[frozenset((scaling, other))]
    names = _told_apart(mixed)
    products = at_first(fields, axis, names)
    unit = fields[0].unit
    own = _row(mixed, scaling, unit)
    mine = [
        sum((share * products[frozenset((a, b))] for share, a in zip(own, names, strict=True)), _NONE)
        for b in names
    ]
    return lambda other: sum((s * m for s, m in zip(_row(mixed, other, unit), mine, strict=True)), _NONE)


def at_first(
    fields: tuple[Fields, ...], axis: str, names: tuple[str, ...]
) -> dict[frozenset[str], Float[np.ndarray, "h w"]]:
    """By two scalings: sums over recordings of the products of what they answer to both before anything was
    taken out of all of them. Taking out what stays leaves them as they are, so that they are kept."""
    shown = [f for f in fields if f.static is not None]
    arrays = [x for f in shown for x in (f.usable, f.sigma, f.signal, f.answers.kept.get(axis))]
    of_each = tuple((f.frames, f.exposure_s, f.unit, f.lit) for f in shown)
    size = fields[0].mean.shape
    return _PRODUCTS.of(arrays, (axis, names, of_each, size), lambda: _products(shown, axis, names, size))


def _products(
    shown: Sequence[Fields], axis: str, names: tuple[str, ...], size: tuple[int, ...]
) -> dict[frozenset[str], Float[np.ndarray, "h w"]]:
    out = {frozenset((a, b)): np.zeros(size) for a in names for b in names}
    for f in shown:
        square = f.frames * f.weight.astype(np.float64) ** 2
        if axis in f.answers.kept:
            square = square * _as_lines(f.answers.kept[axis].astype(np.float64), axis) ** 2
        for pair in out:
            a, b = min(pair), max(pair)
            if _has(f, a) and _has(f, b):
                out[pair] += square * (_unit_effect(f, a).astype(np.float64) * _unit_effect(f, b))
    return out


def through(field: Fields, axis: str, function: Callable[[np.ndarray], np.ndarray]) -> Float[np.ndarray, "g"]:
    """What is left of what lines share in the static part once it went through `function`."""
    before = field.weight
    along = 1 if axis == "row" else 0
    square = np.sum(before.astype(np.float64) ** 2, along)
    after = np.sum(function(before[None])[0] * before.astype(np.float64), along)
    return np.where(square > 0, after / np.maximum(square, 1e-30), 1.0).astype(np.float32)


def less_shared(field: Fields, axis: str, left: Float[np.ndarray, "g"]) -> Fields:
    """The field of which so much of what lines share is left in the static part."""
    kept = field.answers.kept
    left = kept[axis] * left if axis in kept else left
    return field._replace(answers=field.answers._replace(kept={**kept, axis: left}))
