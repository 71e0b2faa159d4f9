"""Mains flicker: light that pulses while a rolling shutter reads, so that it varies from row to row.

A sinusoid along the rows, of one frequency in all lit recordings, its phase new in every frame. Where it
stands far out of the noise, its amplitude from frame to frame, its harmonics and the shape of the light that
it multiplies show too: no sinusoid of one amplitude is left without a remainder. A remainder is not held
against it where the sinusoid explains nearly all that the rows share.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import fft, ndimage

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.added import placed, strength
from cannoise_jax.signatures.answers import response
from cannoise_jax.signatures.fields import Fields, map_contrasts
from cannoise_jax.signatures.group_sums import LineSums
from cannoise_jax.signatures.handed import Found
from cannoise_jax.signatures.lamp_wave import Lamp, lamp_wave
from cannoise_jax.signatures.least import signal, sinusoid
from cannoise_jax.signatures.line_sums import line_sums
from cannoise_jax.signatures.phasors import orthonormal, projected_out, rician_fit, without
from cannoise_jax.signatures.score import Score, sidak, variance_component
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    COVERS_NOTHING,
    NO_LAW,
    NO_PATTERN,
    STATIC,
    Axes,
    Signature,
)
from cannoise_jax.signatures.waves import redrawn

_NEARLY = 0.1
"""Share of what rows share beyond chance that may be left for a sinusoid to explain nearly all of it."""
_PLAIN = 10.0
"""Nats by which one sinusoid of the same amplitude everywhere must fall short before it is given up."""


class _Wave(NamedTuple):
    """Frequency, cycles per row; lamp: of a wave far above the noise."""

    frequency: float
    lamp: Lamp | None


def _wave_power(score: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Half the chi-square of both phases of each field at every frequency k / 4h, their correlation accounted
    for."""
    h = information.size
    u = fft.rfft(score, 4 * h, axis=1)
    double = fft.fft(information, 4 * h)[(2 * np.arange(2 * h + 1)) % (4 * h)]
    total = information.sum()
    aa, bb, ab = (total + double.real) / 2, (total - double.real) / 2, double.imag / 2
    determinant = np.maximum(aa * bb - ab**2, 1e-3 * total**2)
    chi2 = (bb * u.real**2 + aa * u.imag**2 - 2 * ab * u.real * u.imag) / determinant
    return chi2 / 2


def flicker_score(fields: tuple[Fields, ...]) -> Score[_Wave] | None:
    """A sinusoid from row to row proportional to the signal, of one frequency in all lit recordings, counted
    by their information."""
    powers, information, seen = [], [], []
    for f in fields:
        if not f.lit or not len(f.contrasts):
            continue
        values = redrawn(f)
        sums = line_sums(f, values, "row", "signal")
        if sums.information.size > 1 and sums.information.sum() > 0:
            seen.append((f, values, sums))
            powers.append(_wave_power(sums.score, sums.information))
            information.append(np.full(len(values), sums.information.sum()))
    if not powers:
        return None
    own, weights = np.concatenate(powers), np.concatenate(information)
    power = np.einsum("nk,n->k", own, weights / weights.sum())
    # Less than one period in the frame: its two phases are not independent. Two rows to a period, or nearly:
    # that is what rows of one colour share when the light changes colour from frame to frame.
    power[:4] = power[-4:] = 0
    k, h = int(np.argmax(power)), fields[0].mean.shape[0]
    trials = 2 * h  # every point of the padded grid
    fit = rician_fit(float(power[k]), own[:, k], weights)
    frequency, doubt = k / (4 * h), 0.3 / h
    gain, amplitude, error, lamp = fit.gain, fit.amplitude, fit.error, None
    remains = _with_remainder(seen, frequency)
    if remains is not None and remains > gain + _PLAIN:
        lamp = lamp_wave([field for field, _, _ in seen], frequency)
        gain = max(remains, _with_remainder(seen, lamp.frequency) or 0.0)
        amplitude, frequency = lamp.amplitude, lamp.frequency
        error = amplitude / (2 * np.sqrt(lamp.frames))
    return Score(
        log_p=sidak(fit.log_p, trials),
        gain=gain,
        penalty=float(np.log(trials)),
        amplitude=amplitude,
        error=error,
        shift=fit.shift,
        power=2,
        parameters={"amplitude": (amplitude, "1", error), "frequency": (frequency, "1/row", doubt)},
        where={"axis": "frequency", "period_px": 1 / frequency if k else None, "direction": "row"},
        payload=_Wave(frequency, lamp),
        spot={"frequency": (frequency, 2.5 * doubt)},
    )


def _basis(frequency: float, h: int, harmonics: int) -> Float[np.ndarray, "k h"]:
    """Both phases of the sinusoid and of its harmonics along the rows, and of their neighbours half a
    frequency of the frame away."""
    rows = np.arange(h)
    turns = [(m * frequency + d / h) * rows for m in range(1, harmonics + 1) for d in (-0.5, 0.0, 0.5)]
    return np.array([g(2 * np.pi * t) for t in turns for g in (np.cos, np.sin)])


def _with_remainder(seen: list[tuple[Fields, np.ndarray, LineSums]], frequency: float) -> float | None:
    """Nats that a sinusoid far above the noise gains with its harmonic, both of each colour's own strength,
    and a white remainder, where it explains nearly all of the rows; None for any others.

    Sums scaled to the noise of their own pixels bend a sinusoid that is far above it: both laws are compared
    on those that are not, and the difference is put on what white rows gain on those that are.
    """
    whole, rest, saved, left_over = [], [], 0.0, 0.0
    for field, values, _ in seen:
        sums = line_sums(field, values, "row", "signal", own=False)
        information, h = np.maximum(sums.information, 1e-30), sums.information.size
        white = sums.score / np.sqrt(information)
        even = _basis(frequency, h, 2)
        basis = np.concatenate([even, even * np.where(np.arange(h) % 2, -1.0, 1.0)])
        kept, _ = np.linalg.qr((basis * np.sqrt(information)).T)
        if 2 * kept.shape[1] > h:
            return None
        left = white - np.einsum("nh,hk,mk->nm", white, kept, kept)
        saved += 0.5 * float(np.sum(white**2) - np.sum(left**2))
        saved -= 0.5 * len(white) * kept.shape[1] * float(np.log(white.size))  # its free parameters
        left_over += (float(np.sum(left**2)) / (1 - kept.shape[1] / h)) - white.size
        whole.append((white, information))
        rest.append((left, information))
    excess = sum(float(np.sum(w**2)) - w.size for w, _ in whole)
    if left_over > _NEARLY * excess:
        return None
    own = [(s.score / np.sqrt(np.maximum(s.information, 1e-30)), s.information) for _, _, s in seen]
    return _white(own) + saved + _white(rest) - _white(whole)


def _white(rows: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Nats that white offsets of the rows gain, of standardised sums [n, h] and their information [h]."""
    power = np.concatenate([np.sum(x**2, 0) for x, _ in rows])
    freedom = np.concatenate([np.full(i.shape, float(len(x))) for x, i in rows])
    return variance_component(power, np.concatenate([i for _, i in rows]), freedom).gain


def flicker_absorb(fields: tuple[Fields, ...], score: Score[_Wave]) -> tuple[Fields, ...]:
    """Projects the row sinusoid, times the signal, out of every lit field; with its harmonic, and out of each
    colour by itself, where it is far above the noise. What rows of light then still share is no noise of
    the camera: lamps flicker in no perfect sinusoid."""
    frequency, strong = score.payload.frequency, score.payload.lamp is not None

    def taken_out(field: Fields) -> Fields:
        left = _with_level(field, _taken_out(field, frequency, strong), frequency, score.amplitude)
        return _even_rows(left) if strong and len(left.contrasts) else left

    return tuple(taken_out(f) if f.lit else f for f in fields)


def _even_rows(field: Fields) -> Fields:
    """The field with the power of its row sums brought down to that of white noise at every frequency where
    it is more, even and odd columns by themselves; the static part loses as much as the mean of so many
    frames keeps of it. The level of a frame stays. White noise is that of the pixels within the rows: a field
    that is standardised with its flicker has far less of it than 1."""
    values = field.contrasts.copy()
    static = None if field.static is None else field.static[None].copy()
    for parity in (0, 1):
        columns = (slice(None), slice(parity, None, 2))
        r = response(field, "signal")[columns].astype(np.float32)
        rows = _row_modes(values[:, *columns], r)
        white = max(np.mean(values[:, *columns] ** 2, dtype=float) - np.mean(rows.power) / r.shape[1], 1e-30)
        values[:, *columns] = _scaled_rows(values[:, *columns], r, rows, np.full(rows.power.shape, white))
        if static is not None:
            kept = _row_modes(static[:, *columns], r)
            wanted = np.maximum(kept.power - rows.power, 0) + white
            static[:, *columns] = _scaled_rows(static[:, *columns], r, kept, wanted)
    return field._replace(contrasts=values, static=None if static is None else static[0])


class _Rows(NamedTuple):
    """Weighted sums of the rows over frequency, and their power smoothed over five frequencies."""

    modes: np.ndarray
    power: np.ndarray


def _row_modes(values: Float[np.ndarray, "n h w"], r: Float[np.ndarray, "h w"]) -> _Rows:
    rows = np.einsum("nij,ij->ni", values, r) / np.sqrt(_information(r))
    modes = fft.rfft(rows, axis=1)
    power = np.mean(np.abs(modes) ** 2, 0) / rows.shape[1]
    power[0] = power[1]  # drift of the light as a whole is none of the rows'
    return _Rows(modes, ndimage.uniform_filter1d(power, 5, mode="nearest"))


def _scaled_rows(
    values: Float[np.ndarray, "n h w"], r: Float[np.ndarray, "h w"], rows: _Rows, wanted: np.ndarray
) -> Float[np.ndarray, "n h w"]:
    """The values with the power of their row sums brought down to what is wanted, where it is more."""
    kept = np.sqrt(np.minimum(wanted / np.maximum(rows.power, 1e-30), 1.0))
    kept[0] = 1.0
    removed = fft.irfft(rows.modes * (1 - kept), r.shape[0], axis=1)
    return values - (removed / np.sqrt(_information(r)))[:, :, None].astype(np.float32) * r


def _information(r: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h"]:
    return np.maximum(np.sum(r.astype(np.float64) ** 2, 1), 1e-30)


def _with_level(field: Fields, left: Fields, frequency: float, amplitude: float) -> Fields:
    """`left` with the level of every frame as it is told beside a sinusoid of this amplitude in the frame:
    one of a few periods to the frame would take the drift of the light along, and gives it a level of its
    own. What its phase leaves open of that is noise of the level, which is brought back to one."""
    r = response(field, "signal").astype(np.float64)
    lines = np.sum(r**2, 1)
    total = max(float(lines.sum()), 1e-30)
    turn = 2 * np.pi * frequency * np.arange(lines.size)
    terms = np.stack([np.ones(lines.size), np.cos(turn), np.sin(turn)])
    expected = 2 / max(amplitude, 1e-30) ** 2  # of either phase: one over its variance
    normal = np.einsum("ki,i,li->kl", terms, lines, terms) + np.diag([0.0, expected, expected])
    told = np.linalg.pinv(normal)[0]
    kept = 1 / np.sqrt(max(told[0] * total, 1.0))
    unit = r.astype(np.float32)

    def function(before: np.ndarray, after: np.ndarray) -> np.ndarray:
        was = np.einsum("k,ki,ni->n", told, terms, np.einsum("nij,ij->ni", before, unit))
        now = np.einsum("nij,ij->n", after, unit) / np.float32(total)
        return after + (kept * was - now).astype(np.float32)[:, None, None] * unit

    static = None
    if field.static is not None and left.static is not None:
        static = function(field.static[None], left.static[None])[0]
    contrasts = function(field.contrasts, left.contrasts)
    return left._replace(contrasts=contrasts, static=static, level=field.level * float(kept))


def _taken_out(field: Fields, frequency: float, strong: bool) -> Fields:
    r = response(field, "signal")
    basis = _basis(frequency, field.mean.shape[0], 2 if strong else 1)
    if not strong:
        return without(field, np.array([(b[:, None] * r).ravel() for b in basis]))

    def function(values: np.ndarray) -> np.ndarray:
        out = values.copy()
        for at in SITES:
            q = orthonormal(np.array([(b[at[0], None] * r[at]).ravel() for b in basis]))
            out[:, *at] = projected_out(values[:, *at], q)
        return out

    return map_contrasts(field, function)


def mains(
    *,
    name: str,
    parameter: str,
    point: Point,
    of_sites: Callable[[Float[np.ndarray, "4"], Float[np.ndarray, "4"]], dict[str, float]],
) -> Signature:
    """A sinusoid of the light from row to row, its phase new in every frame, at this place in the grammar.
    parameter: the mechanism's strength. of_sites(share, late) -> its parameters for the wave of each site."""

    def frequency(found: Found) -> dict[str, float]:
        return {"frequency": abs(found.score.parameters["frequency"][0])}

    def beside(found: Found) -> dict[str, float]:
        """Each colour's own wave too, where it is told."""
        lamp = found.score.payload.lamp
        return frequency(found) if lamp is None else {**frequency(found), **of_sites(lamp.share, lamp.late)}

    return Signature(
        name=name,
        axes=Axes("photons", "row", "redrawn", "signal", "sinusoid"),
        reads=CONTRASTS | STATIC | {"signal"},
        score=flicker_score,
        absorb=flicker_absorb,
        covers=COVERS_NOTHING,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=strength(parameter, beside=beside),
        place=placed(point, beside=frequency),
        detectable=BY_SHIFT,
        least=lambda sets: sinusoid(sets, signal),
    )
