"""Frozen maps that lie over each other are told apart, and drawn together no stronger than they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from cannoise_jax.signatures import joint
from cannoise_jax.signatures.fields import Fields
from tests.discovery.looks import SIGNATURES, white

SIZE = (24, 36)
RECORDED = (("dark", 0.0, 6), ("dark", 10.0, 6), ("dark", 30.0, 6), ("flat", 0.01, 4), ("flat", 0.02, 4))
TRUE = {
    "pixel_additive_static": 1.5,
    "pixel_thermal_static": 0.08,
    "pixel_relative_static": 0.01,
    "column_additive_static": 0.8,
    "column_relative_static": 0.004,
    "row_additive_static": 0.5,
}
"""Standard deviations: DN, DN/s or fractions."""
LINES_ANYHOW = (
    "pixel_relative_static",
    "pixel_thermal_static",
    "pixel_additive_static",
    "row_additive_static",
    "column_relative_static",
    "column_additive_static",
)
ORDERS = (tuple(TRUE), LINES_ANYHOW)
"""Pixels before lines, as the search takes them out."""


class Planted(NamedTuple):
    """Fields with maps, the maps, and the shape of each."""

    fields: tuple[Fields, ...]
    maps: dict[str, np.ndarray]


def planted(seed: int, size=SIZE, row_noise: float = 0.0) -> Planted:
    """Maps in recordings of darks and flats of 200 and 800 DN; the noise of a pixel is 2 DN."""
    rng = np.random.default_rng(seed)
    shapes = {"pixel": size, "column": (1, size[1]), "row": (size[0], 1)}
    maps = {}
    for name, sigma in TRUE.items():
        values = sigma * rng.standard_normal(shapes[name.split("_")[0]])
        maps[name] = values if name.startswith("pixel") else values - values.mean()
    (like,) = white(rng, kinds=("dark",), size=size)
    fields = []
    for n, (kind, seconds, frames) in enumerate(RECORDED):
        signal = np.full(size, 0.0 if kind == "dark" else 200.0 + 600.0 * (seconds > 0.01), np.float32)
        sigma = np.sqrt(4.0 + 0.5 * signal).astype(np.float32)
        unit = {"additive": 1.0, "thermal": seconds, "relative": signal}
        mean = sum(unit[name.split("_")[1]] * value for name, value in maps.items())
        values = mean + sigma * rng.standard_normal((frames, *size))
        values = (values + row_noise * rng.standard_normal((frames, size[0], 1))).astype(np.float32)
        matrix = contrasts_of(frames)
        contrasts = np.einsum("nt,tij->nij", matrix, values) / sigma
        static = values.mean(0) / sigma * np.sqrt(frames)
        fields.append(
            like._replace(
                name=f"{kind} {n}",
                kind=kind,
                number=n,
                frames=frames,
                exposure_s=seconds,
                signal=signal,
                sigma=sigma,
                shot=0.5 * signal / sigma**2,
                usable=np.ones(size, bool),
                contrasts=contrasts.astype(np.float32),
                static=static.astype(np.float32),
            )
        )
    return Planted(tuple(fields), maps)


def contrasts_of(frames: int) -> np.ndarray:
    """Orthonormal contrasts of so many frames."""
    centred = np.eye(frames) - 1 / frames
    return np.linalg.svd(centred)[2][: frames - 1].astype(np.float32)


def taken_out(fields, order, known: bool):
    """What is left of the fields, and the maps as they were taken out: at the strength that they have, or as
    the fields tell it beside those before."""
    maps = []
    for name in dict.fromkeys(order):
        signature = SIGNATURES[name]
        score = signature.score(fields)
        score = score.replace(payload=TRUE[name] ** 2) if known else score
        fields = signature.absorb(fields, score)
        maps.append(joint.FrozenMap(*signature.map_of, score.payload))
    return fields, tuple(dict.fromkeys(order)), maps


def dense(fields, name_of_all):
    """Expectation and variance of every map by the textbook: normal numbers of known variance seen in white
    noise."""
    size = fields[0].mean.shape
    rows, columns = np.indices(size)
    place = {"pixel": np.arange(rows.size), "row": rows.ravel(), "column": columns.ravel()}
    designs, priors, where = [], [], {}
    start = 0
    for name in name_of_all:
        axis, scaling = name.split("_")[:2]
        number = place[axis].max() + 1
        blocks = []
        for f in fields:
            unit = {"additive": np.ones(size), "thermal": np.full(size, f.exposure_s), "relative": f.signal}
            response = (np.sqrt(f.frames) / f.sigma * unit[scaling]).ravel()
            block = np.zeros((rows.size, number))
            block[np.arange(rows.size), place[axis]] = response
            blocks.append(block)
        designs.append(np.concatenate(blocks))
        priors.append(np.full(number, TRUE[name] ** 2))
        where[name] = slice(start, start + number)
        start += number
    design, prior = np.concatenate(designs, 1), np.concatenate(priors)
    seen = np.concatenate([f.static.ravel() for f in fields])
    covariance = np.linalg.inv(design.T @ design + np.diag(1 / prior))
    mean = covariance @ (design.T @ seen)
    return {name: (mean[at], np.diag(covariance)[at]) for name, at in where.items()}


@pytest.mark.parametrize("order", ORDERS, ids=["one", "other"])
def test_they_are_expected_as_normal_numbers_in_white_noise_are(order):
    """Against the normal equations of all numbers at once, in double precision, in whatever order the maps
    were taken out."""
    fields, maps = planted(1)
    left, names, taken = taken_out(fields, order, known=True)
    sigma = [TRUE[name] for name in names]
    wanted = dense(fields, names)
    for name, found in zip(names, joint.predicted(left, taken, sigma), strict=True):
        mean, variance = wanted[name]
        got = found.pattern.ravel()
        spread = np.sqrt(np.mean(mean**2))
        if not name.startswith("pixel"):  # of lines the common mean is the level's
            mean, got = mean - mean.mean(), got - got.mean()
        assert np.sqrt(np.mean((got - mean) ** 2)) < 0.13 * spread, name
        # That of pixels is given the lines.
        least, most = (0.7, 1.02) if name.startswith("pixel") else (0.8, 1.2)
        assert least < np.mean(found.doubt) / np.mean(variance) < most, name


@pytest.mark.parametrize("row_noise", [0.0, 1.0])
@pytest.mark.parametrize("order", ORDERS, ids=["one", "other"])
def test_they_are_as_strong_as_they_were_planted(order, row_noise):
    """Beside each other, whatever strengths they were taken out with; a row offset in every frame as well."""
    far = []
    for seed in range(4):
        fields, maps = planted(10 + seed, (48, 64), row_noise)
        if row_noise:
            rows = SIGNATURES["row_additive_temporal"]
            fields = rows.absorb(fields, rows.score(fields))
        left, names, taken = taken_out(fields, order, known=False)
        for name, told in zip(names, joint.strengths(left, taken), strict=True):
            # The map that was drawn is less certain than the strength that it was drawn with.
            far.append((told.sigma - float(np.std(maps[name]))) / told.error)
    assert np.sqrt(np.mean(np.square(far))) < 1.3
    assert abs(np.mean(far)) < 0.5


@pytest.mark.parametrize("order", ORDERS, ids=["one", "other"])
def test_pixels_far_out_of_one_map_change_no_other(order):
    """A few pixels collect forty times as much as most: that is no offset of theirs, nor of their lines."""
    fields, maps = planted(5, (48, 64))
    rng = np.random.default_rng(6)
    few = rng.random((48, 64)) < 0.03
    more = np.where(few, rng.uniform(1.5, 4.5, few.shape), 0.0)
    maps["pixel_thermal_static"] = maps["pixel_thermal_static"] + more
    hot = tuple(
        f._replace(static=(f.static + more * f.exposure_s / f.sigma * np.sqrt(f.frames)).astype(np.float32))
        if f.kind == "dark"
        else f
        for f in fields
    )
    left, names, taken = taken_out(hot, order, known=False)
    told = joint.strengths(left, taken)
    for name, one in zip(names, told, strict=True):
        assert abs(one.sigma - TRUE[name]) < 4 * one.error, name
    drawn = joint.drawn(left, taken, [one.sigma for one in told], rng)
    for name, values in zip(names, drawn, strict=True):
        if name.startswith("pixel"):
            off = values - maps[name]
            assert np.std(off[few]) < 1.5 * np.std(off[~few]), name
            assert abs(np.mean(off[few])) < 0.5 * np.std(off[~few]), name


def test_what_two_maps_could_be_is_drawn_once():
    """Drawn together they have the rms of what was recorded, in columns and rows as well."""
    fields, maps = planted(3, (48, 64))
    left, names, taken = taken_out(fields, ORDERS[0], known=True)
    sigma = [TRUE[name] for name in names]
    true = sum(maps[name] for name in names if "additive" in name)
    sums = []
    for seed in range(8):
        drawn = joint.drawn(left, taken, sigma, np.random.default_rng(seed))
        sums.append(sum(m for m, name in zip(drawn, names, strict=True) if "additive" in name))
    power = np.mean([np.mean(s**2) for s in sums])
    assert power == pytest.approx(np.mean(true**2), rel=0.04)
    for axis in (0, 1):
        lines = np.mean([np.mean(s.mean(axis) ** 2) for s in sums])
        assert lines == pytest.approx(np.mean(true.mean(axis) ** 2), rel=0.12)


def test_columns_beside_a_strong_pixel_map_keep_their_strength():
    """Taken out of the pixels, a map takes its share of the columns' means along; their answers know."""
    fields, maps = planted(5, (48, 64))
    strong = SIGNATURES["pixel_additive_static"]
    left = strong.absorb(fields, strong.score(fields))
    for name in ("column_additive_static", "row_additive_static"):
        score = SIGNATURES[name].score(left)
        assert score.amplitude == pytest.approx(float(np.std(maps[name])), abs=3 * score.error)


def test_a_map_that_no_pixel_tells_of_has_no_strength():
    fields, _ = planted(1)
    blind = tuple(f._replace(usable=np.zeros_like(f.usable)) for f in fields)
    assert joint.strengths(blind, [joint.FrozenMap("pixel", "additive", 1.0)]) == [None]


@pytest.mark.parametrize("unit", [1.0, 1e-5])
def test_the_error_of_a_strength_does_not_depend_on_its_unit(unit):
    """A map of a share of the light beside one of so many DN in a second, of exposures a hundred thousand
    times as short: variances fourteen powers of ten apart."""
    fields, _ = planted(2)
    fields = tuple(f._replace(exposure_s=f.exposure_s * unit) for f in fields)
    left, names, maps = taken_out(fields, tuple(TRUE), known=False)
    told = dict(zip(names, joint.strengths(left, maps), strict=True))
    for name, true in (("pixel_thermal_static", 0.08 / unit), ("pixel_relative_static", 0.01)):
        sigma, error, _ = told[name]
        assert sigma == pytest.approx(true, rel=0.2)
        assert 0.01 < error / sigma < 0.1


def test_columns_of_a_law_with_long_tails_are_all_of_the_map():
    """A few columns are seven times as far off as most: half of the variance is theirs."""
    (field,) = white(np.random.default_rng(3), kinds=("dark",), frames=16, size=(64, 160), sigma=2.0)
    columns = 0.5 * np.random.default_rng(4).standard_normal((1, 160))
    columns[0, [20, 77, 130]] = 3.5, -3.5, 3.5
    static = field.static + columns / 2.0 * np.sqrt(16)
    signature = SIGNATURES["column_additive_static"]
    fields = (field._replace(static=static.astype(np.float32)),)
    score = signature.score(fields)
    left = signature.absorb(fields, score)
    (told,) = joint.strengths(left, [joint.FrozenMap(*signature.map_of, score.payload)])
    assert told.sigma == pytest.approx(float(np.sqrt(np.mean(columns**2))), rel=0.03)
