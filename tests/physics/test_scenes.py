"""Clean scenes: deterministic, plausible, disjoint between splits."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.physics.synthetic import scenes
from cannoise_jax.recordings.packing import pack


def test_scenes_depend_on_their_key_alone():
    first, again, other = (scenes.draw_scenes(jax.random.key(k), "train", 4, (128, 96)) for k in (0, 0, 1))
    assert all(np.array_equal(a.image, b.image) for a, b in zip(first, again, strict=True))
    assert not any(np.array_equal(a.image, b.image) for a, b in zip(first, other, strict=True))


def test_more_scenes_leave_the_first_ones_alone():
    few, many = (scenes.draw_scenes(jax.random.key(2), "test", n, (64, 64)) for n in (2, 5))
    assert all(np.array_equal(a.image, b.image) for a, b in zip(few, many[:2], strict=True))


def test_splits_share_neither_photographs_nor_dead_leaves():
    drawn = {split: scenes.draw_scenes(jax.random.key(0), split, 8, (96, 96)) for split in scenes.SPLITS}
    names = [{s.name for s in taken} for taken in drawn.values()]
    assert sum(map(len, names)) == len(set().union(*names))
    first = [taken[0].image for taken in drawn.values()]
    assert not np.array_equal(first[0], first[1]) and not np.array_equal(first[1], first[2])


def test_every_split_has_a_photograph_on_disk():
    assert all(scenes.photograph_names(split) for split in scenes.SPLITS)


def test_raw_values_are_linear_dark_heavy_and_in_range():
    taken = scenes.draw_scenes(jax.random.key(3), "train", 16, (128, 128))
    values = np.stack([s.image for s in taken])
    assert values.dtype == np.float32 and values.min() >= 0 and values.max() <= 1
    assert 0.02 < np.median(values) < 0.15 < np.quantile(values, 0.95)
    red, green, blue = np.median(values, axis=(0, 1, 2))
    assert red < green and blue < green


def test_there_are_flat_and_sharp_parts():
    """Local contrast over 16 x 16 blocks spans at least two decades."""
    taken = scenes.draw_scenes(jax.random.key(4), "train", 24, (128, 128))
    green = np.stack([s.image[..., 1] for s in taken]).reshape(24, 8, 16, 8, 16)
    contrast = green.std(axis=(2, 4)) / (green.mean(axis=(2, 4)) + 1e-4)
    assert np.quantile(contrast, 0.05) < 0.01 and np.quantile(contrast, 0.95) > 0.3


def test_radii_of_dead_leaves_follow_the_power_law():
    """Two-point differences of the luminance's logarithm grow slowly with distance, as in natural images."""
    rng = np.random.default_rng(0)
    image = np.log(scenes.dead_leaves(rng, (512, 512))[..., 1])
    steps = [1, 4, 16, 64]
    structure = [np.mean((image[:, s:] - image[:, :-s]) ** 2) for s in steps]
    assert structure == sorted(structure)
    assert structure[1] < 0.75 * structure[3] and structure[0] < 0.3 * structure[3]


def test_photograph_is_linear_light():
    """The inverse transfer of sRGB: code 128 is 21.6 % of the light, 0 and 255 stay at the ends."""
    light = scenes.photograph("astronaut.png")
    assert light.min() == 0 and light.max() == 1
    from PIL import Image

    with Image.open(scenes._photograph_folder() / "astronaut.png") as file:
        code = np.asarray(file.convert("RGB"))
    assert light[code == 128] == pytest.approx(0.2158605, abs=1e-5)


def test_saturated_colours_stay_saturated():
    """White balance is undone on everything but highlights, which would turn pink."""
    picture = np.full((32, 32, 3), 0.02, np.float32)
    picture[15:18, 15:18] = 50.0
    raw = scenes.expose(np.random.default_rng(1), picture)
    assert raw[16, 16] == pytest.approx([1, 1, 1], abs=1e-6)
    assert raw[0, 0, 0] < 0.7 * raw[0, 0, 1] and raw[0, 0, 2] < 0.8 * raw[0, 0, 1]


@pytest.mark.parametrize("cfa", ["RGGB", "GRBG", "GBRG", "BGGR"])
def test_mosaic_takes_the_colour_of_the_pattern(cfa):
    image = np.broadcast_to(np.array([0.1, 0.2, 0.3], np.float32), (6, 8, 3))
    assert pack(scenes.mosaic(image, cfa), cfa)[1, 2] == pytest.approx([0.1, 0.2, 0.2, 0.3])


def test_unknown_split_is_refused():
    with pytest.raises(ValueError, match="unknown split"):
        scenes.draw_scenes(jax.random.key(0), "holdout", 1)
