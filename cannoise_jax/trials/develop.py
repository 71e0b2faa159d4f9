"""Fixed development sets: ten and sixty for slow runs of the tests; their seeds are public."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cannoise_jax.blind import claims
from cannoise_jax.blind.score import score
from cannoise_jax.blind.seal import seal
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.trials.analysis import diagnosed, located

SETS = {"fast": (2001, 7, 3), "slow": (2002, 48, 12)}
"""Seed, sets to diagnose, further effect-free sets that are only located."""
HIGHER_IS_BETTER = {
    "named": True,
    "seen": True,
    "both_of_two": True,
    "unknown_flagged": True,
    "false_alarms": False,
    "beside_the_truth": False,
    "unknown_misnamed": False,
    "adversarial_alarms": False,
    "errors": False,
}


def develop(name: str, folder: Path, tell: Callable[[int, int], None]) -> dict[str, int]:
    """Seals, diagnoses and scores the development sets; the figures are counts of sets (of names for two).

    Goes on with what `folder` holds already.
    """
    seed, sets, nulls = SETS[name]
    truth = folder / "truth.json"
    if not truth.exists():
        seal(folder / "sets", truth, seed, sets, nulls, lambda done, total: None)

    def analyse(capture: CaptureSet, without: tuple[str, ...], locate_only: bool) -> dict[str, Any]:
        if locate_only:
            return located(capture, without)
        return diagnosed(capture, without, "", compare=False)

    claims.run(folder / "sets", folder / "claims", analyse, (1, 1), tell)
    manifest = claims.read_manifest(folder / "sets")
    said = claims.read_claims(folder / "claims", manifest)
    result = score(claims.read_truth(truth, manifest), said)
    return {
        "named": result["naming"]["top1"]["hits"],
        "seen": result["ablation"]["whole_tool"]["detected"]["hits"],
        "both_of_two": result["double"]["recall"]["hits"],
        "unknown_flagged": result["unknown"]["flagged"]["hits"],
        "false_alarms": result["false_alarms"]["hits"],
        "beside_the_truth": result["naming"]["finding_outside_group"]["hits"],
        "unknown_misnamed": result["unknown"]["misnamed"]["hits"],
        "adversarial_alarms": result["adversarial"]["sensor_false_alarms"]["hits"],
        "errors": result["errors"],
    }


def worse(found: dict[str, int], recorded: dict[str, int]) -> list[str]:
    """Figures that fell behind the recorded ones, in words."""
    return [
        f"{name}: {found[name]}, recorded {recorded[name]}"
        for name, higher in HIGHER_IS_BETTER.items()
        if (found[name] < recorded[name]) == higher and found[name] != recorded[name]
    ]
