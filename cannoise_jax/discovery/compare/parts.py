"""Recordings beside draws of a simulator, each reduced to what it has beyond them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import fft

from cannoise_jax.discovery.compare.light import Light, light_for
from cannoise_jax.discovery.compare.patterns import Pattern, mean_of, of_other_frames
from cannoise_jax.discovery.compare.pixel_noise import Spread, compared, stand_out, uneven
from cannoise_jax.discovery.compare.run import asked_signal
from cannoise_jax.discovery.compare.sources import Source
from cannoise_jax.discovery.compare.strays import without_strays
from cannoise_jax.discovery.compare.view import Raw, bulk_variance, noise_of, reduce
from cannoise_jax.discovery.frames.calibrate import gain_groups
from cannoise_jax.discovery.frames.contrasts import code_step, steady
from cannoise_jax.discovery.frames.splits import split_recordings
from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.mechanisms.residual import KNOTS
from cannoise_jax.physics.core.settings import settings_of
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK, CaptureSet, Recording, iso_numbers


class Part(NamedTuple):
    """One recording beside the simulator's draws.

    dark: whether it is without light.
    pattern: what stays in the mean, and the simulator's.
    exposure_s: of the recording; signal: of every pixel, DN.
    excess: power beyond the simulator's, DN^2.
    ratio: variance of every pixel over that of the bulk where the simulator has none that stand out.
    level: variance of the bulk, DN^2; contrasts: their number.
    read, own: variance of the simulator's read noise, and of all its noise, DN^2; gain: DN/e-.
    unit: variance of every pixel over the mean, by which all of these are divided.
    loud: variance of every pixel over the bulk's as the simulator has it, 1 where it does not stand out.
    uneven: variance of the pixels' variances over the bulk's squared.
    """

    dark: bool
    pattern: Pattern | None
    exposure_s: float
    signal: Float[np.ndarray, "h w"]
    excess: Float[np.ndarray, "h w"]
    ratio: Float[np.ndarray, "h w"]
    level: float
    contrasts: int
    read: float
    own: float
    gain: float
    unit: Float[np.ndarray, "h w"]
    loud: Float[np.ndarray, "h w"]
    uneven: Spread


def parts_of(
    capture: CaptureSet, source: Source, tell: Callable[[str], None]
) -> tuple[list[Part], list[Part]]:
    """Darks (none where no two frames show what is redrawn), and lit recordings at their knots."""
    step, isos = code_step(capture), iso_numbers(gain_groups(capture))
    looks = [look for look, _ in split_recordings(capture)]

    def one(n: int) -> Part | None:
        tell(f"remainder: recordings, {n + 1} of {len(capture.recordings)}")
        r = capture.recordings[n]
        return _part(r, n, looks[n], source, step, isos[r.iso])

    # One gain setting alone: what is left of another is another remainder.
    iso = capture.recordings[0].iso
    asked = [n for n, r in enumerate(capture.recordings) if looks[n] and r.iso == iso]
    parts = [part for part in each(one, asked) if part is not None]
    darks = [p for p in parts if p.dark]
    lit = [p for p in parts if not p.dark and p.contrasts and p.signal.mean() > 0]
    return (
        darks if any(p.contrasts for p in darks) else [],
        _spread_out(sorted(lit, key=lambda p: float(p.signal.mean()))),
    )


def _spread_out(lit: list[Part]) -> list[Part]:
    """At most `KNOTS` of them, over all signals; of those of one signal the one with most frames."""
    apart: list[Part] = []
    for p in lit:
        if apart and p.signal.mean() < 1.02 * apart[-1].signal.mean():
            apart[-1] = max(apart[-1], p, key=lambda q: q.contrasts)
        else:
            apart.append(p)
    chosen = np.unique(np.linspace(0, len(apart) - 1, min(len(apart), KNOTS)).round().astype(int))
    return [apart[n] for n in chosen]


def _part(r: Recording, number: int, look: list[int], source: Source, step: float, iso: float) -> Part | None:
    """One recording reduced beside twice as many drawn frames; None for one that is not drawn."""
    dark = r.kind in DARK
    high = min(float(r.white_level), 65535.0)
    raw = reduce(np.stack([np.asarray(r.frames[t : t + 1])[0] for t in look]), high, dark, step)
    known = light_for(r, raw.mean, raw.usable, dark)
    if known is None and len(look) < 2:
        return None
    light = Light(0, raw.mean) if known is None else known
    fitted = light.fit(raw.mean, raw.usable)
    clean = asked_signal(r, fitted, source, dark, iso)
    settings = settings_of(r, iso, max(2 * raw.frames, 4))
    frames = source.frames(0, number, clean, settings)
    if frames is None:
        return None
    drawn = reduce(frames, high, dark, step)
    expected = light.fit(drawn.mean, drawn.usable)
    variance = noise_of([drawn], expected, step).sigma(expected) ** 2
    typical = float(np.mean(variance))
    # Colours of a flat differ in noise: all are brought to that of the mean.
    unit = np.ones_like(variance) if dark else variance / typical
    raw, drawn = (
        d._replace(contrasts=(d.contrasts if dark else _steady(d)) / np.sqrt(unit)) for d in (raw, drawn)
    )
    raw, drawn = without_strays(raw, drawn)
    n = len(raw.contrasts)
    own = np.mean(raw.contrasts**2, 0) if n else np.full(raw.mean.shape, typical)
    dof = len(drawn.contrasts)
    theirs = np.mean(drawn.contrasts**2, 0) if dof else np.full(raw.mean.shape, typical)
    if dof and not dark:  # without what the lamp moved
        typical = max(bulk_variance(theirs.ravel(), dof), 1e-6 * step**2)
    # Noise of less than a code leaves most pixels still.
    bulk = max(bulk_variance(own.ravel(), n), 1e-6 * step**2) if n else typical
    pattern = None
    if known is not None:
        # Of darks the level is the simulator's to tell; of flats the light took it. What the simulator has
        # of a pattern is in its draws.
        maps = raw.mean - (expected if dark else fitted), drawn.mean - expected
        recorded, simulated = (np.where(raw.usable, v, 0.0) for v in maps)
        # The noise in means is that of the pixels as they are, not as they are brought to one level.
        each_own, each_drawn = (d.contrasts * np.sqrt(unit) for d in (raw, drawn))
        theirs_mean = mean_of(simulated, each_drawn, drawn.usable, drawn.frames, typical)
        ours_mean = (
            mean_of(recorded, each_own, raw.usable, raw.frames, bulk)
            if n
            else of_other_frames(theirs_mean, recorded, drawn.frames / raw.frames)
        )
        pattern = Pattern(ours_mean, theirs_mean)
    excess = np.zeros(raw.mean.shape)
    if n:
        # The same pixels of both: more frames are drawn, of which fewer noisy ones pass as quiet.
        kept = _alike(raw, own, bulk) & _alike(drawn, theirs, typical)
        excess = _power(raw, kept) - _power(drawn, kept)
    signal = np.maximum(fitted - np.mean(r.black_level), 0)
    # Pixels that the simulator already has noisier than the others are held against what it gives them.
    loud = np.ones_like(own)
    unlike = Spread(0.0, 0.0)
    if dof:
        unlike = compared(
            uneven(raw.contrasts, raw.usable, bulk), uneven(drawn.contrasts, drawn.usable, typical)
        )
        theirs = theirs / max(bulk_variance(theirs.ravel(), dof), 1e-6 * step**2)
        loud = np.where(stand_out(theirs, dof), theirs, 1.0)
    ratio = own / max(bulk, 1e-12) / loud
    white = max(typical - step**2 / 12, 1e-3 * typical)
    read = white if source.read is None else min(source.read, white)
    gain = source.gain or 0.0
    return Part(
        dark, pattern, settings.exposure_s, signal, excess, ratio, bulk, n,
        read, white, gain, unit, loud, unlike,
    )  # fmt: skip


def _steady(raw: Raw) -> Float[np.ndarray, "n h w"]:
    """The contrasts without an offset and a factor of each colour of the frame: those are the lamp's."""
    out = np.empty_like(raw.contrasts)
    for at in SITES:
        for n, contrast in enumerate(raw.contrasts):
            out[n, *at] = steady(contrast[at], raw.mean[at])
    return out


def _alike(raw: Raw, own: Float[np.ndarray, "h w"], bulk: float) -> Bool[np.ndarray, "h w"]:
    """Pixels that are no noisier than others. own: mean square of each pixel."""
    return ~stand_out(own / max(bulk, 1e-12), max(len(raw.contrasts), 1)) & raw.usable


def _power(raw: Raw, kept: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Mean periodogram of the contrasts, DN^2, other pixels than those kept at zero."""
    n = max(len(raw.contrasts), 1)
    total = np.zeros(raw.mean.shape)
    for c in raw.contrasts:
        total += np.abs(fft.fft2(c * kept)) ** 2
    return total / (n * raw.mean.size * max(float(kept.mean()), 1e-6))
