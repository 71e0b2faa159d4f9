"""A capture set with or without effects: which camera, which scenes, what is recorded, and its files.

Cameras, scenes and designs are drawn from wide ranges so that nothing about a set tells whether an effect is
in it: names, attributes, sizes and types are the same either way. The noise level function in the files is
fitted on the recordings themselves, effect included.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from cannoise_jax.blind import chain, peer
from cannoise_jax.blind.chain import Camera, Effect, Shot
from cannoise_jax.blind.shifts import Exposed
from cannoise_jax.recordings.native import write_recording
from cannoise_jax.recordings.recording import Recording

SIZE = (192, 256)
FLATS = (0.02, 0.1, 0.25, 0.5, 0.8)
BURST = 96
ENGINES = {"own": chain.expose, "getframes": peer.expose}


@dataclass(frozen=True)
class Design:
    """A camera, what it records, by which code. reference: of the scenes, `independent` or `burst_mean`."""

    camera: Camera
    shots: tuple[Shot, ...]
    reference: str
    flat_clean: bool
    kind: str
    burst: int = BURST
    engine: str = "own"

    def exposed(self) -> list[Exposed]:
        """What the computation of strengths needs."""
        longest = self.camera.longest_exposure_s
        return [
            Exposed(
                self.camera.electrons(s.clean),
                s.frames,
                s.kind,
                s.exposure_s / longest,
                s.exposure_s,
                s.kind != "scene" or self.reference == "independent",
                s.kind != "flat" or self.flat_clean,
            )
            for s in self.shots
        ]


def draw_camera(rng: np.random.Generator) -> Camera:
    """A camera: 10 to 14 bits in steps of 1, 4 or 16 DN, 3 to 40 ke- at white, read noise 1.5 to 8 e-."""
    bits, step = int(rng.choice((10, 12, 14))), float(rng.choice((1, 4, 16)))
    if bits == 14 and step == 16:
        step = 4.0
    white = (2**bits - 1) * step
    black = np.rint(rng.uniform(0.03, 0.07) * 2**bits) * step
    gain = (white - black) / np.exp(rng.uniform(np.log(3e3), np.log(4e4)))
    read_e = max(float(rng.uniform(1.5, 8)), 0.6 * step / gain)
    return Camera(
        gain=float(gain),
        read_e=read_e,
        black=(float(black),) * 4,
        white=white,
        step=step,
        cfa=str(rng.choice(("RGGB", "GRBG", "GBRG", "BGGR"))),
        iso=float(rng.choice((100, 200, 400, 800))),
        unit=int(rng.integers(2**31)),
        longest_exposure_s=8.0,
    )


def draw_scene(rng: np.random.Generator, size: tuple[int, int] = SIZE, nyquist: float = 0.0) -> np.ndarray:
    """A clean mosaic: soft overlapping shapes in colours, a gradient, some texture; optionally at Nyquist."""
    height, width = size
    y, x = np.mgrid[:height, :width]
    image = np.ones((height, width, 3)) * rng.uniform(0.02, 0.3, 3)
    for _ in range(60):
        cy, cx, radius = rng.uniform(0, height), rng.uniform(0, width), np.exp(rng.uniform(1.2, 4))
        inside = np.hypot(y - cy, (x - cx) * rng.uniform(0.5, 2)) < radius
        image[inside] = np.exp(rng.uniform(np.log(0.005), np.log(0.6))) * rng.uniform(0.4, 1, 3)
    image = ndimage.gaussian_filter(image, (rng.uniform(0.8, 2), rng.uniform(0.8, 2), 0))
    texture = ndimage.gaussian_filter(rng.standard_normal((height, width)), 1.5)
    image = image * (1 + 0.3 * texture[..., None]) * (0.6 + 0.8 * x / width)[..., None]
    mosaic = np.empty(size)
    for site, colour in enumerate((0, 1, 1, 2)):
        mosaic[site // 2 :: 2, site % 2 :: 2] = image[site // 2 :: 2, site % 2 :: 2, colour]
    if nyquist:
        mosaic *= 1 + nyquist * np.where((x // 2 + y // 2) % 2, 1, -1)
    return np.clip(mosaic, 0.002, 0.92)


def draw_design(
    rng: np.random.Generator,
    kind: str = "full",
    reference: str | None = None,
    size: tuple[int, int] = SIZE,
) -> Design:
    """A camera and its shots: 3 scenes x 4 frames, 2 darks x 8, 5 flats x 4, or what `kind` leaves."""
    camera = draw_camera(rng)
    frames = 1 if kind == "single_frames" else 4
    shots = [Shot(f"scene_{i}", "scene", draw_scene(rng, size), frames, 0.02) for i in range(3)]
    if kind in ("full", "no_flats"):
        zero = np.zeros(size)
        shots += [Shot("dark_short", "dark", zero, 8, 0.02), Shot("dark_long", "dark", zero, 8, 8.0)]
    if kind in ("full", "no_darks"):
        shots += [
            Shot(f"flat_{i}", "flat", np.full(size, level), 4, 0.02 * level / FLATS[-1])
            for i, level in enumerate(FLATS)
        ]
    if reference is None:
        reference = "independent" if rng.random() < 0.6 else "burst_mean"
    return Design(camera, tuple(shots), reference, bool(rng.random() < 0.5), kind)


def record(design: Design, effects: tuple[Effect, ...], rng: np.random.Generator) -> list[Recording]:
    """Exposes every shot and describes it as a user's files would."""
    recordings = []
    expose = ENGINES[design.engine]
    exposed = [expose(design.camera, s, effects, rng) for s in design.shots]
    shot, read = fitted_nlf(design, exposed)
    for s, frames in zip(design.shots, exposed, strict=True):
        clean, reference, averaged = _reference(design, s, effects, rng)
        recordings.append(
            Recording(
                frames=frames,
                cfa=design.camera.cfa,
                black_level=design.camera.black,
                white_level=design.camera.white,
                camera="camera",
                kind=s.kind,  # type: ignore[arg-type]
                clean=clean,
                iso=design.camera.iso,
                exposure_s=s.exposure_s,
                shot=(shot,) * 4,
                read=(read,) * 4,
                code_step=design.camera.step,
                reference=reference,
                reference_frames=averaged,
                path=f"{s.name}.h5",
            )
        )
    return recordings


def _reference(design: Design, s: Shot, effects: tuple[Effect, ...], rng: np.random.Generator):
    if s.kind == "dark" or (s.kind == "flat" and not design.flat_clean):
        return None, None, None
    if s.kind == "flat" or design.reference == "independent":
        return s.clean.astype(np.float32), "independent", None
    total, done = np.zeros(s.clean.shape), 0
    while done < design.burst:  # in parts, so that a burst never lies in memory whole
        part = ENGINES[design.engine](design.camera, replace(s, frames=8), effects, rng)
        total += part.astype(np.float64).sum(0)
        done += 8
    camera = design.camera
    black = camera.black_map(s.clean.shape)  # type: ignore[arg-type]
    clean = (total / done - black) / (camera.white - np.mean(camera.black))
    return clean.astype(np.float32), "burst_mean", done


def fitted_nlf(design: Design, exposed: list[np.ndarray]) -> tuple[float, float]:
    """shot and read of var = shot clean + read by least squares over levels, on whatever was recorded."""
    camera = design.camera
    scale = camera.white - np.mean(camera.black)
    means, variances, weights = [], [], []
    for s, frames in zip(design.shots, exposed, strict=True):
        values = (frames.astype(np.float64) - camera.black_map(s.clean.shape)) / scale  # type: ignore[arg-type]
        if len(frames) > 1:
            squares = np.var(values, axis=0, ddof=1)
            level = values.mean(0)
        else:
            squares, level = (values[0] - s.clean) ** 2, s.clean
        edges = np.unique(np.quantile(s.clean, np.linspace(0, 1, 9)))
        index = np.clip(np.searchsorted(edges, s.clean, side="right") - 1, 0, max(len(edges) - 2, 0))
        for k in np.unique(index):
            means.append(level[index == k].mean())
            variances.append(squares[index == k].mean())
            weights.append((index == k).sum() / max(variances[-1], 1e-12) ** 2)
    root = np.sqrt(weights)
    design_matrix = np.stack([np.asarray(means), np.ones(len(means))], 1) * root[:, None]
    (slope, floor), *_ = np.linalg.lstsq(design_matrix, np.asarray(variances) * root, rcond=None)
    return max(float(slope), 1e-9), max(float(floor), 1e-12)


def write_set(folder: Path, recordings: list[Recording]) -> None:
    """Writes the recordings of one set into `folder`, one native file each."""
    folder.mkdir(parents=True, exist_ok=True)
    for recording in recordings:
        write_recording(folder / str(recording.path), replace(recording, path=None))
