"""Effects that no list of mechanisms holds: what a search should call unknown, and not by another name."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from cannoise_jax.blind.plain_camera import Camera, Effect, Make, Shot

Rng = np.random.Generator


def _unit(field: np.ndarray) -> np.ndarray:
    return field / field.std()


def tear(rng: Rng, camera: Camera) -> Effect:
    """The black level jumps once a frame, at a row of its own."""
    step = camera.read_dn * rng.uniform(0.5, 1)

    def analog(v, shot: Shot, rng: Rng):
        v = v.copy()
        v[rng.integers(10, len(v) - 10) :] += step * rng.choice([-1, 1])
        return v

    return Effect(analog=analog)


def raster_telegraph(rng: Rng, camera: Camera) -> Effect:
    """The readout's offset jumps between two levels along the raster."""
    step, dwell = camera.read_dn * rng.uniform(0.4, 0.8), rng.uniform(40, 400)

    def analog(v, shot: Shot, rng: Rng):
        state = (np.cumsum(rng.random(v.size) < 1 / dwell) + rng.integers(2)) % 2
        return v + step * (state.reshape(v.shape) - 0.5)

    return Effect(analog=analog)


def noise_gradient(rng: Rng, camera: Camera) -> Effect:
    """Read noise grows from one side of the frame to the other."""
    slope, axis = rng.uniform(0.3, 0.6), rng.integers(2)
    ramp = np.linspace(1 - slope, 1 + slope, camera.size[axis])
    return Effect(read=lambda z, shot, rng: z * (ramp[:, None] if axis == 0 else ramp))


def inl_wave(rng: Rng, camera: Camera) -> Effect:
    """Integral nonlinearity of the converter: a wave over the codes."""
    period, height = camera.span / rng.uniform(6, 20), camera.span * rng.uniform(0.002, 0.006)
    phase = rng.uniform(0, 6)
    return Effect(analog=lambda v, shot, rng: v + height * np.sin(2 * np.pi * v / period + phase))


def bank_rows(rng: Rng, camera: Camera) -> Effect:
    """Banks of columns, each with row noise of its own."""
    width, sigma = int(rng.choice([8, 16, 20, 32])), camera.read_dn * rng.uniform(0.3, 0.6)

    def analog(v, shot: Shot, rng: Rng):
        offsets = sigma * rng.normal(size=(v.shape[0], -(-v.shape[1] // width)))
        return v + np.repeat(offsets, width, 1)[:, : v.shape[1]]

    return Effect(analog=analog)


def row_memory(rng: Rng, camera: Camera) -> Effect:
    """Row noise that remembers the frame before."""
    sigma, memory = camera.read_dn * rng.uniform(0.3, 0.6), rng.uniform(0.6, 0.9)

    def analog(v, shot: Shot, rng: Rng):
        new = rng.normal(size=len(v))
        last = shot.state.get("rows", rng.normal(size=len(v)))
        shot.state["rows"] = memory * last + np.sqrt(1 - memory**2) * new
        return v + sigma * shot.state["rows"][:, None]

    return Effect(analog=analog)


def fringes(rng: Rng, camera: Camera) -> Effect:
    """Interference fringes of the cover glass in the response."""
    y, x = np.indices(camera.size)
    bend = _unit(ndimage.gaussian_filter(rng.normal(size=camera.size), 12))
    phase = 2 * np.pi * (x / rng.uniform(9, 25) + y / rng.uniform(15, 60)) + 1.5 * bend
    response = 1 + rng.uniform(0.01, 0.03) * np.sin(phase)
    return Effect(light=lambda e, shot, rng: e * response)


def bit_flips(rng: Rng, camera: Camera) -> Effect:
    """One bit of some codes is wrong."""
    share, bit = rng.uniform(0.002, 0.01), int(rng.integers(4, 7))
    return Effect(code=lambda k, shot, rng: np.where(rng.random(k.shape) < share, k ^ (1 << bit), k))


def streaking(rng: Rng, camera: Camera) -> Effect:
    """Rows of bright content are read lower."""
    share = rng.uniform(0.004, 0.012)
    return Effect(analog=lambda v, shot, rng: v - share * v.mean(1)[:, None])


def chirp(rng: Rng, camera: Camera) -> Effect:
    """Pick-up whose frequency runs through the frame."""
    height, first, last = (
        camera.read_dn * rng.uniform(0.3, 0.6),
        rng.uniform(0.02, 0.06),
        rng.uniform(0.1, 0.25),
    )
    t = np.arange(camera.size[0])
    phase = 2 * np.pi * (first * t + last * t**2 / 2 / camera.size[0])
    return Effect(analog=lambda v, shot, rng: v + height * np.sin(phase + rng.uniform(0, 2 * np.pi))[:, None])


def clouds(rng: Rng, camera: Camera) -> Effect:
    """A smooth offset field, new in every frame."""
    sigma, width = camera.read_dn * rng.uniform(0.2, 0.4), rng.uniform(8, 25)

    def analog(v, shot: Shot, rng: Rng):
        return v + sigma * _unit(ndimage.gaussian_filter(rng.normal(size=v.shape), width, mode="wrap"))

    return Effect(analog=analog)


def noisy_edges(rng: Rng, camera: Camera) -> Effect:
    """A few columns at both edges have more read noise."""
    number, factor = int(rng.integers(3, 10)), rng.uniform(1.6, 3)
    at = np.arange(camera.size[1])
    scale = np.where((at < number) | (at >= camera.size[1] - number), factor, 1.0)
    return Effect(read=lambda z, shot, rng: z * scale)


def two_readouts(rng: Rng, camera: Camera) -> Effect:
    """Every other frame is noisier."""
    more = rng.uniform(0.4, 0.8)
    return Effect(read=lambda z, shot, rng: z * (1 + more * (shot.frame % 2)))


def echo(rng: Rng, camera: Camera) -> Effect:
    """Each pixel comes again, weaker, some columns later."""
    away, share = int(rng.integers(4, 9)), rng.uniform(0.02, 0.06)

    def analog(v, shot: Shot, rng: Rng):
        out = v.copy()
        out[:, away:] += share * v[:, :-away]
        return out

    return Effect(analog=analog)


def noisy_frames(rng: Rng, camera: Camera) -> Effect:
    """Some frames are noisier than others."""
    share, factor = rng.uniform(0.2, 0.4), rng.uniform(1.5, 2.5)
    return Effect(read=lambda z, shot, rng: z * (factor if rng.random() < share else 1.0))


def blinking_blocks(rng: Rng, camera: Camera) -> Effect:
    """Blocks, anywhere, are lifted in single frames."""
    side, step, number = (
        int(rng.choice([8, 16])),
        camera.read_dn * rng.uniform(0.8, 1.6),
        int(rng.integers(4, 16)),
    )

    def analog(v, shot: Shot, rng: Rng):
        v = v.copy()
        for _ in range(number):
            y, x = (rng.integers(n // side) * side for n in v.shape)
            v[y : y + side, x : x + side] += step
        return v

    return Effect(analog=analog)


def noise_memory(rng: Rng, camera: Camera) -> Effect:
    """Read noise that remembers the frame before."""
    memory = rng.uniform(0.4, 0.7)

    def read(z, shot: Shot, rng: Rng):
        last = shot.state.get("noise", camera.read_e * rng.normal(size=z.shape))
        shot.state["noise"] = memory * last + np.sqrt(1 - memory**2) * z
        return shot.state["noise"]

    return Effect(read=read)


def quadrants(rng: Rng, camera: Camera) -> Effect:
    """The offset of every quadrant jumps by itself from frame to frame."""
    sigma = camera.read_dn * rng.uniform(0.1, 0.3)
    return Effect(
        analog=lambda v, shot, rng: (
            v + np.kron(sigma * rng.normal(size=(2, 2)), np.ones((v.shape[0] // 2, v.shape[1] // 2)))
        )
    )


def repeated_rows(rng: Rng, camera: Camera) -> Effect:
    """Some rows are the one before them."""
    share = rng.uniform(0.003, 0.01)

    def analog(v, shot: Shot, rng: Rng):
        out, lost = v.copy(), np.flatnonzero(rng.random(len(v) - 1) < share) + 1
        out[lost] = v[lost - 1]
        return out

    return Effect(analog=analog)


def shared_pairs(rng: Rng, camera: Camera) -> Effect:
    """Cells of 2 x 2 pixels share a noise that lifts one row and lowers the other."""
    sigma = camera.read_dn * rng.uniform(0.4, 0.8)
    return Effect(
        analog=lambda v, shot, rng: (
            v + np.kron(sigma * rng.normal(size=(v.shape[0] // 2, v.shape[1] // 2)), [[1, 1], [-1, -1]])
        )
    )


def wandering_columns(rng: Rng, camera: Camera) -> Effect:
    """Offsets of columns that wander from frame to frame."""
    step = camera.read_dn * rng.uniform(0.1, 0.25)

    def analog(v, shot: Shot, rng: Rng):
        shot.state["columns"] = shot.state.get("columns", 0.0) + step * rng.normal(size=v.shape[1])
        return v + shot.state["columns"]

    return Effect(analog=analog)


def three_levels(rng: Rng, camera: Camera) -> Effect:
    """A few pixels jump between three levels."""
    sites = rng.choice(int(np.prod(camera.size)), int(rng.uniform(0.002, 0.01) * np.prod(camera.size)), False)
    step = camera.read_dn * rng.uniform(3, 6)

    def analog(v, shot: Shot, rng: Rng):
        out = v.copy().ravel()
        out[sites] += step * rng.integers(0, 3, sites.size)
        return out.reshape(v.shape)

    return Effect(analog=analog)


def zipper(rng: Rng, camera: Camera) -> Effect:
    """Even and odd columns of a row part by a random offset."""
    sigma = camera.read_dn * rng.uniform(0.3, 0.6)

    def analog(v, shot: Shot, rng: Rng):
        sign = 1 - 2 * (np.arange(v.shape[1]) % 2)
        return v + sigma * rng.normal(size=(len(v), 1)) * sign

    return Effect(analog=analog)


def speckle(rng: Rng, camera: Camera) -> Effect:
    """The light itself is speckled, new in every frame."""
    share, width = rng.uniform(0.02, 0.05), rng.uniform(1.5, 3)
    return Effect(
        light=lambda e, shot, rng: (
            e * (1 + share * _unit(ndimage.gaussian_filter(rng.normal(size=e.shape), width)))
        )
    )


def spots(rng: Rng, camera: Camera) -> Effect:
    """Shadows of dust, some of them rings."""
    y, x = np.indices(camera.size)
    response = np.ones(camera.size)
    for _ in range(int(rng.integers(5, 14))):
        away = np.hypot(y - rng.uniform(0, camera.size[0]), x - rng.uniform(0, camera.size[1]))
        radius, ring = rng.uniform(3, 9), rng.random() < 0.5
        shadow = rng.uniform(0.03, 0.1) / (1 + np.exp(2 * (away - radius)))
        response -= shadow * (away > radius / 2 if ring else 1)
    return Effect(light=lambda e, shot, rng: e * response)


def smoothed_colours(rng: Rng, camera: Camera) -> Effect:
    """Each colour is blended with the mean of its 3 x 3 surroundings."""
    share = rng.uniform(0.3, 0.6)

    def analog(v, shot: Shot, rng: Rng):
        out = v.copy()
        for i in (0, 1):
            for j in (0, 1):
                plane = v[i::2, j::2]
                out[i::2, j::2] = (1 - share) * plane + share * ndimage.uniform_filter(plane, 3)
        return out

    return Effect(analog=analog)


FIRST = (
    tear, raster_telegraph, noise_gradient, inl_wave, bank_rows, row_memory, fringes, bit_flips, streaking,
    chirp, clouds, noisy_edges, two_readouts,
)  # fmt: skip
"""Families that thresholds were chosen with from the start."""
LATER = (
    echo, noisy_frames, blinking_blocks, noise_memory, quadrants, repeated_rows, shared_pairs,
    wandering_columns, three_levels, zipper, speckle, spots, smoothed_colours,
)  # fmt: skip
"""Families that took no part in the first part of that work."""
UNLISTED: dict[str, Make] = {make.__name__: make for make in (*FIRST, *LATER)}
