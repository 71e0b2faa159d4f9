"""Convolutions, plain and transposed, each in several formulations, and the rule that chooses among them.

XLA's CPU convolutions are slow exactly on the small maps with many channels where these networks live, so
both exist as matrix products too. All formulations are the same function, equal through second derivatives
(the gradient penalty differentiates twice); only their cost differs.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

_NHWC = ("NHWC", "HWIO", "NHWC")


def patches(x: Float[Array, "b h w c"], size: int, stride: int, padding: int) -> Float[Array, "b y x k"]:
    """The zero-padded size x size neighbourhoods as channels, ordered (row, column, channel)."""
    batch, height, width, channels = x.shape
    rows = (height + 2 * padding - size) // stride + 1
    columns = (width + 2 * padding - size) // stride + 1
    x = jnp.pad(x, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
    taps = [
        lax.slice(
            x,
            (0, i, j, 0),
            (batch, i + (rows - 1) * stride + 1, j + (columns - 1) * stride + 1, channels),
            (1, stride, stride, 1),
        )
        for i in range(size)
        for j in range(size)
    ]
    return jnp.concatenate(taps, axis=-1)


def _conv_plain(x, kernel, stride, padding):
    return lax.conv_general_dilated(
        x, kernel, (stride, stride), [(padding, padding)] * 2, dimension_numbers=_NHWC
    )


def _conv_patches(x, kernel, stride, padding):
    size, _, inputs, outputs = kernel.shape
    if (size, stride) == (4, 2):
        # The 4x4 window is 2x2 cells of 2x2 pixels: four long copies in the place of sixteen short ones.
        taps = kernel.reshape(2, 2, 2, 2, inputs, outputs).transpose(0, 2, 1, 3, 4, 5)
        return patches(_pixels_to_cells(x, padding), 2, 1, 0) @ taps.reshape(-1, outputs)
    return patches(x, size, stride, padding) @ kernel.reshape(-1, outputs)


def _conv_blocks(x, kernel, stride, padding):
    """Stride 1, odd size, even maps: the same from 2x2 cells to 2x2 cells, with 4 times the channels."""
    size, _, inputs, outputs = kernel.shape
    half = (size + 1) // 2
    shifted = jnp.stack(
        [jnp.pad(kernel, ((i, 1 - i), (j, 1 - j), (0, 0), (0, 0))) for i in range(2) for j in range(2)], -2
    )
    taps = shifted.reshape(half, 2, half, 2, inputs, 4 * outputs).transpose(0, 2, 1, 3, 4, 5)
    taps = taps.reshape(half, half, 4 * inputs, 4 * outputs)
    return _cells_to_pixels(_conv_plain(_pixels_to_cells(x, padding), taps, 1, 0), outputs)


def _conv_runs(x, kernel, stride, padding):
    """Runs of neighbouring outputs of a row as channels of one convolution with longer steps: 32 channels or
    more fill a processor's vectors where 16 or fewer leave them mostly empty."""
    size, _, inputs, outputs = kernel.shape
    run = run_length((x.shape[2] + 2 * padding - size) // stride + 1, outputs)
    moved = [(stride * i, stride * (run - 1 - i)) for i in range(run)]
    taps = jnp.stack([jnp.pad(kernel, ((0, 0), m, (0, 0), (0, 0))) for m in moved], -2)
    taps = taps.reshape(size, size + stride * (run - 1), inputs, run * outputs)
    y = lax.conv_general_dilated(
        x, taps, (stride, stride * run), [(padding, padding)] * 2, dimension_numbers=_NHWC
    )
    return y.reshape(*y.shape[:2], -1, outputs)


def run_length(width: int, outputs: int) -> int:
    """How many of a row's outputs `_conv_runs` makes at once: enough for 32 channels, a divisor of all."""
    run = 1
    while run * outputs < 32 and width % (2 * run) == 0:
        run *= 2
    return run


def _transpose_plain(x, kernel):
    return lax.conv_general_dilated(
        x, kernel[::-1, ::-1], (1, 1), [(2, 2)] * 2, lhs_dilation=(2, 2), dimension_numbers=_NHWC
    )


def _transpose_overlap(x, kernel):
    """Every input pixel paints its 4x4 stamp (one matrix product); the overlaps are added."""
    batch, height, width, inputs = x.shape
    outputs = kernel.shape[-1]
    # Taps 0, 1 and 2, 3 of a stamp lie in two neighbouring 2-pixel cells of a grid shifted by one pixel.
    stamps = x @ kernel.reshape(2, 2, 2, 2, inputs, outputs).transpose(4, 0, 2, 1, 3, 5).reshape(inputs, -1)
    stamps = stamps.reshape(batch, height, width, 4, 4 * outputs)
    cells = sum(
        jnp.pad(stamps[:, :, :, 2 * i + j], ((0, 0), (i, 1 - i), (j, 1 - j), (0, 0)))
        for i in range(2)
        for j in range(2)
    )
    return _cells_to_pixels(cells, outputs)[:, 1:-1, 1:-1]


def _transpose_windows(x, kernel):
    """Every 2x2 window of the padded input makes one 2x2 cell of the output, shifted by one pixel."""
    inputs, outputs = kernel.shape[2:]
    taps = kernel.reshape(2, 2, 2, 2, inputs, outputs)[::-1, :, ::-1].transpose(0, 2, 4, 1, 3, 5)
    cells = patches(x, 2, 1, 1) @ taps.reshape(4 * inputs, 4 * outputs)
    return _cells_to_pixels(cells, outputs)[:, 1:-1, 1:-1]


def _pixels_to_cells(x, padding):
    """2x2 cells of the zero-padded map as channels."""
    batch, height, width, channels = x.shape
    rows, columns = height // 2 + padding, width // 2 + padding
    x = jnp.pad(x, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
    x = x.reshape(batch, rows, 2, columns, 2, channels).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(batch, rows, columns, 4 * channels)


def _cells_to_pixels(cells, outputs):
    """Inverse of `_pixels_to_cells` with no padding."""
    batch, rows, columns, _ = cells.shape
    pixels = cells.reshape(batch, rows, columns, 2, 2, outputs).transpose(0, 1, 3, 2, 4, 5)
    return pixels.reshape(batch, 2 * rows, 2 * columns, outputs)


CONV = {
    "plain": _conv_plain,
    "patches": _conv_patches,
    "blocks": _conv_blocks,
    "runs": _conv_runs,
}
CONV_TRANSPOSE = {
    "plain": _transpose_plain,
    "overlap": _transpose_overlap,
    "windows": _transpose_windows,
}


def choose_conv(map_size: int, size: int, inputs: int, outputs: int, stride: int, twice: bool) -> str:
    """The fastest formulation on a CPU, `map_size` being height x width of the input.

    As measured, forward and backward, with batches of 4 to 80 at the shapes of the three networks at width
    1/16 to 1: plain convolutions win on large maps, lose up to thirtyfold on maps of 4x4 and below (8x8 from
    128 channels on), and up to sixfold wherever the gradient is itself differentiated (`twice`). With fewer
    than 32 outputs runs of pixels win on maps from 64x64 on: threefold to sixfold for 7x7, a third for 4x4.
    """
    if size == 1:
        return "patches"
    if size == 7 and stride == 1 and inputs <= 8 and outputs <= 16:
        return "runs"
    small = map_size <= 16 or (map_size <= 64 and inputs >= 128)
    if small or (twice and stride == 2):
        return "patches"
    return "runs" if stride == 2 and outputs < 32 and map_size >= 4096 else "plain"


def conv2d(
    x: Float[Array, "b h w i"],
    kernel: Float[Array, "k k i o"],
    stride: int,
    padding: int,
    formulation: str | None = None,
    *,
    twice: bool = False,
) -> Float[Array, "b y x o"]:
    """Zero-padded convolution without bias.

    formulation: a name in `CONV` ("blocks": stride 1, odd size, padding (size - 1) / 2, even maps), or None
    for the platform's fastest; `twice`: a gradient of this layer will be differentiated again.
    """
    if formulation is None:
        formulation = "plain"
        even = x.shape[1] % 2 == 0 and x.shape[2] % 2 == 0
        if jax.default_backend() == "cpu" and even:
            size, _, inputs, outputs = kernel.shape
            formulation = choose_conv(x.shape[1] * x.shape[2], size, inputs, outputs, stride, twice)
    return CONV[formulation](x, kernel, stride, padding)


def conv_transpose2d(
    x: Float[Array, "b h w i"], kernel: Float[Array, "4 4 i o"], formulation: str | None = None
) -> Float[Array, "b 2*h 2*w o"]:
    """Transposed convolution, 4x4, stride 2, padding 1: `out[2i - 1 + k] += x[i] kernel[k]` on both axes.

    formulation: a name in `CONV_TRANSPOSE`, or None for the platform's fastest. On CPUs (measured as for
    `choose_conv`) the plain one is 5 to 15 times slower than the matrix products at every shape of G.
    """
    if formulation is None:
        formulation = "plain"
        if jax.default_backend() == "cpu":
            formulation = "overlap" if x.shape[1] * x.shape[2] <= 16 else "windows"
    return CONV_TRANSPOSE[formulation](x, kernel)
