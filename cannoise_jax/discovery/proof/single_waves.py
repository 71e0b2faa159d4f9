"""Whether waves that are named are all there is: not some lines of a pattern that repeats.

Interference has one frequency, or few. A pattern that repeats over the frame and lies elsewhere in every
frame has a line at each multiple of one over its period, of which the strongest few pass for waves: then as
many others, as strong as these, are left.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cannoise_jax.discovery.compare.compared import Compared
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.squares import dark_sigma

WAVE = "sinusoid"
"""The law of waves."""
_FEWEST = 3
"""Lines left from which on they may be those of a pattern."""
_AS_STRONG = 0.5
"""Amplitude of one that counts, over that of the wave."""
_NEAR = 0.02
"""Cycles a pixel within which a line may be what is left of a wave that was taken out."""


def one_of_many(steps: Sequence[Step], n: int, whole: Compared) -> Doubt | None:
    """What speaks against a step that names a wave, new in every frame or what is in the mean of all; None:
    nothing does, or it names none. whole: the darks beside draws with all that was found."""
    waves = [s for s in steps if _names_wave(s)]
    darks = tuple(f for f in steps[n].before if f.kind in DARK)
    if not _names_wave(steps[n]) or not darks:
        return None
    least = _AS_STRONG * steps[n].named.score.amplitude / dark_sigma(darks)
    left = [
        p
        for p in whole.peaks
        if p.where == "dark" and p.z > 0 and p.amplitude > least and not _of_any(p.frequency, waves)
    ]
    if len(left) < max(_FEWEST, len(waves)):
        return None
    said = f"{len(left)} more lines as strong as it are left in the spectrum: those of a pattern that repeats"
    return Doubt(len(left) / (len(left) + len(waves)), (said,), instead=True)


def _names_wave(step: Step) -> bool:
    axes = step.named.signature.axes
    return (axes.law, axes.scales) == (WAVE, "additive") and step.named.mechanism != UNKNOWN


def _of_any(frequency: tuple[float, float], waves: Sequence[Step]) -> bool:
    """Whether a line is at the frequency of one of the waves, or at its mirror image."""
    for wave in waves:
        told = wave.named.score.parameters
        known = np.array([told[name][0] for name in ("frequency_y", "frequency_x")])
        for sign in (1, -1):
            apart = np.asarray(frequency) - sign * known
            if np.all(np.abs(apart - np.round(apart)) < _NEAR):
                return True
    return False
