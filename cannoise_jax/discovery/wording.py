"""The sentence that says a finding to a camera engineer."""

from __future__ import annotations

import math
from typing import Any

from cannoise_jax.discovery.card import said_against
from cannoise_jax.discovery.fit import Step
from cannoise_jax.discovery.prove import Proof


def sentence(entry: dict[str, Any], step: Step, proof: Proof, definition: str) -> str:
    """What a camera engineer reads first. definition: of the mechanism, one sentence."""
    name = entry["mechanism"].replace("_", " ")
    amount = f"{entry['amplitude']['value']:.3g} {entry['amplitude']['unit']}".replace(" 1", "")
    low, high = entry["amplitude"]["ci90"]
    if entry["outcome"] == "UNKNOWN_STRUCTURE":
        axes = step.named.signature.axes
        start = (
            f"A structure without a name: it varies over {axes.varies_over}, is {axes.time} in time, "
            f"scales as {axes.scales}, law {axes.law}; strength {amount}"
        )
        if step.named.doubt is not None:
            near = step.named.doubt.nearest.replace("_", " ")
            start += f"; nearest to {near}, but {said_against(step.named.doubt)}"
    elif entry["outcome"] == "AMBIGUOUS":
        others = " or ".join(
            c["mechanism"].replace("_", " ")
            for c in entry["candidates"]
            if c["mechanism"] != "unknown" and c["probability"] > 0.01
        )
        start = f"These recordings cannot separate {others}; as {name} it is {amount}"
    else:
        told = "exposure" in definition or step.named.signature.axes.scales != "exposure"
        grows = "" if told else " (growing with the exposure)"
        start = f"{definition.removesuffix('.')}{grows}: {amount}"
        if step.named.signature.says:
            start, (low, high) = step.named.signature.says(entry)
    moved = entry.get("parameters", {}).get("frame_offset")
    slow = f", and slower than a frame, whose mean moves by {moved['value']:.3g} DN" if moved else ""
    frozen = step.named.signature.frozen
    whose = "new frames of this camera" if frozen else "frames that took no part in finding it"
    if step.late:
        proven = "; not confirmed: only all frames together show it, and none is left to confirm it on."
    elif proof.gain is None:
        proven = "; not confirmed: too few frames to set some aside."
    elif proof.confirmed:
        proven = f"; on {whose} the fit gains {proof.gain:.0f} nats."
    elif math.isfinite(proof.low) or proof.gain <= 0:
        proven = f"; not confirmed on {whose}."
    else:
        proven = f"; on {whose} the fit gains {proof.gain:.0f} nats, from too few frames to confirm it."
    return f"{start} (90 %: {low:.3g} to {high:.3g}){slow}{proven}"
