"""The layer at work: every recording is read, drawn as often, reduced and measured, and all of it judged."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.discovery.compare.compared import Compared, Measured, Seen, Statistics
from cannoise_jax.discovery.compare.families import SHARED
from cannoise_jax.discovery.compare.judge import judge
from cannoise_jax.discovery.compare.lamp import steadied, without_wave
from cannoise_jax.discovery.compare.light import Light, light_for
from cannoise_jax.discovery.compare.measure import is_coarse, measure, shared, shared_variance
from cannoise_jax.discovery.compare.sources import Source, open_source
from cannoise_jax.discovery.compare.view import Raw, chosen_frames, noise_of, reduce, view
from cannoise_jax.discovery.frames.calibrate import gain_groups
from cannoise_jax.discovery.frames.calls import checked_capture, checked_key
from cannoise_jax.discovery.frames.contrasts import code_step
from cannoise_jax.discovery.frames.draws import misses
from cannoise_jax.discovery.frames.simulate import Draw
from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.physics.core.mechanism import HasRecord
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.settings import settings_of
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK, BadInput, CaptureSet, Recording, iso_numbers

DRAWN = 40e6
"""Pixels that are drawn at most, all sets and frames together; at least two sets are."""
MOST_SETS = 4
"""Sets that are drawn at most: with four the draws add a quarter to the variance of a difference."""
Chosen = list[tuple[list[int], list[int]]]
"""Of every recording the frames before those that are looked at, and these."""


def compare_bank(
    capture: CaptureSet,
    simulator: str | Path | SensorModel | CaptureSet | Draw | Source,
    key: Key[Array, ""] | None = None,
    *,
    alpha: float = 0.01,
    sets: int | None = None,
    held_back: Chosen | None = None,
    mechanisms: Sequence[HasRecord] = (),
    tell: Callable[[str], None] = lambda text: None,
) -> Compared:
    """All statistics of the bank, of the recordings and of draws of a simulator at equal settings.

    held_back: of every recording the frames that are looked at, and those before them which lend their mean
    alone (all frames where not given). mechanisms: entries from outside the package that a sensor.json may
    name. Raises BadInput for a simulator that cannot be judged, ValueError for an alpha out of (0, 1),
    TypeError for what is no capture set or no key.
    """
    if not 0 < alpha < 1:
        raise ValueError(f"alpha must lie between 0 and 1, got {alpha}")
    capture, key = checked_capture(capture), checked_key(key)
    source = simulator if isinstance(simulator, Source) else open_source(simulator, capture, key, mechanisms)
    chosen = held_back or [([], chosen_frames(r).tolist()) for r in capture.recordings]
    work = [
        (len(a) + len(b)) * r.size[0] * r.size[1] if b else 0
        for r, (a, b) in zip(capture.recordings, chosen, strict=True)
    ]
    total = sum(work)
    count = int(np.clip(DRAWN // total, 2, MOST_SETS)) if sets is None else sets
    count = count if source.sets is None else min(count, source.sets)
    step = code_step(capture)
    isos = iso_numbers(gain_groups(capture))
    began = time.monotonic()
    recorded: dict[str, Measured] = {}
    simulated: dict[str, list[Measured]] = {}
    seen: dict[str, Seen] = {}

    def one(number: int):
        r = capture.recordings[number]
        spent, ready = time.monotonic() - began, sum(work[:number])
        more = spent * (total - ready) / ready if ready else 0.0
        left = f", some {more:.0f} s more" if more >= 1 else ""
        tell(f"compare: {Path(r.path or r.kind).name}, {number + 1} of {len(capture.recordings)}{left}")
        return _one(source, number, r, chosen[number], sets=count, step=step, iso=isos[r.iso])

    asked = [number for number, (_, frames) in enumerate(chosen) if frames]
    for number, done in zip(asked, each(one, asked), strict=True):
        if done is None:
            continue
        r = capture.recordings[number]
        name = Path(r.path or f"{number} {r.kind}").stem
        name = name if name not in seen else f"{name} ({number})"
        seen[name], recorded[name], simulated[name] = done[0]._replace(name=name), done[1], done[2]
    if not recorded:
        raise BadInput(
            f"{source.label}: draws none of the recordings: give flats, or darks to a camera model"
        )
    _between(recorded, simulated, seen)
    kinds = {n: "dark" if s.kind in DARK else "lit" for n, s in seen.items()}
    judgements, peaks = judge(recorded, simulated, kinds, alpha)
    return Compared(
        label=source.label, camera=capture.camera, alpha=alpha, seen=seen, recorded=recorded,
        simulated=simulated, judgements=judgements, peaks=peaks, sets=count, step=step,
        held_back=held_back is not None,
    )  # fmt: skip


def _one(
    source: Source,
    number: int,
    r: Recording,
    chosen: tuple[list[int], list[int]],
    *,
    sets: int,
    step: float,
    iso: float,
) -> tuple[Seen, Measured, list[Measured]] | None:
    """One recording: its bank, and that of every set; None where the simulator draws none of it."""
    before = len(chosen[0])
    frames = np.stack([np.asarray(r.frames[t : t + 1])[0] for t in (*chosen[0], *chosen[1])])
    dark = r.kind in DARK
    high = min(float(r.white_level), 65535.0)
    raw = reduce(frames, high, dark, step, before)
    even = r.kind == "flat"  # of a scene rows differ anyway
    steady = without_wave(raw.mean, raw.contrasts, r.black_level) if even else raw.mean
    light = light_for(r, steady, raw.usable, dark)
    known = light if light is not None else _scene(raw)
    fitted = known.fit(steady, raw.usable)
    clean = asked_signal(r, fitted, source, dark, iso)
    settings = settings_of(r, iso, len(frames))
    for _ in range(_TRIES):
        drawn = [source.frames(m, number, clean, settings) for m in range(sets)]
        if any(d is None for d in drawn):
            return None
        if len(drawn[0]) < len(frames):  # type: ignore[arg-type]
            raw = reduce(frames[: len(drawn[0])], high, dark, step, before)  # type: ignore[arg-type]
        raws = [reduce(d, high, dark, step, before) for d in drawn]  # type: ignore[arg-type]
        off = None if dark or r.clean is not None else _off(raws, known, fitted)
        if off is None:
            break
        # Of a light that is not known the mean tells, whatever moves it: sites that share charge.
        clean = np.maximum(clean + off / _span(r, source, iso), 0).astype(np.float32)
    if even:
        raw, raws = steadied(raw, raws, fitted, r.black_level)
    means = [known.fit(d.mean, d.usable) for d in raws]
    noise = noise_of(raws, np.mean(means, 0), step)
    level = dark and light is not None
    variance = np.array([float(np.mean(v)) for v in noise.variance])
    degree = light.degree if light is not None else 0
    coarse = is_coarse(variance, step)
    follows = np.diff(chosen[1]) <= _NEAR
    real = measure(view(raw, noise, fitted, light, step, coarse), level, degree, variance, step, follows)
    simulated = []
    while raws:
        seen = view(raws.pop(0), noise, means.pop(0), light, step, coarse)
        simulated.append(measure(seen, level, degree, variance, step, follows))
    sigma, log_sigma = np.sqrt(variance), float(np.mean(np.log(noise.sigma(fitted))))
    signal = float(np.mean(fitted) - np.mean(r.black_level))
    return (
        Seen(
            name="",
            kind=r.kind,
            sigma=sigma,
            log_sigma=log_sigma,
            signal=signal,
            size=r.size,
            frames=raw.frames,
            exposure_s=r.exposure_s,
            degree=degree,
        ),
        real,
        simulated,
    )


_NEAR = 2
"""Frames apart up to which one may keep enough of another: of many frames every second one is looked at, of
which every fourth is held back."""
_TRIES = 3
"""Times that a light is asked for until its mean is that of the recording."""


def _off(raws: list[Raw], known: Light, fitted: np.ndarray) -> Float[np.ndarray, "h w"] | None:
    """By what the draws miss the mean of a recording, DN; None: by nothing that matters."""
    off = fitted - np.mean([known.fit(d.mean, d.usable) for d in raws], 0)
    for at in SITES:
        pixels = np.concatenate([d.mean[at][d.usable[at]] for d in raws])
        error = float(np.std(pixels)) / np.sqrt(max(pixels.size, 1))
        if pixels.size and misses(float(np.mean(off[at])), error, float(np.mean(fitted[at]))):
            return off
    return None


def _span(r: Recording, source: Source, iso: float) -> float:
    """DN of a normalised signal of one, as the simulator has it."""
    cell = r.black_level if source.black is None else source.black(iso)
    return (float(r.white_level) if source.white is None else source.white) - float(np.mean(cell))


def _scene(raw: Raw) -> Light:
    """The scene by itself: its own mean."""
    return Light(0, raw.mean)


def asked_signal(r: Recording, fitted: np.ndarray, source: Source, dark: bool, iso: float) -> np.ndarray:
    """The normalised signal to ask for at an ISO."""
    if dark:
        return np.zeros(r.size, np.float32)
    if r.clean is not None:
        clean = np.asarray(r.clean, np.float32)
        return clean.mean(0) if clean.ndim == 3 else clean
    cell = np.asarray(r.black_level if source.black is None else source.black(iso), np.float32)
    black = np.empty(r.size, np.float32)
    for value, at in zip(cell, SITES, strict=True):
        black[at] = value
    white = float(r.white_level) if source.white is None else source.white
    return np.maximum((fitted - black) / (white - black), 0).astype(np.float32)


def _between(
    recorded: dict[str, Measured], simulated: dict[str, list[Measured]], seen: dict[str, Seen]
) -> None:
    """Adds what the static maps of two recordings share, as a family of the second."""
    order = [n for n in recorded if recorded[n].static is not None]
    order.sort(key=lambda n: (seen[n].kind not in DARK, seen[n].exposure_s or 0.0))
    for first, second in zip(order, order[1:], strict=False):
        if seen[first].size != seen[second].size:
            continue

        def family(a: Measured, b: Measured) -> Statistics:
            assert a.static is not None and b.static is not None
            return Statistics("mean", shared(a.static, b.static)[None], shared_variance(a.static, b.static))

        recorded[second].families[SHARED] = family(recorded[first], recorded[second])
        for a, b in zip(simulated[first], simulated[second], strict=True):
            b.families[SHARED] = family(a, b)
