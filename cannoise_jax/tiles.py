"""Whole images in tiles without seams, in memory that does not grow with the image.

A network of finite reach gives on a tile that is wider by that reach what it gives on the whole image. What
of the generator reaches further is made for the whole image first: random numbers, those of pixels drawn in
blocks with keys of their places and those of rows and columns for all of them; the summary of the setting;
and the sizes of the offsets that the networks give to rows, which are means over whole rows and are added
last. The latent of the references is computed once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.networks.branches import Draws, NoiseLevel, line_draws
from cannoise_jax.networks.generator import row_draws, setting_summary
from cannoise_jax.physics.initial_noise import INITIAL_NOISE, initial_noise
from cannoise_jax.physics.single_image import estimate_nlf
from cannoise_jax.recordings.packing import pack, unpack
from cannoise_jax.sampling import (
    _MULTIPLE,
    SMALLEST,
    Model,
    _latent,
    check_level,
    check_values,
    initial_noise_of,
    margin_of,
    repeated,
)

TILE = 512
"""Side of a tile in packed pixels, without its surroundings."""
REACH = 384
"""Packed pixels, a multiple of 32, that G's output depends on beyond its place on every side: 383. From
full resolution (3x3: 1) down five levels no more than 2 remain, eight 3x3 convolutions add 8, and each level
back up doubles and adds 2: 10, 22, 46, 94, 190, 382. The branches mix neighbours: 1."""
_BLOCK = 32
Progress = Callable[[int], Any]
Window = tuple[slice, slice]


def sample_image(
    model: Model,
    key: Key[Array, ""],
    clean: Float[np.ndarray, "h w 4"],
    noisy_ref: Float[Array | np.ndarray, "*n y x 4"],
    nlf: tuple[Any, Any] | None = None,
    *,
    tile: int = TILE,
    progress: Progress = lambda pixels: None,
) -> Float[np.ndarray, "h w 4"]:
    """`sampling.sample_noise` for one packed image of any size from 16x16 on: the size of the tiles moves the
    result by rounding only.

    tile: a multiple of 32. progress: called with the mosaic pixels just done. A model with the paper's
    literal networks, whose norms reach over whole images, and a sensor model as initial noise, whose rows
    and columns do, need memory in proportion to the image. Raises ValueError as `sample_noise`.
    """
    check_level(model.level, nlf is not None)
    if clean.ndim != 3 or clean.shape[-1] != 4 or min(clean.shape[:2]) < SMALLEST:
        raise ValueError(f"clean must be packed, [h, w, 4], from {SMALLEST}x{SMALLEST}, got {clean.shape}")
    if tile % _BLOCK or tile <= 0:
        raise ValueError(f"tile must be a multiple of {_BLOCK}, got {tile}")
    check_values(clean, noisy_ref)
    height, width = clean.shape[:2]
    shown = repeated(jnp.asarray(noisy_ref, jnp.float32))
    shot, read = (
        jnp.broadcast_to(jnp.asarray(v, jnp.float32), (1, 4))
        for v in (estimate_nlf(shown) if nlf is None else nlf)
    )
    said = (float(nlf is not None), float(np.prod(shown.shape[:-3])))
    level = NoiseLevel(shot, read, *(jnp.full(1, v) for v in said))
    latent = _latent(model, shown)
    noise_key, row_key = jax.random.split(key)
    margin = margin_of(model)
    rows, columns = (_mirrored(n, margin) for n in (height, width))
    size = (rows.size, columns.size)
    drawn = _init_drawer(model, noise_key, clean, rows, columns, level)
    module = model.generator_module
    if module.literal:
        tile = max(size)
    summary = _summary(drawn, clean, rows, columns, tile)
    draws = _draws_drawer(module, row_key, size)
    rows_last = module.row_noise and not (module.literal or module.physics)
    made = np.empty(clean.shape, np.float32)
    strips: dict[int, Any] = {}
    for place in _grid(size, tile):
        own, wide, inner = _windows(place, size, tile, REACH)
        pixels = _pixels(own, (height, width), margin)
        if not (pixels or rows_last):
            continue
        image = clean[np.ix_(rows[wide[0]], columns[wide[1]])].astype(np.float32)
        first, part, inner = _part(wide, inner, tile)
        noise, lines = _program(module, part)(
            model.generator, image[None], *drawn(wide), latent, level, summary, draws(wide), first
        )
        _put(made, np.asarray(noise[0])[inner], own, margin)
        if rows_last:
            sums = np.asarray(lines[0])[inner].sum(1, dtype=np.float64)
            strips[place[0]] = strips.get(place[0], 0) + sums
        progress(pixels)
    if rows_last:
        offsets = np.asarray(row_draws(row_key, 1, size[0]))[0, :, 0]
        gains = np.concatenate([strips[y] for y in sorted(strips)]) / size[1]
        made += (gains * offsets)[margin : margin + height, None].astype(np.float32)
    return made


def sample_mosaic(
    model: Model,
    key: Key[Array, ""],
    clean: Float[np.ndarray, "H W"],
    cfa: str,
    noisy_ref: Float[Array | np.ndarray, "*n y x 4"],
    nlf: tuple[Any, Any] | None = None,
    **more: Any,
) -> Float[np.ndarray, "H W"]:
    """`sample_image` for a mosaic with sides of any length from 32 on; what a side lacks to an even one is
    mirrored and cut off again."""
    height, width = clean.shape
    packed = pack(_even(clean), cfa)
    return np.asarray(unpack(sample_image(model, key, packed, noisy_ref, nlf, **more), cfa))[:height, :width]


def filter_mosaic(
    run: Callable[[Float[np.ndarray, "b h w 4"]], Float[Array, "b h w 4"]],
    reach: int,
    mosaic: Float[np.ndarray, "H W"],
    cfa: str,
    *,
    tile: int = TILE,
    progress: Progress = lambda pixels: None,
) -> Float[np.ndarray, "H W"]:
    """What a network on packed images, as `networks.denoiser.DnCNN`, makes of a mosaic with sides of any
    length from 2 on. reach: packed pixels beyond its place that an output pixel depends on."""
    height, width = mosaic.shape
    packed = pack(_even(np.asarray(mosaic, np.float32)), cfa)
    made, size = np.empty_like(packed), packed.shape[:2]
    for place in _grid(size, tile):
        own, wide, inner = _windows(place, size, tile, reach)
        made[own] = np.asarray(run(packed[wide][None]))[0][inner]
        progress(4 * made[own].shape[0] * made[own].shape[1])
    return np.asarray(unpack(made, cfa))[:height, :width]


def _even(mosaic: np.ndarray) -> np.ndarray:
    """Odd sides longer by one, mirrored so that colours stay in order."""
    return np.pad(mosaic, [(0, n % 2) for n in mosaic.shape], mode="reflect")


def _mirrored(size: int, margin: int) -> np.ndarray:
    """The pixel that stands at every place of the padded image, as `sampling` pads it."""
    rest = -(size + 2 * margin) % _MULTIPLE
    return np.pad(np.arange(size), (margin, margin + rest), mode="symmetric")


def _grid(size: tuple[int, int], tile: int) -> Iterator[tuple[int, int]]:
    return ((y, x) for y in range(0, size[0], tile) for x in range(0, size[1], tile))


def _windows(place, size, tile: int, reach: int) -> tuple[Window, Window, Window]:
    """The tile in the image, the tile with its surroundings, and the tile within those. All tiles have
    surroundings of one size, so that one program serves them."""
    own = [slice(p, min(p + tile, n)) for p, n in zip(place, size, strict=True)]
    whole = [min(tile + 2 * reach, n) for n in size]
    first = [min(max(o.start - reach, 0), n - w) for o, n, w in zip(own, size, whole, strict=True)]
    wide = [slice(f, f + w) for f, w in zip(first, whole, strict=True)]
    inner = [slice(o.start - f, o.stop - f) for o, f in zip(own, first, strict=True)]
    return (own[0], own[1]), (wide[0], wide[1]), (inner[0], inner[1])


def _part(wide: Window, inner: Window, tile: int) -> tuple[np.ndarray, tuple[int, int], Window]:
    """What full-resolution layers of 3x3 work on of a tile with its surroundings: where it begins, its size,
    the same for all tiles, and where the tile lies in it."""
    whole = [w.stop - w.start for w in wide]
    size = [min(tile + 2, n) for n in whole]
    first = [min(max(i.start - 1, 0), n - s) for i, n, s in zip(inner, whole, size, strict=True)]
    place = [slice(i.start - f, i.stop - f) for i, f in zip(inner, first, strict=True)]
    return np.array(first, np.int32), (size[0], size[1]), (place[0], place[1])


def _within(part: slice, size: int, margin: int) -> slice:
    """A part of the padded image in coordinates of the image."""
    start, stop = (min(max(p - margin, 0), size) for p in (part.start, part.stop))
    return slice(start, stop)


def _pixels(own: Window, size: tuple[int, int], margin: int) -> int:
    """Mosaic pixels of the image that a tile holds."""
    height, width = (_within(part, n, margin) for part, n in zip(own, size, strict=True))
    return 4 * (height.stop - height.start) * (width.stop - width.start)


def _put(made: np.ndarray, noise: np.ndarray, own: Window, margin: int) -> None:
    """The part of a tile that lies within the image, without the margin."""
    to = [_within(part, n, margin) for part, n in zip(own, made.shape[:2], strict=True)]
    if all(t.stop > t.start for t in to):
        shifts = [margin - part.start for part in own]
        take = [slice(t.start + shift, t.stop + shift) for t, shift in zip(to, shifts, strict=True)]
        made[tuple(to)] = noise[tuple(take)]


def _init_drawer(model, key, clean, rows, columns, level):
    """A function from a window of the padded image to its initial noise and sigma, `[1, h, w, 4]` each."""
    draw = initial_noise_of(model)
    if model.sensors or model.initial_noise not in tuple(INITIAL_NOISE):
        # Rows and columns run through the whole image: so does what is drawn.
        whole = clean[np.ix_(rows, columns)].astype(np.float32)[None]
        noise, sigma = jax.jit(draw)(key, whole, level.shot, level.read)
        return lambda window: (noise[(0, *window)][None], sigma[(0, *window)][None])

    def of_window(window):
        image = clean[np.ix_(rows[window[0]], columns[window[1]])].astype(np.float32)
        numbers = _block_numbers(window, columns.size)
        return _blocks(model.initial_noise, key, image, numbers, level.shot[0], level.read[0])

    return of_window


def _draws_drawer(module, key, size: tuple[int, int]):
    """A function from a window of the padded image to what the branches draw there; None without branches."""
    if module.literal or not module.physics:
        return lambda window: None
    pixel_key, line_key = jax.random.split(key)
    white, slow, across = line_draws(line_key, 1, *size)

    def of_window(window):
        y, x = window
        pixels = _white_blocks(pixel_key, _block_numbers(window, size[1]))
        return Draws(pixels, white[:, y], slow[:, y], across[:, x])

    return of_window


def _block_numbers(window: Window, width: int) -> Array:
    """The blocks of a window, numbered through the whole image of this width."""
    y, x = (np.arange(w.start // _BLOCK, w.stop // _BLOCK) for w in window)
    return jnp.asarray(y[:, None] * (width // _BLOCK) + x)


@partial(jax.jit, static_argnames="choice")
def _blocks(choice, key, image, numbers, shot, read):
    """Initial noise block by block, each with the key of its place: white noise does not see the seams."""
    ny, nx = numbers.shape
    cells = image.reshape(ny, _BLOCK, nx, _BLOCK, 4).swapaxes(1, 2).reshape(ny * nx, _BLOCK, _BLOCK, 4)
    keys = jax.vmap(partial(jax.random.fold_in, key))(numbers.ravel())
    both = jax.vmap(lambda k, c: initial_noise(choice)(k, c, shot, read))(keys, cells)
    return tuple(_joined(v, ny, nx) for v in both)


@jax.jit
def _white_blocks(key, numbers):
    """Standard normals, block by block."""
    keys = jax.vmap(partial(jax.random.fold_in, key))(numbers.ravel())
    return _joined(jax.vmap(lambda k: jax.random.normal(k, (_BLOCK, _BLOCK, 4)))(keys), *numbers.shape)


def _joined(blocks, ny: int, nx: int):
    whole = blocks.reshape(ny, nx, _BLOCK, _BLOCK, 4).swapaxes(1, 2)
    return whole.reshape(1, ny * _BLOCK, nx * _BLOCK, 4)


def _summary(drawn, clean, rows, columns, tile: int) -> Float[Array, "1 s"]:
    """The setting of the whole padded image: means over its tiles, weighted by their pixels."""
    total: Any = 0.0
    size, measure = (rows.size, columns.size), jax.jit(setting_summary)
    for place in _grid(size, tile):
        own, _, _ = _windows(place, size, tile, 0)
        image = clean[np.ix_(rows[own[0]], columns[own[1]])].astype(np.float32)[None]
        share = image.shape[1] * image.shape[2] / (size[0] * size[1])
        total = total + share * np.asarray(measure(image, drawn(own)[1]), np.float64)
    return jnp.asarray(total, jnp.float32)


@lru_cache(maxsize=8)
def _program(module, part: tuple[int, int]):
    def run(variables, image, n_init, sigma, latent, level, summary, draws, first):
        return module.apply(
            variables, image, n_init, latent, sigma, train=False, level=level, summary=summary, draws=draws,
            lines=False, part=((first[0], first[1]), part),
        )  # fmt: skip

    return jax.jit(run)
