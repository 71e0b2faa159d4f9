"""The part of bin/blind that conceals on real recordings: inject, withhold, permute; see `blind/real.py`."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cannoise_jax.blind import curves, real
from cannoise_jax.blind.effects import effect
from cannoise_jax.blind.judge import count
from cannoise_jax.blind.seal import write_atomically
from cannoise_jax.blind.strength import strength
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.battery import Prepared, prepare
from cannoise_jax.discovery.proof.gains import held_out_gain
from cannoise_jax.discovery.report.document import document, plain
from cannoise_jax.discovery.search.locate import locate
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.score import p_of
from cannoise_jax.signatures.signature import Signature

MULTIPLES = (4.0, 16.0)
"""Strengths of what is injected; the second has twice the amplitude where the shift grows as its square."""
WITHHELD = 3
"""How many of the properties that a camera shows are withheld, the strongest first."""
LONGEST_S = 10.0
"""Longer exposures are left out: hot pixels fill them, and they cost as much as all others together."""
SHARED = ("white", "1/f", "sinusoid", "neighbours")
SCALES = ("additive", "signal", "all noise")
"""Laws and scalings of what rows, columns, frames or neighbours share in time."""
Tell = Callable[[int, int], None]


def real_trial(
    recordings: Path, out: Path, parts: tuple[str, ...], size: tuple[int, int], permutations: int,
    alpha: float, progress: Callable[[str], Tell],
) -> dict[str, Any]:  # fmt: skip
    """Runs the parts that `out` does not hold yet, and returns all results."""
    capture = real.crop(load_capture_set(recordings), size, LONGEST_S)
    path = out / "real.json"
    result: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    result |= {"camera": capture.camera, "size": list(size), "alpha": alpha}
    for part in parts:
        if part in result:
            continue
        started = time.monotonic()
        tell = progress(part)
        if part == "inject":
            result[part] = inject(capture, alpha, tell)
        elif part == "withhold":
            result[part] = withhold(capture, alpha, tell)
        else:
            result[part] = permute(capture, permutations, alpha, tell, out / "permutations.json")
        result[part]["seconds"] = time.monotonic() - started
        write_atomically(path, json.dumps(plain(result), indent=1, allow_nan=False) + "\n")
    return result


def whole(capture: CaptureSet) -> Prepared:
    """All frames, ready for the statistics."""
    return prepare(capture, [list(range(r.count)) for r in capture.recordings], False)


def amplitudes(capture: CaptureSet, alpha: float) -> dict[str, float]:
    """Mechanisms that a diagnosis reports, with their amplitudes."""
    report = document(diagnose(capture, alpha=alpha, compare=False), key=0, version="")
    return {f["mechanism"]: f["amplitude"]["value"] for f in reversed(report["findings"])}


def inject(capture: CaptureSet, alpha: float, tell: Tell) -> dict[str, Any]:
    """Known effects on top of the real noise: found, and by how much more than without them?"""
    prepared = whole(capture)
    baseline = prepared.baselines[0]
    gain = float(np.mean(baseline.gain)) if np.all(np.isfinite(baseline.gain)) else 1.0
    camera = real.described(capture, gain or 1.0, float(np.mean(baseline.read_noise)), prepared.step, unit=1)
    before = amplitudes(capture, alpha)
    names = [n for n in real.INJECTED if capture.of_kind("scene", "flat") or n not in real.LIT]
    rows: list[dict[str, Any]] = []
    asked = [(name, multiple) for name in names for multiple in MULTIPLES]
    for n, (name, multiple) in enumerate(asked):
        tell(n, len(asked))
        law = strength(name, camera, real.exposed(capture, camera))
        amplitude = law.amplitude_at(multiple) if law else math.inf
        if not math.isfinite(amplitude):
            continue
        rng = np.random.default_rng([1, n])
        after = amplitudes(real.injected(capture, camera, effect(name, amplitude), rng), alpha)
        power = 1 if name in real.STEPS else 2
        old, new = before.get(name, 0.0), after.get(name, 0.0)
        gained = math.copysign(abs(new**power - old**power) ** (1 / power), new**power - old**power)
        right = name in after and abs(gained / amplitude - 1) < 0.2
        rows.append(
            {
                "mechanism": name,
                "multiple": multiple,
                "injected": amplitude,
                "reported_before": before.get(name),
                "reported_after": after.get(name),
                "recovered": gained,
                "found": name in after and (name not in before or right),
                "within_20_percent": right,
                "also_new": sorted(set(after) - set(before) - {name}),
            }
        )
    tell(len(asked), len(asked))
    return {
        "reported_without_injection": sorted(before),
        "effects": rows,
        "found": count(r["found"] for r in rows),
        "within_20_percent": count(r["within_20_percent"] for r in rows),
    }


def withhold(capture: CaptureSet, alpha: float, tell: Tell) -> dict[str, Any]:
    """A simulator that lacks one property of the sensor: is it named, and confirmed on frames held back?"""
    first, last = real.halves(capture)
    full = diagnose(first, alpha=alpha, compare=False)
    report = document(full, key=0, version="")
    modelled = {f.mechanism for f in full.model.mechanisms}
    names = [f["mechanism"] for f in report["findings"] if f["mechanism"] in modelled][:WITHHELD]
    measured = {f["mechanism"]: f["amplitude"]["value"] for f in report["findings"]}
    held = whole(last)
    rows: list[dict[str, Any]] = []
    for n, name in enumerate(names):
        tell(n, len(names))
        lesser = full.model.without(name)
        again = diagnose(first, lesser, jax.random.key(n), alpha=alpha, compare=False)
        found = {f["mechanism"]: f for f in document(again, key=n, version="")["findings"]}
        gains = []
        for step in again.fitted.steps:
            if step.named.mechanism != name:
                continue
            same = [s for s in held.signatures if s.name == step.named.signature.name]
            scores = [s.score(held.fields) for s in same]
            gains += [held_out_gain(step.named.score, s) for s in scores if s is not None]
        rows.append(
            {
                "mechanism": name,
                "measured": measured[name],
                "recovered": found[name]["amplitude"]["value"] if name in found else None,
                "named": name in found,
                "gain_on_frames_held_back_nats": max(gains) if gains else None,
                "confirmed": bool(gains) and max(gains) > 0,
                "findings": list(found),
            }
        )
    tell(len(names), len(names))
    return {
        "properties": rows,
        "named": count(r["named"] for r in rows),
        "confirmed": count(r["confirmed"] for r in rows),
    }


def shared_in_time(signature: Signature) -> bool:
    """Whether it looks for what rows, columns, frames or neighbours share, new in every frame."""
    axes = signature.axes
    return axes.time == "redrawn" and axes.law in SHARED and axes.scales in SCALES


def permute(capture: CaptureSet, permutations: int, alpha: float, tell: Tell, kept: Path) -> dict[str, Any]:
    """Permuted frames as nulls with the sensor's own noise: false alarms of the families of time.

    kept: what every permutation gave, so that a run that was cut off goes on.
    """

    def look(changed: CaptureSet) -> tuple[dict[str, float], float]:
        prepared = whole(changed)
        timed = tuple(s for s in prepared.signatures if s.mechanism and shared_in_time(s))
        found = locate(prepared.fields, timed)
        names = {p.name: str(p.mechanism) for p in timed}
        rejected = {names[n]: p_of(p) for n, p in found.log_p.items() if p < math.log(alpha)}
        return rejected, p_of(min(found.log_p.values()))

    original, _ = look(capture)
    done: list[list[Any]] = json.loads(kept.read_text()) if kept.exists() else []
    for n in range(len(done), permutations):
        rejected, p = look(real.permuted(capture, np.random.default_rng([7, n])))
        done.append([sorted(rejected), p])
        write_atomically(kept, json.dumps(done))
        tell(n + 1, permutations)
    names = [rejected for rejected, _ in done[:permutations]]
    smallest = [p for _, p in done[:permutations]]
    return {
        "permutations": permutations,
        "reported_before": original,
        "false_alarms": count(bool(r) for r in names),
        "by_mechanism": {
            m: count(m in r for r in names) for m in sorted({m for r in names for m in r} | set(original))
        },
        "null_p_uniform": curves.uniformity(smallest),
    }


def text(result: dict[str, Any]) -> str:
    """The results for the screen."""
    lines = [f"{result['camera']}, crop {result['size'][0]} x {result['size'][1]}, alpha {result['alpha']}"]
    if part := result.get("inject"):
        lines.append(
            f"injected: found {part['found']['hits']} of {part['found']['sets']}, "
            f"within 20 % {part['within_20_percent']['hits']}; "
            f"without injection: {', '.join(part['reported_without_injection']) or 'nothing'}"
        )
        for r in part["effects"]:
            after = f"found, {r['recovered']:.3g}" if r["found"] else "not found"
            lines.append(f"  {r['mechanism']:<20} {r['multiple']:>3g} x MDE = {r['injected']:.3g}: {after}")
    if part := result.get("withhold"):
        lines.append(f"withheld: named {part['named']['hits']} of {part['named']['sets']}, "
                     f"confirmed on frames held back {part['confirmed']['hits']}")  # fmt: skip
        for r in part["properties"]:
            again = "not named" if r["recovered"] is None else f"again {r['recovered']:.3g}"
            lines.append(f"  {r['mechanism']:<20} measured {r['measured']:.3g}, {again}")
    if part := result.get("permute"):
        alarms = part["false_alarms"]
        lines.append(
            f"permuted: {alarms['hits']} alarms in {alarms['sets']} permutations "
            f"({100 * alarms['ci95'][0]:.1f}-{100 * alarms['ci95'][1]:.1f} %); before: "
            + (", ".join(sorted(part["reported_before"])) or "nothing")
        )
        for name, alarms in part["by_mechanism"].items():
            low, high = alarms["ci95"]
            lines.append(f"  {name:<20} {alarms['hits']} ({100 * low:.1f}-{100 * high:.1f} %)")
    return "\n".join(lines)
