"""The battery for one capture set: its fields under the fitted baseline, and every signature that applies."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.frames.calibrate import fit_baseline, gain_groups, standardise, stated_black
from cannoise_jax.discovery.frames.contrasts import (
    Stack,
    code_step,
    detected_step,
    stack,
)
from cannoise_jax.discovery.frames.dark_lines import beside_darks
from cannoise_jax.discovery.frames.dust import beside_dust
from cannoise_jax.discovery.frames.simulated import drawn_black, drawn_parameters, drawn_rise
from cannoise_jax.mechanisms import ENTRIES, signatures
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import DARK, BadInput, CaptureSet, Recording, iso_numbers
from cannoise_jax.signatures.behind_gain import BEHIND
from cannoise_jax.signatures.code_spacing import occurrences
from cannoise_jax.signatures.fields import Fields, referred, refit
from cannoise_jax.signatures.levels import charge_beyond, frame_jitter
from cannoise_jax.signatures.recorded import Codes, GroupBaseline, Recorded, Stated
from cannoise_jax.signatures.signature import Signature

_PILE = 1e-3
"""Share of the pixels at the lowest or highest value of a recording that is a pile-up: of normal noise the
extreme value of 10,000 and more has a hundredth of that."""
BROAD = 3.0
"""Standard deviation, in codes, from which a pixel's noise is broad enough to judge the lattice of codes."""
ONE_ELECTRON = 0.8
"""Read noise, electrons, below which a histogram of millions of pixels shows the electrons one by one."""


_KNOWN_GAIN = 0.2
"""Standard error of a gain, as a share of it, below which strengths are carried over by it."""
_DEAD = 0.5
"""Share of the light from which on a pixel that misses it has other noise than its signal says."""
LEAST_SIDE = 32
"""Rows and columns from which the laws of the statistics hold."""


class Prepared(NamedTuple):
    """One split of a capture set, ready for the statistics. isos: by which a camera model knows each gain
    setting of the whole set."""

    fields: tuple[Fields, ...]
    baselines: tuple[GroupBaseline, ...]
    signatures: tuple[Signature, ...]
    stacks: tuple[Stack, ...]
    step: float
    span: float
    isos: dict[float | None, float]


def prepare(
    capture: CaptureSet,
    chosen: list[list[int]],
    judge_stated: bool,
    drawn: CaptureSet | None = None,
    before: list[list[int]] | None = None,
    entries: tuple[Entry, ...] = ENTRIES,
) -> Prepared:
    """Reads the chosen frames of every recording once, fits the baseline and builds fields and signatures.

    chosen: frame numbers per recording; recordings without any are left out.
    judge_stated: whether gain and read noise of the files are to be judged.
    drawn: frames of a simulator, whose gain and read noise are judged instead of those of the files.
    before: frames per recording whose mean the chosen ones are seen against as well.
    entries: mechanisms that are looked for.
    Raises BadInput for recordings of fewer than `LEAST_SIDE` rows or columns.
    """
    first = capture.recordings[0]
    for r in capture.recordings:
        height, width = r.frames.shape[1:]
        if min(height, width) < LEAST_SIDE:
            raise BadInput(
                f"{r.path or 'recording'}: {height}x{width} pixels: give {LEAST_SIDE}x{LEAST_SIDE} or more"
            )
        if r.size != first.size:
            raise BadInput(
                f"{r.path or 'recording'}: {height}x{width} pixels, {first.path or 'the first'} has "
                f"{first.size[0]}x{first.size[1]}: give recordings of one size"
            )
    step = code_step(capture)
    known = before or [[] for _ in chosen]
    read = [
        stack(r, n, c, step, b)
        for n, (r, c, b) in enumerate(zip(capture.recordings, chosen, known, strict=True))
        if c
    ]
    stacks = beside_dust(beside_darks(read))
    _check_noise(stacks)
    isos = gain_groups(capture)
    groups = [[s for s in stacks if s.recording.iso == iso] for iso in isos]
    baselines = tuple(fit_baseline(g, iso) for g, iso in zip(groups, isos, strict=True) if g)
    order = {baseline.iso: n for n, baseline in enumerate(baselines)}
    # A lit recording's own contrasts say how noisy it is better than the curve through all of them.
    fields = refit(
        tuple(standardise(s, baselines[order[s.recording.iso]], order[s.recording.iso]) for s in stacks)
    )
    units = gain_units(baselines, iso_numbers(isos))
    same = tuple(referred(f, units[f.group]) for f in fields)
    span = float(np.mean([r.white_level - np.mean(r.black_level) for r in capture.recordings]))
    stated = None
    if drawn is not None:
        stated = drawn_parameters(drawn, baselines, step)
    elif judge_stated:
        stated = stated_parameters(capture, baselines)
    black, greens, rounded = described(capture, step, order)
    rise = (0.0, 0.0)
    if drawn is not None:
        rise = drawn_rise(drawn, baselines, units)
        black, rounded = drawn_black(drawn, baselines, units, rise[0], black), 0.0
    jitter, mono = frame_jitter(same), first.cfa == "MONO"
    recorded = Recorded(
        black=black,
        greens=greens,
        tolerance=rounded,
        jitter=jitter,
        codes=collect_codes(capture, stacks, fields, chosen, step),
        baselines=baselines,
        stated=stated,
        fitted_too=drawn is not None,
        step=step,
        span=span,
        mono=mono,
        times={n: list(frames) for n, frames in enumerate(chosen)},
        occurred=occurrences(stacks, fields, chosen, step),
        units=tuple(units),
        seconds=tuple(r.exposure_s for r in capture.recordings if r.exposure_s is not None),
        rise=rise,
        charge=charge_beyond(same, jitter, rise, baselines) if stated is not None else (),
        unlit=tuple(f for f in same if not f.lit),
        flats=tuple(f._replace(contrasts=f.contrasts[:0].copy()) for f in same if f.kind == "flat" and mono),
    )
    # Every pixel of some flats is full in one frame or another: these tell the codes of full ones alone.
    told = [n for n, f in enumerate(same) if f.usable.any()] or range(len(same))
    return Prepared(
        tuple(same[n] for n in told),
        baselines,
        signatures(recorded, entries),
        type(stacks)(stacks[n] for n in told),
        step,
        span,
        iso_numbers(isos),
    )


def first_gain(baselines: tuple[GroupBaseline, ...], isos: dict[float | None, float]) -> GroupBaseline:
    """The baseline of the lowest gain setting, at which the strengths of a camera model hold."""
    return min(baselines, key=lambda b: isos[b.iso])


def gain_units(baselines: tuple[GroupBaseline, ...], isos: dict[float | None, float]) -> list[float]:
    """Gain of every setting over that of the lowest one: DN of each in one DN of that. Ones where a gain was
    not measured."""
    if not all(np.all((b.gain_stderr > 0) & (b.gain_stderr < _KNOWN_GAIN * b.gain)) for b in baselines):
        return [1.0] * len(baselines)
    first = first_gain(baselines, isos)
    return [float(np.mean(b.gain) / np.mean(first.gain)) for b in baselines]


def in_units_of(prepared: Prepared, first: Prepared) -> Prepared:
    """A split in the units of another one, by which what is behind the gain is looked for too: gains that its
    own few frames tell are other ones, or none."""
    units = {first.baselines[f.group].iso: f.unit for f in first.fields}
    own = {n: units.get(b.iso, 1.0) for n, b in enumerate(prepared.baselines)}
    kept = [s for s in prepared.signatures if not s.name.endswith(BEHIND)]
    return prepared._replace(
        fields=tuple(referred(f, own[f.group]) for f in prepared.fields),
        signatures=(*kept, *(s for s in first.signatures if s.name.endswith(BEHIND))),
    )


def _check_noise(stacks: tuple[Stack, ...]) -> None:
    for s in stacks:
        if len(s.contrasts) and s.usable.any() and not s.contrasts.any():
            what = "holds one value only" if s.low == s.high else "repeats one frame"
            raise BadInput(
                f"{s.recording.path or 'recording'}: {what}: there is no noise to judge; leave it out"
            )
    if not any(s.usable.any() for s in stacks):
        raise BadInput(
            f"{stacks[0].recording.path or 'recordings'}: every pixel is at a rail, and so in all others: "
            "record darker or brighter frames"
        )


def described(
    capture: CaptureSet, step: float, isos: Iterable[float | None]
) -> tuple[np.ndarray, tuple[int, int] | None, float]:
    """Stated black levels of the gain settings, DN, the sites of the two greens, and how far black levels may
    be rounded, DN."""
    black = np.stack([stated_black(_darks([r for r in capture.recordings if r.iso == iso])) for iso in isos])
    cfa = capture.recordings[0].cfa
    greens = None if cfa == "MONO" else tuple(n for n, letter in enumerate(cfa) if letter == "G")
    # A stated level is rounded to what it is a multiple of: a code, or a whole number.
    rounded = next((u for u in (step, 1.0) if np.allclose(black / u, np.round(black / u), atol=1e-4)), 0.0)
    return black, greens, 0.5 * rounded  # type: ignore[return-value]


def _darks(recordings: list[Recording]) -> list[Recording]:
    return [r for r in recordings if r.kind in DARK] or recordings


def stated_parameters(capture: CaptureSet, baselines: tuple[GroupBaseline, ...]) -> tuple[Stated | None, ...]:
    """Gain and read noise of the files per gain setting; None where not stated. None, or less, is taken as
    next to none, so that it is judged, too."""
    out: list[Stated | None] = []
    for baseline in baselines:
        chosen = [r for r in capture.recordings if r.iso == baseline.iso and r.shot and r.read]
        if not chosen:
            out.append(None)
            continue
        r = chosen[0]
        span = r.white_level - np.asarray(r.black_level)
        read = np.sqrt(np.maximum(np.asarray(r.read), 0.0)) * span
        gain, read = np.maximum(np.asarray(r.shot) * span, 1e-6), np.maximum(read, 1e-3)
        out.append(Stated(gain, read, np.zeros(4), np.zeros(4)))
    return tuple(out)


def _smoothing(field: Fields, wide: np.ndarray, step: float) -> float:
    """Standard deviation, codes, of the normal law that smooths the histogram of these pixels at least: all
    of their noise, or of the read noise alone where that leaves the codes of single electrons apart."""
    read = np.sqrt(median((field.sigma**2 * (1 - field.shot))[wide]))
    apart = field.lit and read < ONE_ELECTRON * float(np.mean(field.gain))
    return float(read if apart else field.sigma[wide].min()) / step


def _rails(stacked: Stack, first: int) -> tuple[float, float]:
    """Lowest and highest value that a recording can have, DN: those that it has where its first frame piles
    up there."""
    frame = np.asarray(stacked.recording.frames[first : first + 1])[0]
    low = stacked.low if np.mean(frame <= stacked.low) > _PILE else 0.0
    return low, stacked.high if np.mean(frame >= stacked.high) > _PILE else stacked.recording.white_level


def collect_codes(capture, stacks, fields, chosen, step: float) -> Codes:
    """Histograms of the stored codes: of pixels with broad noise, and of every dark."""
    of_value = (np.arange(65536) // step).astype(np.int64)
    broad = np.zeros(int(65536 // step) + 1)
    dark, lowest = [], []
    narrowest = np.inf
    for s, f in zip(stacks, fields, strict=True):
        # Away from the rails: a pile-up there is no comb.
        low, high = _rails(s, chosen[s.number][0])
        wide = (
            f.usable & (f.sigma > BROAD * step) & (f.mean > low + 6 * f.sigma) & (f.mean < high - 6 * f.sigma)
        )
        if f.lit and f.static is not None:  # dead pixels are as narrow as the read noise
            wide &= f.static * f.sigma > -_DEAD * f.signal * np.sqrt(f.frames)
        is_dark = f.kind in DARK
        if not is_dark and wide.mean() < 0.02:
            continue
        counts = np.zeros_like(broad)
        for t in chosen[s.number][:16]:
            frame = of_value[np.asarray(s.recording.frames[t : t + 1])[0]]
            if wide.any():
                broad += np.bincount(frame[wide], minlength=broad.size)
            if is_dark:
                counts += np.bincount(frame.ravel(), minlength=broad.size)
        if wide.any():
            narrowest = min(narrowest, _smoothing(f, wide, step))
        if is_dark:
            dark.append(counts)
            lowest.append(0)
    stated = {r.code_step for r in capture.recordings if r.code_step}
    return Codes(
        broad,
        narrowest if np.isfinite(narrowest) else 0.0,
        tuple(dark),
        tuple(lowest),
        step,
        detected_step(capture),
        float(stated.pop()) if len(stated) == 1 else None,
    )
