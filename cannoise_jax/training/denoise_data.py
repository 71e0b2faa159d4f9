"""Half-real data for denoisers: dim computed scenes, counted photons, and the real darks of one camera.

On computed noise every noise model trains about equally good denoisers, for what they lack is lacking in the
test too. Here the test's floor is real: its darks hold whatever the camera does. Training and test share no
pixel, no frame and no scene, and whatever is fitted to the camera is fitted to the training part.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.physics.core.poisson_gaussian import sample_poisson
from cannoise_jax.physics.synthetic.scenes import Split, draw_scenes, mosaic
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.recordings.recording import DARK, BadInput, CaptureSet, Recording, mosaic_map

FULL_SCALE_E = 100.0
"""Electrons of a clean value of 1: as dim as scenes are whose darks matter."""
_TRAINING_SHARE = 0.6


@dataclass(frozen=True, eq=False)
class HalfReal:
    """One camera at one exposure. Units: normalised, 1 is `full_scale_e` electrons above black.

    train, test: dark frames about their black level. gain_dn_per_e, read_noise_e: photon transfer of the
    training part; span_dn: DN of a clean value of 1.
    """

    camera: str
    cfa: str
    exposure_s: float
    iso: float | None
    gain_dn_per_e: float
    read_noise_e: float
    full_scale_e: float
    white_level: float
    black_level: tuple[float, ...]
    train: Float[np.ndarray, "t h w"]
    test: Float[np.ndarray, "s h v"]

    @property
    def span_dn(self) -> float:
        """DN above black of a clean value of 1."""
        return self.gain_dn_per_e * self.full_scale_e


def half_real(capture: CaptureSet, exposure_s: float, full_scale_e: float = FULL_SCALE_E) -> HalfReal:
    """The camera's darks of one exposure, parted, with gain and read noise of the training part.

    The first 60 % of the frames of every recording, and the left half of the pixels, are for training; the
    right half of the other frames of the darks is for the test. Black is the median of the training darks of
    this exposure, per mosaic site. Raises BadInput without two such frames, or without a gain.
    """
    place = capture.path or capture.camera
    darks = [r for r in capture.of_kind(*DARK) if _is(r, exposure_s) and r.count > 1]
    if not darks:
        times = sorted({r.exposure_s for r in capture.of_kind(*DARK) if r.exposure_s is not None})
        known = ", ".join(f"{e:g}" for e in times) or "none"
        raise BadInput(f"{place}: no two dark frames of {exposure_s:g} s: exposures of darks, s: {known}")
    dark = darks[0]
    if dark.cfa == "MONO":
        raise BadInput(f"{place}: a camera without colours: the denoiser takes packed colour mosaics")
    training = training_part(capture)
    gain, read = _transfer(training, place)
    own = next(r for r, before in zip(training.recordings, capture.recordings, strict=True) if before is dark)
    frames = np.asarray(own.frames[0 : own.count], np.float32)
    rest = np.asarray(dark.frames[own.count : dark.count], np.float32)
    middle = own.size[1]
    rest = rest[:, : own.size[0], middle : 2 * middle]
    black = site_medians(frames)
    span = np.float32(gain * full_scale_e)
    train, test = ((x - mosaic_map(black, x.shape[1:])) / span for x in (frames, rest))
    return HalfReal(
        capture.camera, dark.cfa, exposure_s, dark.iso, gain, read, full_scale_e, float(dark.white_level),
        tuple(float(b) for b in black), train, test,
    )  # fmt: skip


def stamp(capture: CaptureSet) -> str:
    """A hash of what a camera's recordings show and state, wherever they lie and whatever their files are
    called: other frames would be parted otherwise, and a test would hold pixels of the training."""
    digests = []
    for r in capture.recordings:
        values = (*r.black_level, r.white_level, r.iso, r.exposure_s)
        numbers = [None if v is None else float(v) for v in values]
        own = hashlib.sha256(repr((r.kind, r.cfa, numbers, r.count, *r.size)).encode())
        for t in range(r.count):
            frame = np.ascontiguousarray(r.frames[t : t + 1])
            own.update(frame.astype(frame.dtype.newbyteorder("<"), copy=False).tobytes())
        digests.append(own.hexdigest())
    return hashlib.sha256("".join(sorted(digests)).encode()).hexdigest()


def _is(recording: Recording, exposure_s: float) -> bool:
    return recording.exposure_s is not None and math.isclose(recording.exposure_s, exposure_s, rel_tol=1e-3)


def training_part(capture: CaptureSet) -> CaptureSet:
    """The first 60 % of the frames and the left half of the pixels of every recording."""

    def part(recording: Recording) -> Recording:
        count = max(1, math.ceil(_TRAINING_SHARE * recording.count))
        count = min(count, recording.count - 1) if recording.count > 1 else 1
        height, width = recording.size[0] // 4 * 4, recording.size[1] // 8 * 4
        frames = np.asarray(recording.frames[0:count])[:, :height, :width]
        clean = recording.clean
        if clean is not None:
            clean = np.asarray(clean)[..., :height, :width]
            clean = clean[:count] if clean.ndim == 3 else clean
        return dataclasses.replace(recording, frames=frames, clean=clean)

    return dataclasses.replace(capture, recordings=tuple(part(r) for r in capture.recordings))


def _transfer(training: CaptureSet, place: str) -> tuple[float, float]:
    """System gain (DN/e-) and read noise (e-), means over the mosaic sites."""
    for transfer in photon_transfer(training):
        if isinstance(transfer.baseline, Baseline):
            return float(np.mean(transfer.baseline.gain)), float(np.mean(transfer.baseline.read_noise_e))
    few = [
        name
        for name, kinds in (("flats", ("flat",)), ("darks", DARK))
        if (own := training.of_kind(*kinds)) and all(r.count < 2 for r in own)
    ]
    if few:
        raise BadInput(
            f"{place}: no system gain: of its {' and '.join(few)} one frame is for training, and noise shows "
            "in two: record three frames or more of each"
        )
    raise BadInput(f"{place}: no system gain: add flats and darks, so that photon transfer can measure it")


def site_medians(frames: Float[np.ndarray, "t h w"]) -> Float[np.ndarray, "4"]:
    """The median of every mosaic site over all frames."""
    return np.array([np.median(frames[:, i::2, j::2]) for i in (0, 1) for j in (0, 1)], np.float32)


def dim_scenes(
    key: Key[Array, ""], split: Split, count: int, size: tuple[int, int], cfa: str
) -> Float[np.ndarray, "n h w"]:
    """Clean mosaics in [0, 1]; splits share no scene."""
    return np.stack([mosaic(s.image, cfa) for s in draw_scenes(key, split, count, size)])


def with_photons(
    key: Key[Array, ""], clean: Float[np.ndarray, "h w"], full_scale_e: float
) -> Float[np.ndarray, "h w"]:
    """The clean signal as counted photons: Poisson counts over the full scale."""
    counts = sample_poisson(key, jnp.asarray(clean * np.float32(full_scale_e)))
    return np.asarray(counts) / np.float32(full_scale_e)


def held_out_images(
    data: HalfReal, clean: Float[np.ndarray, "n h w"], key: Key[Array, ""]
) -> Float[np.ndarray, "n h w"]:
    """Noisy mosaics: every scene with its photons on a real dark frame held back, the frames in turn."""
    return np.stack(
        [
            with_photons(jax.random.fold_in(key, i), scene, data.full_scale_e) + data.test[i % len(data.test)]
            for i, scene in enumerate(clean)
        ]
    )
