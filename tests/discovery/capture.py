"""Capture sets for the tests of discovery: a plain NumPy camera, apart from the package's own simulator."""

from __future__ import annotations

import numpy as np

from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE = (96, 128)


def scene(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """A normalised mosaic of blobs and edges, per colour."""
    y, x = np.mgrid[0 : size[0], 0 : size[1]] / max(size)
    image = np.full((*size, 4), 0.05)
    for _ in range(20):
        cy, cx, r = *rng.uniform(0, 1, 2), rng.uniform(0.05, 0.25)
        soft = 1 / (1 + np.exp((np.hypot(y - cy, x - cx) - r) * 120))
        image += (rng.uniform(0.01, 0.5, 4) - image) * soft[..., None]
    image[..., 2] = image[..., 1]
    rows, columns = np.indices(size)
    return np.take_along_axis(image, (2 * (rows % 2) + columns % 2)[..., None], -1)[..., 0]


def capture_set(
    seed, alter=None, *, gain=1.5, read=3.0, black=200.0, step=1.0, size=SIZE, kinds="sdf", frames=None
):
    """Scenes with independent references, darks of two exposures and flats of four levels.

    alter(rng) -> function(dn, signal_dn, kind, exposure_s) that changes one frame before it is rounded.
    """
    rng = np.random.default_rng(seed)
    change = alter(rng) if alter else (lambda dn, signal, kind, exposure: dn)
    white = 16383.0
    plan = []
    if "s" in kinds:
        plan += [("scene", scene(rng, size), frames or 4, 0.01) for _ in range(2)]
    if "d" in kinds:
        plan += [("dark", np.zeros(size), frames or 8, t) for t in (0.01, 0.1)]
    if "f" in kinds:
        plan += [("flat", np.full(size, level), frames or 4, 0.01) for level in (0.03, 0.1, 0.3, 0.6)]
    recordings = []
    for n, (kind, clean, count, exposure) in enumerate(plan):
        signal = clean * (white - black)
        stack = []
        for _ in range(count):
            dn = black + gain * (rng.poisson(signal / gain, size) + read * rng.standard_normal(size))
            dn = change(dn, signal, kind, exposure)
            stack.append(np.clip(np.round(dn / step) * step, 0, white))
        recordings.append(
            Recording(
                frames=np.stack(stack).astype(np.uint16),
                cfa="RGGB",
                black_level=(black,) * 4,
                white_level=white,
                kind=kind,
                clean=clean.astype(np.float32) if kind == "scene" else None,
                iso=100.0,
                exposure_s=exposure,
                shot=(gain / (white - black),) * 4,
                read=((gain * read / (white - black)) ** 2,) * 4,
                reference="independent" if kind == "scene" else None,
                path=f"{n}_{kind}.h5",
            )
        )
    return CaptureSet("test camera", tuple(recordings))


def row_offsets(sigma):
    """White row noise, new in every frame."""
    return lambda rng: lambda dn, signal, kind, t: dn + sigma * rng.standard_normal((dn.shape[0], 1))


def column_pattern(sigma):
    """Frozen column offsets."""

    def alter(rng):
        pattern = sigma * rng.standard_normal((1, SIZE[1]))
        return lambda dn, signal, kind, t: dn + pattern

    return alter


def response_map(sigma):
    """Frozen pixel gains."""

    def alter(rng):
        pattern = sigma * rng.standard_normal(SIZE)
        return lambda dn, signal, kind, t: dn + signal * pattern

    return alter


def offset_map(sigma):
    """Frozen pixel offsets."""

    def alter(rng):
        pattern = sigma * rng.standard_normal(SIZE)
        return lambda dn, signal, kind, t: dn + pattern

    return alter


def frame_offsets(sigma):
    """One offset per frame."""
    return lambda rng: lambda dn, signal, kind, t: dn + sigma * rng.standard_normal()


def wave(amplitude, frequency=0.137):
    """Interference of one frequency along the raster scan."""

    def alter(rng):
        n = np.arange(SIZE[0] * SIZE[1])
        return lambda dn, signal, kind, t: (
            dn + amplitude * np.sin(2 * np.pi * frequency * n + rng.uniform(0, 2 * np.pi)).reshape(SIZE)
        )

    return alter
