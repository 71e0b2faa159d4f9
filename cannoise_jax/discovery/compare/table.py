"""What differs, in plain words and numbers: significant statistics gathered into lines, ranked by their share
of the mismatch.

The mismatch is counted in nats, the expected log-likelihood ratio between the recorded and the simulated
value of a statistic: for an energy of n coefficients n/2 (r - 1 - ln r) with the ratio r, for a mean half the
square of its difference over its variance, for a count of c against s c ln(c/s) - c + s. The statistics are
near-orthogonal, so that nats add; a share is a part of their sum over what was found.
"""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.compare import pieces
from cannoise_jax.discovery.compare.compared import Compared, Judgement
from cannoise_jax.discovery.compare.families import FAMILIES
from cannoise_jax.discovery.compare.pieces import Piece
from cannoise_jax.recordings.recording import DARK


class Difference(NamedTuple):
    """One line. sign: 1, the simulator has too little; -1, too much; 0: it has another one. recorded,
    simulated: in `unit`. nats: of the mismatch; share: of all that was found; z: of the statistic that shows
    it best; note: where and how it shows."""

    what: str
    time: str
    sign: int
    recorded: float
    simulated: float
    unit: str
    where: tuple[str, ...]
    nats: float
    share: float
    z: float
    note: str


def differences(compared: Compared) -> list[Difference]:
    """The lines of the table, the largest share first."""
    told: list[Piece] = []
    together = {(j.family, j.where): j for j in compared.judgements}
    for j in compared.judgements:
        if j.where not in compared.seen:
            continue
        kind = "all dark" if compared.seen[j.where].kind in DARK else "all lit"
        pooled = together.get((j.family, kind))
        found = np.abs(j.z) > j.passing
        if pooled is not None:
            # What all recordings of a kind show together is a difference of each that leans the same way.
            found |= (np.abs(pooled.z) > pooled.passing) & (np.abs(j.z) > 2) & (j.z * pooled.z > 0)
        if found.any():
            told += _pieces(compared, j, np.flatnonzero(found))
    told += [pieces.line(compared, p) for p in compared.peaks]
    return _gathered(told)


def lines_of(compared: Compared, found: list[tuple[Judgement, np.ndarray]]) -> list[str]:
    """What some statistics say, in words, the largest share first."""
    told = [p for j, k in found for p in _pieces(compared, j, k)]
    return list(dict.fromkeys(f"{d.what} ({d.time})" for d in _gathered(told)))


def _gathered(told: list[Piece]) -> list[Difference]:
    grouped: dict[tuple[str, str, int], list[Piece]] = defaultdict(list)
    for p in told:
        grouped[(*p.key, p.sign)].append(p)
    total = sum(p.nats for p in told) or 1.0
    out = []
    for (what, time, sign), mine in grouped.items():
        best = max(mine, key=lambda p: (p.nats, abs(p.z)))
        nats = float(sum(p.nats for p in mine))
        where = tuple(dict.fromkeys(p.where for p in mine))
        strongest = max(mine, key=lambda p: abs(p.z)).z
        out.append(
            Difference(
                what,
                time,
                sign,
                best.recorded,
                best.simulated,
                best.unit,
                where,
                nats,
                nats / total,
                float(strongest),
                best.note,
            )
        )
    return sorted(out, key=lambda d: -d.nats)


def _pieces(compared: Compared, j: Judgement, found: np.ndarray) -> list[Piece]:
    """The lines that one family of one recording speaks for."""
    family = FAMILIES[j.family]
    return family.lines(compared, j, found, family.time)
