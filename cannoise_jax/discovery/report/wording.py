"""The sentence that says a finding to a camera engineer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from cannoise_jax.discovery.compare.words import ends, is_wide, short
from cannoise_jax.discovery.proof.prove import Proof
from cannoise_jax.discovery.report.card import said_against
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.core.places import place
from cannoise_jax.signatures.fields import longest_exposure
from cannoise_jax.signatures.signature import Axes
from cannoise_jax.vocabulary import Term

CERTAIN = 10.0
"""Nats a pixel from which on more of them say nothing more: e^-10 a pixel is never met."""
_TIME = {
    "frozen": "the same in every frame",
    "redrawn": "new in every frame",
    "modulated": "one pattern whose strength is new in every frame",
}
_SCALES = {
    "additive": "whatever the signal",
    "codes": "the same number of codes at every gain",
    "signal": "in proportion to the signal",
    "signal squared": "as the square of the signal",
    "exposure": "in proportion to the exposure",
    "all noise": "in proportion to all noise",
    "scene": "with the scene",
    "none": "",
}


def amount(values: float | Sequence[float], unit: str | None, meaning: str = "") -> str:
    """A strength, or an interval of it, with its unit; fractions in percent. meaning: of the number."""
    each = values if isinstance(values, Sequence) else (values,)
    plain = unit in (None, "1")
    percent = plain and ("fraction" in meaning or "relative" in meaning)
    shown = [100 * v if percent else v for v in each]
    said = " to ".join(ends(*shown) if len(shown) == 2 else map(short, shown))
    return f"{said} %" if percent else said if plain else f"{said} {unit}"


_SHARES = ("white", "sparse", "contrast", "one pattern", "sinusoid", "exponential fall")
"""Laws of what is added to the light as shares of it."""
_OF_SIGNAL = "fraction of the signal"


def meaning_of(unnamed: bool, scales: str, law: str, unit: str | None, term: Term | None) -> str:
    """What the strength of a finding is a measure of. scales, law: of what has no name; term: of what has."""
    if not unnamed:
        return "" if term is None else term.amplitude
    share = unit in (None, "1") and scales == "signal" and law in _SHARES
    return _OF_SIGNAL if share else ""


def meaning_in(finding: Mapping[str, Any], term: Term | None) -> str:
    """`meaning_of` a finding of a report."""
    axes = (finding.get("card") or {}).get("axes") or {}
    unnamed, unit = finding["mechanism"] == UNKNOWN, finding["amplitude"]["unit"]
    return meaning_of(unnamed, axes.get("scales", ""), axes.get("law", ""), unit, term)


def nats(gain: float, pixels: int) -> str:
    """A gain on frames held back in words."""
    if pixels and gain > CERTAIN * pixels:
        return f"more than {CERTAIN:g} nats a pixel"
    return f"{short(gain) if abs(gain) >= 1 else f'{gain:.1g}'} nats"


def between(low: float, high: float) -> str:
    """The interval of a gain in words."""
    return f"90 %: {short(low)} to {short(high)} nats"


def sentence(entry: dict[str, Any], step: Step, proof: Proof, term: Term) -> str:
    """What a camera engineer reads first. term: of the mechanism."""
    name = entry["mechanism"].replace("_", " ")
    unit, (low, high) = entry["amplitude"]["unit"], entry["amplitude"]["ci90"]
    unnamed = entry["outcome"] == "UNKNOWN_STRUCTURE"
    axes = step.named.signature.axes
    meaning = meaning_of(unnamed, axes.scales, axes.law, unit, term)
    size = _sized(entry["amplitude"]["value"], unit, meaning)
    size += _at_exposure(step) if unit == "DN" else ""
    after = ""
    if unnamed:
        in_words = step.named.signature.kind
        kind = in_words(step.named.score) if in_words else axes.law
        start = f"A structure without a name, {placed(axes)} (of the kind: {kind}): strength {size}"
        if step.named.doubt is not None:
            near = step.named.doubt.nearest.replace("_", " ")
            after = f"; nearest to {near}, but {said_against(step.named.doubt)}"
    elif entry["outcome"] == "AMBIGUOUS":
        others = [
            c["mechanism"].replace("_", " ")
            for c in entry["candidates"]
            if c["mechanism"] != UNKNOWN and c["probability"] > 0.01
        ]
        if len(others) > 1:
            together = f"{', '.join(others[:-1])} and {others[-1]}"
            start = f"These recordings cannot tell {together} apart; as {name}: {size}"
        else:  # what is against it is no other name
            start = f"Nothing known fits better than {name}: {size}"
    elif step.named.signature.says:
        start, (low, high) = step.named.signature.says(entry)
        unit, meaning = None, ""
    else:
        told = term.says_exposure or step.named.signature.axes.scales != "exposure"
        grows = "" if told else " (growing with the exposure)"
        start = f"{term.definition.removesuffix('.')}{grows}: {size}"
    count = entry.get("where", {}).get("rows_together")
    start += f", shared by {count} rows that are read together" if count else ""
    moved = entry.get("parameters", {}).get("frame_offset")
    slow = f", and slower than a frame, whose mean moves by {short(moved['value'])} DN" if moved else ""
    within = f" (90 %: {amount((low, high), unit, meaning)})" if is_wide(low, high) else ""
    wide = entry.get("parameters", {}).get("sigma_of_all")
    if wide:
        within += f", {_sized(wide['value'], wide['unit'], meaning)} with the pixels that are far out of it"
    return f"{start}{within}{after}{slow}{_proven(step, proof)}"


def _at_exposure(step: Step) -> str:
    """The exposure at which the strength of what grows with it holds; nothing where that is not stated, or
    may be that of the darks or of all recordings."""
    if step.named.signature.axes.scales != "exposure":
        return ""
    darks = [f for f in step.before if not f.lit]
    longest = longest_exposure(darks)
    stated = all(f.exposure_s is not None for f in darks) and longest == longest_exposure(step.before)
    return f" at {short(longest)} s" if stated and longest else ""


def _sized(value: float, unit: str | None, meaning: str) -> str:
    """A strength, with what it measures where the unit does not say that."""
    if unit in (None, "1"):
        if meaning == _OF_SIGNAL:
            return f"{amount(value, unit, meaning)} of the signal"
        what = meaning.partition(":")[0].replace("fraction of", "share of")
        return f"{what} {amount(value, unit, meaning)}".strip()
    kind = meaning.partition(",")[0]
    return amount(value, unit) + (f" {kind}" if kind in ("rms", "peak") else "")


def placed(axes: Axes) -> str:
    """The place of a structure in the grammar in words."""
    parts = (
        place(axes.varies_over).over,
        _TIME.get(axes.time, axes.time),
        _SCALES[axes.scales],
    )
    return ", ".join(p for p in parts if p)


def _proven(step: Step, proof: Proof) -> str:
    whose = "new frames of this camera" if step.named.signature.frozen else "frames not used to find it"
    if step.late:
        return "; not confirmed: only all frames together show it, and none is left to confirm it on."
    if proof.gain is None:
        return "; not confirmed: too few frames are held back."
    gains = f"; on {whose} the fit gains {nats(proof.gain, proof.pixels)}"
    if proof.confirmed:
        few = proof.basis == "likelihood" and math.isfinite(proof.low) and proof.low <= 0
        return f"{gains}, most of it in few places; what the others gain confirms it." if few else f"{gains}."
    if proof.gain <= 0:
        return f"; not confirmed on {whose}."
    if math.isfinite(proof.low):
        return f"{gains}, {between(proof.low, proof.high)}: not confirmed, these frames differ too much."
    return f"{gains}, from too few frames to confirm it."
