"""Concealment on real recordings: crops, injected effects, permuted frames, frames held back.

Everything here changes recordings of a real sensor and knows nothing of how they are analysed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cannoise_jax.blind.chain import Camera, Context, Effect, Shot
from cannoise_jax.blind.shifts import Exposed
from cannoise_jax.recordings.recording import DARK, CaptureSet, Recording

INJECTED = ("column_noise", "row_noise", "banding", "amplifier_mismatch", "column_fpn", "dsnu", "column_gain")
"""Effects that can be added to stored codes: their light and charge need not be drawn again."""
LIT, STEPS = ("column_gain",), ("amplifier_mismatch",)
"""Of these: what shows in light alone, and whose strengths add as such instead of as their squares."""


def crop(capture: CaptureSet, size: tuple[int, int], longest: float = np.inf) -> CaptureSet:
    """The middle of every recording, in memory; recordings exposed longer than `longest` seconds left out."""
    kept = []
    for r in capture.recordings:
        if r.exposure_s is not None and r.exposure_s > longest:
            continue
        height, width = (min(have, want) for have, want in zip(r.size, size, strict=True))
        y, x = ((have - want) // 4 * 2 for have, want in zip(r.size, (height, width), strict=True))
        part = np.s_[y : y + height, x : x + width]
        frames = np.stack([np.asarray(r.frames[t : t + 1])[0][part] for t in range(r.count)])
        clean = None if r.clean is None else np.asarray(r.clean)[..., part[0], part[1]]
        kept.append(replace(r, frames=frames, clean=clean))
    return CaptureSet(capture.camera, tuple(kept), capture.path)


def permuted(capture: CaptureSet, rng: np.random.Generator) -> CaptureSet:
    """Every pixel's values in another order, drawn pixel by pixel, among the frames of a recording.

    Marginals, fixed patterns and the lattice of codes stay as they are; what rows, columns, frames and
    neighbours share in time is destroyed.
    """
    return CaptureSet(
        capture.camera,
        tuple(
            replace(r, frames=rng.permuted(np.asarray(r.frames[:]), axis=0), path=r.path)
            for r in capture.recordings
        ),
        capture.path,
    )


def halves(capture: CaptureSet, share: float = 0.4) -> tuple[CaptureSet, CaptureSet]:
    """The first frames of every recording, and the last `share` of them, two at least."""
    first, last = [], []
    for r in capture.recordings:
        held = max(2, round(share * r.count))
        if r.count - held < 2:
            continue
        frames = np.asarray(r.frames[:])
        first.append(replace(r, frames=frames[:-held]))
        last.append(replace(r, frames=frames[-held:]))
    return CaptureSet(capture.camera, tuple(first)), CaptureSet(capture.camera, tuple(last))


def described(capture: CaptureSet, gain: float, read_dn: float, step: float, unit: int) -> Camera:
    """The camera of the recordings, as far as the strength of an effect needs it."""
    r = capture.recordings[0]
    longest = max((x.exposure_s or 0.0 for x in capture.recordings), default=1.0) or 1.0
    return Camera(
        gain, read_dn / gain, r.black_level, r.white_level, step, r.cfa, r.iso or 100.0, unit, longest
    )


def exposed(capture: CaptureSet, camera: Camera) -> list[Exposed]:
    """What the computation of strengths needs; the light of a recording is its own mean frame."""
    return [
        Exposed(
            _electrons(r, camera),
            r.count,
            r.kind,
            (r.exposure_s or 0.0) / camera.longest_exposure_s,
            r.exposure_s or 0.0,
            r.kind != "scene",
            r.kind != "flat",
        )
        for r in capture.recordings
    ]


def _electrons(r: Recording, camera: Camera) -> np.ndarray:
    if r.kind in DARK:
        return np.zeros(r.size)
    mean = np.asarray(r.frames[:], np.float64).mean(0)
    return np.maximum(mean - camera.black_map(r.size), 0) / camera.gain


def injected(capture: CaptureSet, camera: Camera, effect: Effect, rng: np.random.Generator) -> CaptureSet:
    """The recordings with an effect added to the stored codes, the codes' rounding undone and done again.

    Within its step a code is spread evenly before the effect is added, so that effects below the step are not
    lost; without an effect every code comes back as it was. Effects on light act on the signal above black.
    """
    out = []
    for r in capture.recordings:
        codes = np.asarray(r.frames[:]).astype(np.float64)
        shot = Shot(r.path or r.kind, r.kind, np.zeros(r.size), r.count, r.exposure_s or 0.0)
        context = Context(camera, shot, rng, np.zeros(r.size))
        black = camera.black_map(r.size)
        values = codes + camera.step * rng.uniform(-0.5, 0.5, codes.shape)
        if effect.stage == "analog":
            values = effect.apply(values, context)
        elif r.kind not in DARK:
            values = black + effect.apply(values - black, context)
        again = np.rint(values / camera.step) * camera.step
        # A code at a rail says only that the value lay beyond it.
        again = np.where((codes <= 0) | (codes >= codes.max()), codes, np.clip(again, 0, 65535))
        out.append(replace(r, frames=again.astype(np.uint16)))
    return CaptureSet(capture.camera, tuple(out), capture.path)
