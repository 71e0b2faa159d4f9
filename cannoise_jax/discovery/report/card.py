"""The card of a structure without a name: where it lives in the grammar, and what it measures like.

Everything is taken from the fields in which it was found, those before it was taken out: its strength by
level of signal, by exposure and by gain, with the power of each that fits best; its share that stays put and
that is new in every frame; the spectrum of line means, the correlation of neighbours and the tails of what
was found in; and the named mechanism that comes nearest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from cannoise_jax.discovery.compare.words import digits, short
from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.discovery.search.name import Doubt
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.likelihood.whittle import whittle
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.lag_sums import LAGS, lag_sums
from cannoise_jax.signatures.line_sums import line_power
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import Signature

_POWERS = (0.0, 0.5, 1.0, 2.0)
"""Of the signal, tried for an amplitude: no growth, as shot noise, in proportion, and as its square."""
_RIVALS = 6
"""Signatures that are asked anew for the nearest mechanism: those with most evidence when it was found."""
_NEAR = 2
"""Lags up to which the correlations of neighbours are listed."""


def card(
    step: Step, signatures: tuple[Signature, ...], ids: frozenset[str], others: tuple[Step, ...] = ()
) -> dict[str, Any]:
    """What is known of a structure that no registered mechanism explains.

    axes: where it enters, what it varies over, its behaviour in time, its scaling (additive, signal or
    exposure) and its law. dependence: on signal, exposure and gain, each a list of x, amplitude, error, and
    the power of x that fits best (None: fewer than two points). static_share: of its variance. row_spectrum,
    column_spectrum: exponent of 1/f^a and the frequency of the largest power, cycles per pixel. covariance:
    correlation with the pixel (dy, dx) away. excess_kurtosis: of single pixels. nearest: of the mechanisms
    `ids` that may be named, and that are not among the `others` found, the one with the next best evidence,
    and by how many nats it is worse.
    """
    signature, score, fields = step.named.signature, step.named.score, step.before
    additive = _kin(signature, signatures, time=signature.axes.time, scales="additive") or signature
    nearest, why = (
        _nearest_beside(step, signatures, ids, others)
        if step.named.doubt is None
        else (step.named.doubt.nearest, said_against(step.named.doubt))
    )
    return {
        "axes": dataclasses.asdict(signature.axes),
        "signature": signature.name,
        "static_or_temporal": signature.axes.time,
        "static_share": static_share(fields, signature, score, signatures),
        "dependence": {
            "signal": dependence(additive, fields, _level),
            "exposure": dependence(
                additive, tuple(f for f in fields if not f.lit), lambda f: f.exposure_s or 0.0
            ),
            "gain": dependence(additive, fields, lambda f: round(float(np.mean(f.gain)), 6)),
        },
        "row_spectrum": line_spectrum(fields, "row", signature),
        "column_spectrum": line_spectrum(fields, "column", signature),
        "covariance": neighbours(fields),
        "excess_kurtosis": excess_kurtosis(fields),
        "gain_nats": score.gain,
        "nearest": nearest,
        "why_rejected": why,
    }


def said_against(doubt: Doubt) -> str:
    """Why the nearest name is not given."""
    if doubt.instead:
        return ", ".join(doubt.against)
    left = "more than there was without it" if doubt.left > 1 else f"{100 * doubt.left:.0f} %"
    what = f": {', '.join(doubt.against)}" if doubt.against else ""
    return f"a simulator with it leaves {left} of the mismatch on which it bears{what}"


def _level(field: Fields) -> float:
    """Mean signal of a recording, DN, 0 for darks."""
    return round(float(np.mean(field.signal)), 1) if field.lit else 0.0


def dependence(
    signature: Signature, fields: tuple[Fields, ...], of: Callable[[Fields], float]
) -> dict[str, Any] | None:
    """Amplitude of a signature in the recordings of each value x of a setting, and the power of x that it
    follows best; None where there are fewer than two values at which the signature applies."""
    points, settings = [], sorted({of(f) for f in fields})
    if len(settings) < 2:
        return None
    parts = each(lambda x: signature.score(tuple(f for f in fields if of(f) == x)), settings)
    for x, part in zip(settings, parts, strict=True):
        if part is not None and np.isfinite(part.error) and part.error > 0:
            points.append((float(x), abs(float(part.amplitude)), float(part.error)))
    if len(points) < 2:
        return None
    x, a, e = np.array(points).T
    scaled = np.maximum(x, 0) / max(x.max(), 1e-30)
    misfit = []
    for power in _POWERS:
        shape = scaled**power
        best = np.sum(shape * a / e**2) / max(np.sum(shape**2 / e**2), 1e-30)
        misfit.append(float(np.sum(((a - best * shape) / e) ** 2)))
    return {
        "points": [{"x": p, "amplitude": q, "error": r} for p, q, r in points],
        "power": _POWERS[int(np.argmin(misfit))],
    }


def static_share(
    fields: tuple[Fields, ...], signature: Signature, score: Score, signatures: tuple[Signature, ...]
) -> float | None:
    """Share of the structure's variance that stays from frame to frame; None where its twin in time was not
    looked for."""
    other = {"redrawn": "frozen", "frozen": "redrawn"}.get(signature.axes.time, "")
    twin = _kin(signature, signatures, time=other, scales=signature.axes.scales)
    told = twin.score(fields) if twin is not None else None
    if told is None:
        return None
    a, b = score.amplitude**2, told.amplitude**2
    return float((a if signature.frozen else b) / max(a + b, 1e-30))


def _kin(signature: Signature, signatures: tuple[Signature, ...], *, time: str, scales: str):
    """The signature of the same thing with this behaviour in time and scaling; None where there is none."""
    alike = (p for p in signatures if p.kin and p.kin == signature.kin)
    return next((p for p in alike if (p.axes.time, p.axes.scales) == (time, scales)), None)


def line_spectrum(fields: tuple[Fields, ...], axis: str, signature: Signature) -> dict[str, float] | None:
    """Spectrum of the means of rows or columns, of what stays or of what is new in every frame: the exponent
    a of 1/f^a by its Whittle likelihood, and the frequency of the largest power."""
    frozen = signature.frozen
    size = fields[0].mean.shape[0 if axis == "row" else 1]
    power, number = np.zeros(size // 2 + 1), 0
    for f in fields:
        values = f.static[None] if frozen and f.static is not None else f.contrasts
        if (frozen and f.static is None) or not len(values) or f.mean.shape != fields[0].mean.shape:
            continue
        power = power + line_power(f, values, axis)
        number += len(values)
    if not number:
        return None
    power = power[1:] / number
    frequency = np.arange(1, power.size + 1) / size
    slopes = np.linspace(-0.5, 2.5, 61)
    fits = []
    for a in slopes:
        shape = frequency**-a
        fits.append(whittle(power, np.ones(power.size), np.mean(power / shape) * shape))
    top = int(np.argmax(power))
    return {
        "exponent": float(slopes[int(np.argmax(fits))]),
        "peak_frequency": float(frequency[top]),
        "peak_power": float(power[top]),
    }


def neighbours(fields: tuple[Fields, ...]) -> list[dict[str, float]]:
    """Correlation of pixels with those (dy, dx) away, rows and columns as a whole taken out."""
    score, information = lag_sums(fields, "white")
    return [
        {"dy": dy, "dx": dx, "correlation": float(u / i), "error": float(i**-0.5)}
        for (dy, dx), u, i in zip(LAGS, score, information, strict=True)
        if i > 0 and max(abs(dy), abs(dx)) <= _NEAR
    ]


def excess_kurtosis(fields: tuple[Fields, ...]) -> dict[str, float] | None:
    """Of the standardised contrasts of all recordings: 0 for Gaussian noise."""
    number, second, fourth = 0, 0.0, 0.0
    for f in fields:
        for contrast in f.contrasts:
            square = contrast[f.usable].astype(np.float64) ** 2
            number, second, fourth = number + square.size, second + square.sum(), fourth + (square**2).sum()
    if not number:
        return None
    return {"value": number * fourth / second**2 - 3.0, "error": float(np.sqrt(24 / number))}


def lines(card: dict[str, Any]) -> list[tuple[str, str]]:
    """The card in words: label and text of each line that has something to say."""
    axes = card["axes"]
    out = [
        ("Place in the grammar", ", ".join(f"{k.replace('_', ' ')}: {v}" for k, v in axes.items())),
        ("Signature", card["signature"].replace("_", " ")),
    ]
    if card["static_share"] is not None:
        out.append(("Stays from frame to frame", f"{100 * card['static_share']:.0f} % of its variance"))
    for setting, told in card["dependence"].items():
        if told is not None:
            points = "; ".join(
                f"{short(p['amplitude'])} ± {digits(p['error'], 2)} at {digits(p['x'], 4)}"
                for p in told["points"]
            )
            out.append((f"By {setting}", f"{points}; follows power {told['power']:g} of it best"))
    for axis in ("row", "column"):
        told = card[f"{axis}_spectrum"]
        if told is not None:
            out.append(
                (
                    f"Means of {axis}s",
                    f"1/f to the {told['exponent']:.2g}; most power, {short(told['peak_power'])}, at "
                    f"{told['peak_frequency']:.3g} cycles per pixel",
                )
            )
    far = [c for c in card["covariance"] if abs(c["correlation"]) > 4 * c["error"]]
    told = "; ".join(f"{c['correlation']:+.2g} ± {c['error']:.1g} at ({c['dy']}, {c['dx']})" for c in far)
    out.append(("Correlation with neighbours", told or "none beyond four standard errors"))
    if card["excess_kurtosis"] is not None:
        k = card["excess_kurtosis"]
        out.append(("Excess kurtosis of pixels", f"{short(k['value'])} ± {digits(k['error'], 2)}"))
    name = card["nearest"].replace("_", " ") if card["nearest"] else "none"
    out.append(("Nearest named mechanism", f"{name}: {card['why_rejected']}"))
    return out


def _nearest_beside(
    step: Step, signatures: tuple[Signature, ...], ids: frozenset[str], others: tuple[Step, ...]
) -> tuple[str | None, str]:
    """The mechanism with most evidence in the same fields, of those that may be named and are not found
    beside it, and why it is not the one."""
    told = {n for o in others if o is not step for n in (o.named.signature.name, *o.named.signature.covers)}
    own = step.named.signature.name
    # What stays explains nothing that is new in every frame, whatever it has in the same fields.
    asked = [
        p
        for p in signatures
        if p.mechanism in ids
        and p.name not in told
        and p.name != own
        and p.frozen == step.named.signature.frozen
    ]
    if step.rivals:  # to ask all of them anew took a tenth of a diagnosis
        seen = [p for p in asked if p.name in step.rivals]
        asked = sorted(seen, key=lambda p: -step.rivals[p.name])[:_RIVALS]
    best, name = 0.0, None
    for signature, score in zip(asked, each(lambda s: s.score(step.before), asked), strict=True):
        if score is not None and score.evidence > best:
            best, name = score.evidence, signature.mechanism
    gap = step.named.score.evidence - best
    if name is None:
        return None, "no named mechanism of this run answers to it at all"
    if gap >= 0:
        return name, f"it explains {gap:.1f} nats less of the same frames"
    return name, f"it explains {-gap:.1f} nats more of the same frames, but the search did not keep it"
