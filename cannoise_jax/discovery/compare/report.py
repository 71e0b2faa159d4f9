"""The result of a comparison: the verdict, the table, and both as JSON and as lines of text."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery.compare.compared import Compared
from cannoise_jax.discovery.compare.run import compare_bank
from cannoise_jax.discovery.compare.score import Better, scores
from cannoise_jax.discovery.compare.table import Difference, differences
from cannoise_jax.discovery.compare.words import pair, short
from cannoise_jax.discovery.frames.simulate import Draw
from cannoise_jax.physics.core.mechanism import HasRecord
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet

SCHEMA = "cannoise/comparison/1"


class Comparison(NamedTuple):
    """What differs between recordings and a simulator, largest share first; empty: nothing that these frames
    show."""

    bank: Compared
    differences: tuple[Difference, ...]

    @property
    def verdict(self) -> str:
        """`match` or `differs`."""
        return "differs" if self.differences else "match"


def compare(
    recordings: CaptureSet,
    simulated: str | Path | SensorModel | CaptureSet | Draw,
    key: Key[Array, ""] | None = None,
    *,
    alpha: float = 0.01,
    mechanisms: Sequence[HasRecord] = (),
    tell: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """What still differs between recordings and a simulator, in numbers and with the sign.

    simulated: a sensor model or its sensor.json, 'poisson-gaussian', a function (key, clean, settings) -> DN
      or its `module:function`, a training folder, or a capture set (or folder) of simulated frames.
    alpha: chance that equal laws are said to differ. mechanisms: entries from outside the package that a
      sensor.json may name.
    Raises as `compare_bank`.
    """
    bank = compare_bank(recordings, simulated, key, alpha=alpha, mechanisms=mechanisms, tell=tell)
    return Comparison(bank, tuple(differences(bank)))


def percent(share: float | None) -> str:
    """A share as the table prints it; None where it is none of a whole number."""
    if share is None or share != share:
        return "not measured"
    return "< 1 %" if share < 0.01 else f"{100 * share:.0f} %"


def value(number: float) -> str:
    """A number with three figures."""
    return short(number) if abs(number) >= 1e-4 or number == 0 else "0"


def sign_in_words(sign: int) -> str:
    """Which way the simulator is wrong."""
    return "too little" if sign > 0 else "too much"


def lines(found: Comparison, most: int = 14) -> list[str]:
    """The table as text, one line a difference."""
    bank = found.bank
    if not found.differences:
        return [f"{bank.camera}: nothing in these frames tells them from draws of {bank.label}"]
    out = [
        f"{bank.camera} against {bank.label}: {len(found.differences)} difference"
        f"{'s' * (len(found.differences) > 1)} "
        "(share of the mismatch; the simulator has ...; recorded | simulated)"
    ]
    for d in found.differences[:most]:
        where = d.where[0] if len(d.where) == 1 else f"{len(d.where)} recordings"
        note = f", {d.note}" if d.note else ""
        out.append(
            f"{percent(d.share):>6}  {sign_in_words(d.sign):10}  {d.what} ({d.time}): "
            f"{' | '.join(pair(d.recorded, d.simulated))} {d.unit}; {where}{note}"
        )
    if len(found.differences) > most:
        rest = sum(d.share for d in found.differences[most:])
        out.append(f"{percent(rest):>6}  in {len(found.differences) - most} more, see the report")
    return out


def document(found: Comparison) -> dict[str, Any]:
    """The comparison as plain JSON values."""
    bank = found.bank
    score = scores(bank)
    return {
        "schema": SCHEMA,
        "camera": bank.camera,
        "simulator": bank.label,
        "alpha": bank.alpha,
        "verdict": found.verdict,
        "looked_at": int(sum(np.count_nonzero(j.recorded + j.simulated) for j in bank.judgements)),
        "sets_drawn": bank.sets,
        "differences": [difference_document(d) for d in found.differences],
        "recordings": [
            {
                "name": s.name,
                "kind": s.kind,
                "exposure_s": s.exposure_s,
                "frames": s.frames,
                "simulated_noise_dn": _plain(float(np.sqrt(np.mean(s.sigma**2)))),
                "signal_dn": _plain(s.signal),
                "log_score_per_pixel": _plain(float(score[s.name].mean())) if s.name in score else None,
            }
            for s in bank.seen.values()
        ],
    }


def difference_document(d: Difference) -> dict[str, Any]:
    """One line of the table as plain JSON values."""
    return {
        "what": d.what,
        "time": d.time,
        "simulator_has": sign_in_words(d.sign),
        "recorded": _plain(d.recorded),
        "simulated": _plain(d.simulated),
        "unit": d.unit,
        "share": _plain(d.share),
        "nats": _plain(d.nats),
        "z": _plain(d.z),
        "recordings": list(d.where),
        "note": d.note,
    }


def better_document(a: Comparison, b: Comparison, result: Better) -> dict[str, Any]:
    """A against B as plain JSON values."""
    fixed = None if result.fixed is None else [_plain(v) for v in result.fixed]
    return {
        "a": a.bank.label,
        "b": b.bank.label,
        "nearer": result.verdict,
        "gain_nats_per_pixel": _plain(result.gain),
        "ci90": [_plain(result.low), _plain(result.high)],
        "contrasts": result.units,
        "held_back": result.held_back,
        "differences": [len(c.differences) for c in (a, b)],
        "nats_of_differences": [_plain(sum(d.nats for d in c.differences)) for c in (a, b)],
        "fixed_pattern_gain_and_ci90": fixed,
    }


_LESS = 0.5
"""Share of the evidence for differences, nats, from which on one simulator differs less where the log score
does not tell: both are of the same frames and statistics."""


def better_line(a: Comparison, b: Comparison, result: Better) -> str:
    """A against B in one line: by the log score, and by what is left that differs."""
    first, second = (sum(d.nats for d in c.differences) for c in (a, b))
    names = a.bank.label, b.bank.label
    said = {
        "B": f"{names[1]} is nearer to the recordings than {names[0]}",
        "A": f"{names[0]} is nearer to the recordings than {names[1]}",
        "neither": "the log score of these frames does not tell which is nearer",
    }[result.verdict]
    less = 0 if first < _LESS * second else 1 if second < _LESS * first else None
    if result.verdict == "neither" and less is not None:
        said += f", but {names[less]} differs less"
    frames = "held-back frames" if result.held_back else "all frames (too few to hold some back)"
    left = " and ".join(
        f"{name} {len(c.differences)} difference{'s' * (len(c.differences) != 1)} ({value(nats)} nats)"
        for name, c, nats in zip(names, (a, b), (first, second), strict=True)
    )
    return (
        f"{said}: log score of B less A {result.gain:+.3g} nats a pixel, 90 % interval {result.low:+.3g} to "
        f"{result.high:+.3g}, {result.units} contrasts of {frames}; left are of {left}"
    )


def _plain(number: float) -> float | None:
    return float(f"{number:.6g}") if np.isfinite(number) else None
