"""Clean scenes as a camera would see them: dead leaves and photographs, as linear raw colours.

A scene is what falls on the sensor: an image of three colours in normalised raw units (0 black level, 1 white
level), from which `mosaic` takes the one colour that each pixel of a Bayer sensor sees. Scenes come from a
key. Where they come from:

- dead leaves: discs and boxes of random colour that hide one another, radii of a power law, which gives the
  edges, flat parts and scale invariance of natural images (Lee, Mumford and Huang, IJCV 2001);
- the photographs that scikit-image ships, turned back from sRGB into linear raw: gamma, colour matrix and
  white balance undone, highlights kept saturated (Brooks et al., CVPR 2019, section 3).
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import jax
import numpy as np
import skimage
from jaxtyping import Array, Float, Key
from PIL import Image
from scipy.ndimage import gaussian_filter

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")

# The two motorcycle pictures are a stereo pair, one scene, so they stay in one split.
_PHOTOGRAPHS: dict[Split, tuple[str, ...]] = {
    "train": ("astronaut.png", "coffee.png", "motorcycle_left.png", "motorcycle_right.png"),
    "validation": ("chelsea.png",),
    "test": ("rocket.jpg", "hubble_deep_field.jpg"),
}

PATCH = 64
"""Side of a training patch in packed pixels; 128 on the mosaic."""

# Linear sRGB to the colours of a typical sensor: rows sum to one, so grey stays grey before white balance.
_SRGB_TO_SENSOR = np.array([[0.58, 0.34, 0.08], [0.16, 0.68, 0.16], [0.04, 0.27, 0.69]])


class Scene(NamedTuple):
    """One clean scene: `image` float32[H, W, 3], linear raw colours R, G, B in [0, 1]; `name`: its source."""

    name: str
    image: Float[np.ndarray, "h w 3"]


def draw_scenes(
    key: Key[Array, ""], split: Split, count: int, size: tuple[int, int] = (512, 512)
) -> tuple[Scene, ...]:
    """`count` scenes of `size` pixels (H, W) for one split; every fourth a photograph, the rest dead leaves.

    Splits share neither photographs nor keys, so train, validation and test scenes are disjoint.
    About one scene in four is defocused and one in ten nearly flat, so that smooth regions exist.
    Raises ValueError for an unknown split.
    """
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}: use one of {', '.join(SPLITS)}")
    photographs = photograph_names(split)
    key = jax.random.fold_in(key, SPLITS.index(split))
    scenes = []
    for i in range(count):
        rng = numpy_generator(jax.random.fold_in(key, i))
        if photographs and i % 4 == 3:
            name = photographs[(i // 4) % len(photographs)]
            colours = _crop_or_mirror(rng, photograph(name), size)
        else:
            name, colours = f"dead leaves {split} {i}", dead_leaves(rng, size)
        scenes.append(Scene(name, expose(rng, _focus(rng, colours))))
    return tuple(scenes)


def numpy_generator(key: Key[Array, ""]) -> np.random.Generator:
    """A NumPy generator that depends on a JAX key alone, for draws that are loops rather than arrays."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())


def photograph_names(split: Split) -> tuple[str, ...]:
    """The photographs of a split that the installed scikit-image really ships."""
    return tuple(name for name in _PHOTOGRAPHS[split] if (_photograph_folder() / name).is_file())


def photograph(name: str) -> Float[np.ndarray, "h w 3"]:
    """A photograph that scikit-image ships, as linear sRGB in [0, 1] (IEC 61966-2-1 transfer undone)."""
    with Image.open(_photograph_folder() / name) as file:
        encoded = np.asarray(file.convert("RGB"), np.float32) / 255
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def dead_leaves(
    rng: np.random.Generator,
    size: tuple[int, int],
    smallest: float = 4.0,
    largest: float = 160.0,
    layers: float = 4.0,
) -> Float[np.ndarray, "h w 3"]:
    """Dead leaves in linear colours, not yet exposed: float32[H, W, 3], positive.

    Radii follow r^-3 between `smallest` and `largest` pixels; every pixel is covered about `layers` times.
    Luminances are log-normal, which is dark-heavy as raw values are; each leaf is shaded by a weak gradient.
    """
    height, width = size
    image = np.empty((height, width, 3), np.float32)
    image[:] = _leaf_colours(rng, 1)[0]
    mean_area = 2 * np.pi * smallest**2 * np.log(largest / smallest)
    count = int(layers * (height + 2 * smallest) * (width + 2 * smallest) / mean_area)
    tail = (smallest / largest) ** 2
    radii = smallest / np.sqrt(tail + (1 - tail) * rng.uniform(size=count))
    centres = rng.uniform(-0.1, 1.1, (count, 2)) * (height, width)
    colours = _leaf_colours(rng, count)
    slopes = rng.normal(0, 0.15, (count, 2)) / radii[:, None]
    boxes = rng.uniform(size=count) < 0.3
    for (y, x), r, colour, slope, box in zip(centres, radii, colours, slopes, boxes, strict=True):
        top, bottom = max(0, int(y - r)), min(height, int(y + r) + 1)
        left, right = max(0, int(x - r)), min(width, int(x + r) + 1)
        if top >= bottom or left >= right:
            continue
        dy = np.arange(top, bottom, dtype=np.float32)[:, None] - np.float32(y)
        dx = np.arange(left, right, dtype=np.float32)[None, :] - np.float32(x)
        shade = np.clip(1 + np.float32(slope[0]) * dy + np.float32(slope[1]) * dx, 0.5, 1.5)
        leaf = shade[..., None] * colour
        window = image[top:bottom, left:right]
        window[:] = leaf if box else np.where((dy * dy + dx * dx <= r * r)[..., None], leaf, window)
    return image


def expose(rng: np.random.Generator, colours: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Linear colours to the raw colours of a random camera, light and exposure: float32[H, W, 3] in [0, 1].

    The colour response and light are drawn anew for every scene and alike for all cameras, so that a
    camera is told apart by its noise and not by its colours. The mean raw value is log-normal, median 0.1.
    """
    target = 0.1 * np.exp(0.7 * rng.standard_normal())
    bright = np.clip(colours * (target / max(float(colours.mean()), 1e-6) * 1.5), 0, 1)
    response = np.clip(_SRGB_TO_SENSOR + rng.normal(0, 0.03, (3, 3)), 0.01, None)
    response /= response.sum(axis=1, keepdims=True)
    raw = bright @ response.T
    gains = np.array([1 / rng.uniform(1.6, 2.4), 1.0, 1 / rng.uniform(1.4, 2.0)])
    # What saturated all colours stays saturated: the inverse gain fades to one near white.
    white = np.clip((raw.mean(axis=-1, keepdims=True) - 0.9) / 0.1, 0, None) ** 2
    return np.clip(raw * np.maximum(white + (1 - white) * gains, gains), 0, 1).astype(np.float32)


def mosaic(image: Float[np.ndarray, "h w 3"], cfa: str) -> Float[np.ndarray, "h w"]:
    """The colour that each pixel of a Bayer (or MONO: the green) sensor sees: `[H, W]`, same dtype."""
    height, width, _ = image.shape
    letters = "GGGG" if cfa == "MONO" else cfa
    cell = np.array(["RGB".index(letter) for letter in letters]).reshape(2, 2)
    channel = np.tile(cell, ((height + 1) // 2, (width + 1) // 2))[:height, :width]
    return np.take_along_axis(image, channel[..., None], axis=-1)[..., 0]


def _leaf_colours(rng: np.random.Generator, count: int) -> Float[np.ndarray, "count 3"]:
    luminance = np.exp(0.9 * rng.standard_normal((count, 1)))
    chroma = np.exp(0.35 * rng.standard_normal((count, 3)))
    return (luminance * chroma).astype(np.float32)


def _focus(rng: np.random.Generator, colours: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Blur by the optics (0.7 px), by defocus (2 to 8 px) or until nearly flat (25 to 60 px)."""
    pick = rng.uniform()
    blur = rng.uniform(25, 60) if pick < 0.1 else rng.uniform(2, 8) if pick < 0.35 else 0.7
    return gaussian_filter(colours, (blur, blur, 0), mode="reflect", truncate=3.0)


def _crop_or_mirror(
    rng: np.random.Generator, image: Float[np.ndarray, "h w 3"], size: tuple[int, int]
) -> Float[np.ndarray, "H W 3"]:
    """A random window of `size`; a picture that is too small is first continued by its mirror image."""
    missing = [max(0, wanted - have) for wanted, have in zip(size, image.shape[:2], strict=True)]
    image = np.pad(image, ((0, missing[0]), (0, missing[1]), (0, 0)), mode="symmetric")
    top, left = (int(rng.integers(have - want + 1)) for have, want in zip(image.shape[:2], size, strict=True))
    image = image[top : top + size[0], left : left + size[1]]
    return image[:, ::-1] if rng.uniform() < 0.5 else image


def _photograph_folder() -> Path:
    return Path(skimage.__file__).parent / "data"
