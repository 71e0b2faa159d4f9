"""What a simulator has more of than the recordings, by the signatures that tell it in its own draws; and what
single pixels have at another strength than at the same places of the recordings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.frames.battery import Prepared
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import Signature

_SURE = 4.0
"""Standard errors of the difference: of ten mechanisms one is said to be too strong once in 3,000 runs."""
_LESS = 0.8
"""Share of what the simulator has, of which the recordings have less: a fit may be off by some per cent."""

_LESS_OF_FEW = 0.5
"""The same of what a few pixels have: two units of one camera have more and fewer."""


_SAME_PLACES = 0.2
"""Strength at the places of the simulator's own, over its own, from which on the recordings are of that unit:
pixels of another one lie elsewhere."""


class Excess(NamedTuple):
    """A mechanism of which the simulator has too much, or of single pixels of the same unit too little: its
    strength in the simulator's draws and in the recordings, with the standard error of either. elsewhere:
    whether it is of single pixels, and those of the recordings are others."""

    mechanism: str
    simulated: float
    recorded: float
    simulated_error: float
    recorded_error: float
    elsewhere: bool = False

    @property
    def sign(self) -> str:
        """What the simulator has of it."""
        return "too much" if self.simulated > self.recorded else "too little"


def excess(
    own: tuple[Step, ...], recorded: Prepared, held: frozenset[str] | None = None
) -> tuple[Excess, ...]:
    """Of what the simulator's own draws show, what the recordings show less of, strongest evidence first.

    recorded: a split of the recordings as they are, in which the same finding is looked for again: a wave at
    its frequency, a glow of its form. Left to the layer that knows no names is what is frozen and no scatter
    of pixels or lines, where there is no such look. held: mechanisms of a camera model, of which a level in
    its draws is one, or a trace of another.
    """
    known = {s.name: s for s in recorded.signatures}
    out: list[tuple[float, Excess]] = []
    for step in own:
        named, signature = step.named, known.get(step.named.signature.name)
        rare = named.signature.rare
        level = named.signature.frozen and not rare and not np.isfinite(named.score.drawn)
        if named.mechanism == UNKNOWN or signature is None:
            continue
        trace = held is not None and named.mechanism not in held
        again = (signature.again or signature.strength) and not trace
        if level and not (signature.beyond or again):
            continue
        there = _strength(named.signature.quoted(named.score, named.mechanism))
        same = _at_its_places(step, recorded)
        if same is not None:
            share, error = same
            off = abs(share - 1) / error
            if off > _SURE and not _LESS < share < 1 / _LESS:
                here = (share * there[0], error * there[0])
                # How many pixels are drawn says nothing of the same ones.
                out.append((off, Excess(named.mechanism, there[0], here[0], here[1], here[1])))
            continue
        score = _found_again(step, signature, recorded)
        if score is not None and signature.beyond:
            more, _, error = next(iter(score.parameters.values()))
            here = (max(there[0] + more, 0.0), error)
        else:
            here = (0.0, 0.0) if score is None else _strength(signature.quoted(score, named.mechanism))
            if signature.axes.white_lines:
                here = min(here, _of_single_lines(signature, recorded.fields))
        sigmas = (there[0] - here[0]) / max(float(np.hypot(there[1], here[1])), 1e-30)
        if sigmas > _SURE and here[0] < (_LESS_OF_FEW if rare else _LESS) * there[0]:
            elsewhere = named.signature.single_pixels
            out.append((sigmas, Excess(named.mechanism, there[0], here[0], there[1], here[1], elsewhere)))
    return tuple(e for _, e in sorted(out, key=lambda pair: -pair[0]))


def _found_again(step: Step, signature: Signature, recorded: Prepared) -> Score | None:
    """What the recordings show of a finding of the simulator's draws; of single pixels, whose places say
    nothing of another unit, of their kind. signature: that of the recordings."""
    score = step.named.score
    if signature.single_pixels or signature.rare:
        return signature.score(recorded.fields)
    if signature.strength is not None:
        return signature.strength(score, step.before, recorded.fields)
    return signature.score_again(recorded.fields, score)


def _of_single_lines(signature: Signature, fields: Many) -> tuple[float, float]:
    """Strength and error of white noise of lines by what neighbouring lines differ by: 1/f noise of rows,
    which neighbours share, looks like it in all rows together."""
    axis = 0 if signature.axes.varies_over == "row" else 1
    score = signature.score(tuple(_between_lines(f, axis) for f in fields))
    return (0.0, 0.0) if score is None else _strength(signature.quoted(score, ""))


def _between_lines(field: Fields, axis: int) -> Fields:
    """The field with what every line has beyond the next in its contrasts, of as much noise, and nothing that
    stays."""
    count = field.mean.shape[axis] - 1

    def cut(values: np.ndarray, start: int = 0) -> np.ndarray:
        return np.take(values, np.arange(start, start + count), axis - 2)

    apart = (cut(field.contrasts) - cut(field.contrasts, 1)) / np.float32(np.sqrt(2))
    usable = cut(field.usable) & cut(field.usable, 1)
    clean = None if field.clean is None else cut(field.clean)
    mean, signal, sigma, shot = map(cut, (field.mean, field.signal, field.sigma, field.shot))
    return field._replace(
        mean=mean, signal=signal, sigma=sigma, shot=shot, usable=usable, contrasts=apart * usable,
        static=None, clean=clean,
    )  # fmt: skip


def _at_its_places(step: Step, recorded: Prepared) -> tuple[float, float] | None:
    """Strength of the recordings where the simulator's single pixels stand out, over theirs, and its standard
    error; None where it does not tell, or the recordings are of another unit."""
    signature, score = step.named.signature, step.named.score
    if not signature.single_pixels or signature.strength is None or not score.amplitude > 0:
        return None
    # Both by what the same heat of every pixel explains, whatever law it was drawn from.
    own, again = (signature.strength(score, step.before, f) for f in (step.before, recorded.fields))
    if own is None or again is None or not again.error > 0 or again.amplitude < _SAME_PLACES * own.amplitude:
        return None
    return again.amplitude / own.amplitude, again.error / own.amplitude


def _strength(score: Score) -> tuple[float, float]:
    """Amplitude and its error."""
    return score.amplitude, float(score.error) if np.isfinite(score.error) else score.amplitude
