"""Draws of a simulator at the settings of the recordings, seen as the recordings are: the same mean is taken
out of them, and they are divided by the same standard deviation, that of the baseline."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from scipy import ndimage

from cannoise_jax.discovery.frames.battery import Prepared
from cannoise_jax.discovery.frames.calibrate import modelled, smooth_part
from cannoise_jax.discovery.frames.contrasts import Stack, stack
from cannoise_jax.discovery.frames.dark_lines import Known, lines_for, lines_of
from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import settings_of
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.fields import Fields, frame_fields, native, referred

_CHUNK, _PIXELS = 4, 1 << 17
"""Frames drawn at once, so that one compiled program serves recordings of any length, and of small frames as
many more as have so many pixels in all: drawing a few pixels takes as long as drawing many."""

_SURE, _SHARE = 6.0, 2e-3
"""Standard errors of a site's mean, and share of its level, by which the mean of a flat is missed."""
_FAR, _AROUND = 5.0, 15
"""Standard deviations to which a pixel counts, and rows and columns of a site over which light is even."""

Frames = dict[int, np.ndarray]
"""Drawn frames by number of the recording, `uint16[T, H, W]`, DN."""
Drawing = Callable[[int, Float[np.ndarray, "h w"], Settings], np.ndarray | None]
"""(number of the recording, clean signal, settings) -> DN `[T, H, W]`, rounded to codes; None for a recording
that it cannot draw."""


def drawing(model: SensorModel, key: Key[Array, ""]) -> Drawing:
    """Draws of a sensor model, some frames at a time."""

    def draw(number: int, clean, settings: Settings) -> np.ndarray:
        parts, chunk = [], frames_at_once(np.size(clean))
        for start in range(0, settings.frames, chunk):
            k = jax.random.fold_in(jax.random.fold_in(key, number), start)
            parts.append(
                np.asarray(model.sample(k, jnp.asarray(clean), dataclasses.replace(settings, frames=chunk)))
            )
        return np.concatenate(parts)[: settings.frames]

    return draw


def frames_at_once(pixels: int) -> int:
    """How many frames of so many pixels are drawn by one call, 4 to 64."""
    return _CHUNK << int(np.clip(np.log2(_PIXELS / (_CHUNK * pixels)), 0, 4))


def draw_like(draw: Drawing, prepared: Prepared, times: int = 1) -> Frames:
    """As many frames as every recording of the split has, of its expected signal and at its settings; where
    they are seen against frames before, as many of those first; times: all that so many times."""
    black = {b.iso: b.black_level for b in prepared.baselines}

    def one(pair: tuple[Stack, Fields]) -> np.ndarray | None:
        stacked, field = pair
        r = stacked.recording
        span = min(r.white_level, 65535.0) - float(np.mean(black[r.iso]))
        settings = settings_of(r, prepared.isos[r.iso], times * (field.before + field.frames))
        own = native(field)
        clean = own.signal if field.lit else np.zeros(r.size, np.float32)
        drawn = draw(field.number, (clean / span).astype(np.float32), settings)
        if drawn is None or not field.lit or r.clean is not None:
            return drawn
        # Of a flat the mean is known, not the light: what the simulator adds to that is taken off it.
        off = _off(own, drawn)
        if off is None:
            return drawn
        light = np.maximum(clean + off, 0)
        return draw(field.number, (light / span).astype(np.float32), settings)

    drawn = each(one, zip(prepared.stacks, prepared.fields, strict=True))
    return {f.number: x for f, x in zip(prepared.fields, drawn, strict=True) if x is not None}


def _off(field: Fields, drawn: np.ndarray) -> Float[np.ndarray, "h w"] | None:
    """By what draws miss the smooth mean of a flat, DN; None: by nothing that matters."""
    off, missed = np.zeros(field.mean.shape, np.float32), False
    mean = drawn.mean(0)
    for at in SITES:
        sigma, kept = field.sigma[at] / np.sqrt(len(drawn)), field.usable[at]
        away = mean[at] - field.mean[at]
        middle = median(away[kept]) if kept.any() else 0.0
        # A pixel of its own, hot or dead, is no light.
        held = np.where(kept, np.clip(away, middle - _FAR * sigma, middle + _FAR * sigma), middle)
        off[at] = -ndimage.uniform_filter(held, _AROUND, mode="nearest")
        error = float(median(sigma)) / np.sqrt(max(kept.sum(), 1))
        missed |= misses(float(held.mean()), error, float(field.signal[at].mean()))
    return off if missed else None


def misses(off: float, error: float, level: float) -> bool:
    """Whether the mean of a site is off by more than chance makes it and than matters, DN."""
    return abs(off) > max(_SURE * error, _SHARE * level)


def as_fields(prepared: Prepared, drawn: Frames) -> tuple[Fields, ...]:
    """The drawn frames as fields beside those of the recordings: their own mean taken out, the baseline's
    standard deviation and the recordings' usable pixels."""
    baselines = {b.iso: b for b in prepared.baselines}

    def one(pair: tuple[Stack, Fields], darks: Known) -> tuple[Fields, np.ndarray | None]:
        """The field, and of a dark the lines that it shows."""
        stacked, shown = pair
        r, field = stacked.recording, native(shown)
        frames = drawn[field.number]
        all_frames, a = list(range(len(frames))), field.before
        own = dataclasses.replace(r, frames=frames)
        taken = stack(own, field.number, all_frames[a:], prepared.step, all_frames[:a])
        lines = None if field.lit else lines_of(taken)
        taken = taken._replace(lines=lines_for(r, darks), dust=stacked.dust)
        weight = (field.usable / field.sigma).astype(np.float32)
        static, mean = None, field.mean
        if field.static is not None:
            baseline = baselines[r.iso]
            smooth = smooth_part(taken, baseline, modelled(taken, baseline), field.clean)
            assert smooth is not None  # as the recording, the draw has a fixed pattern
            mean = smooth.astype(np.float32)
            static = ((taken.mean - mean) * weight * np.sqrt(taken.frames)).astype(np.float32)
        drawn_too = field._replace(mean=mean, contrasts=taken.contrasts * weight, static=static)
        return referred(drawn_too, shown.unit), lines

    pairs = [p for p in zip(prepared.stacks, prepared.fields, strict=True) if p[1].number in drawn]
    dark, lit = ([p for p in pairs if p[1].lit == of_light] for of_light in (False, True))
    # Darks first: flats are seen beside the lines that they show.
    first = each(lambda pair: one(pair, ()), dark)
    known = [(s.recording, lines) for (s, _), (_, lines) in zip(dark, first, strict=True)]
    made = {f.number: f for f, _ in (*first, *each(lambda pair: one(pair, known), lit))}
    return tuple(made[f.number] for _, f in pairs)


def within_codes(shape: tuple[int, ...], rng: np.random.Generator) -> Float[np.ndarray, "..."]:
    """Places within a code, of which each is as likely as the next: -1/2 to 1/2 steps of the codes."""
    return rng.random(shape, np.float32) - np.float32(0.5)


def spread_codes(field: Fields, rng: np.random.Generator) -> Float[np.ndarray, "t h w"]:
    """Standardised residual of every frame, each code spread evenly over its step: where the lattice of codes
    lies between those of two recordings is then no difference."""
    frames = frame_fields(field)
    return frames + within_codes(frames.shape, rng) * (field.step * field.weight).astype(np.float32)
