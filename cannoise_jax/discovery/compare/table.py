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

from cannoise_jax.discovery.compare import words
from cannoise_jax.discovery.compare.judge import Judgement
from cannoise_jax.discovery.compare.run import Compared
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures import bank


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


class _Piece(NamedTuple):
    """What one family of one recording says of one line of the table."""

    key: tuple[str, str]
    sign: int
    recorded: float
    simulated: float
    unit: str
    where: str
    nats: float
    z: float
    note: str


def differences(compared: Compared) -> list[Difference]:
    """The lines of the table, the largest share first."""
    pieces: list[_Piece] = []
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
            pieces += _pieces(compared, j, np.flatnonzero(found))
    pieces += [_line(compared, p) for p in compared.peaks]
    return _gathered(pieces)


def lines_of(compared: Compared, found: list[tuple[Judgement, np.ndarray]]) -> list[str]:
    """What some statistics say, in words, the largest share first."""
    pieces = [p for j, k in found for p in _pieces(compared, j, k)]
    return list(dict.fromkeys(f"{d.what} ({d.time})" for d in _gathered(pieces)))


def _gathered(pieces: list[_Piece]) -> list[Difference]:
    grouped: dict[tuple[str, str, int], list[_Piece]] = defaultdict(list)
    for p in pieces:
        grouped[(*p.key, p.sign)].append(p)
    total = sum(p.nats for p in pieces) or 1.0
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


def _pieces(compared: Compared, j: Judgement, found: np.ndarray) -> list[_Piece]:
    """The lines that one family of one recording speaks for."""
    time, _, family = j.family.rpartition(": ")
    if family == "structure":
        return _structure(compared, j, found, time)
    if family == "sparsity":
        return _sparsity(compared, j, found, time)
    if family == "moments":
        return _moments(compared, j, found, time)
    if family in ("neighbours", "neighbours by parity"):
        return _neighbours(compared, j, found, time, family)
    if family == "level":
        return _level(compared, j, found)
    return _simple(compared, j, found, family, words.time(j.family))


def _scale(compared: Compared, where: str, time: str) -> float:
    """DN per standard deviation of the fields: noise of a pixel, or of the mean of the frames."""
    seen = compared.seen[where]
    sigma = float(np.sqrt(np.mean(seen.sigma**2)))
    return sigma / np.sqrt(seen.frames) if time == "fixed" else sigma


def _cell(size: tuple[int, int], k: int) -> tuple[int, bank.Scale, bank.Scale]:
    """Band, row scale and column scale of one of the energies."""
    band, *at = (int(i) for i in np.unravel_index(k, bank.counts(size).shape))
    rows, columns = (bank.scales(bank.cropped_side(n) // 2)[i] for n, i in zip(size, at, strict=True))
    return band, rows, columns


def _structure(compared: Compared, j: Judgement, found: np.ndarray, time: str) -> list[_Piece]:
    seen = compared.seen[j.where]
    count = bank.counts(seen.size).ravel()
    pixels = float(count.sum())
    units = len(compared.recorded[j.where].families[j.family].values)
    scale = _scale(compared, j.where, time)
    # The level of all fine scales is the noise of a pixel; what a scale has beyond it is its own.
    fine = np.flatnonzero(np.isin(np.arange(count.size), found) & (count >= pixels / 64 / 4))
    a, b = (np.sum((v * count)[count >= pixels / 64 / 4]) for v in (j.recorded, j.simulated))
    level = float(a / b) if fine.size and b > 0 else 1.0
    groups: dict[tuple[str, int], list[int]] = defaultdict(list)
    for k in found:
        ratio = j.recorded[k] / max(j.simulated[k] * level, 1e-9)
        own = abs(np.log(ratio)) > 2.5 * np.sqrt(2 * (1 + 1 / compared.sets) / (units * count[k]))
        what = words.structure(*_cell(seen.size, k), seen.size)
        if count[k] >= pixels / 64 / 4 and not own or what is None:
            continue
        if own:
            groups[(what, 1 if ratio > 1 else -1)].append(int(k))
    out = []
    if fine.size and abs(np.log(level)) > 1e-4:
        best = fine[np.argmax(np.abs(j.z[fine]))]
        nats = units * pixels / 2 * (level - 1 - np.log(level))
        simulated = scale * float(np.sqrt(b / pixels * pixels / np.sum(count[count >= pixels / 64 / 4])))
        what = "fixed pattern of single pixels" if time == "fixed" else "noise of a pixel"
        recorded = simulated * np.sqrt(level)
        if time == "fixed":
            recorded, simulated = _beyond(recorded, scale), _beyond(simulated, scale)
        sign = 1 if level > 1 else -1
        note = f"{100 * (np.sqrt(level) - 1):+.2g} %" if time != "fixed" else ""
        out.append(
            _Piece((what, time), sign, recorded, simulated, "DN rms", j.where, nats, float(j.z[best]), note)
        )
    for (what, sign), mine in groups.items():
        k = np.array(mine)
        recorded, simulated = (
            float(np.sqrt(max(np.sum((v[k] - white) * count[k]) / pixels, 0))) * scale
            for v, white in ((j.recorded, level), (j.simulated, 1.0))
        )
        ratio = np.maximum(j.recorded[k], 1e-6) / np.maximum(j.simulated[k] * level, 1e-6)
        nats = float(np.sum(units * count[k] / 2 * (ratio - 1 - np.log(ratio))))
        best = k[np.argmax(np.abs(j.z[k]))]
        note = words.block(*_cell(seen.size, best)[1:])
        out.append(
            _Piece((what, time), sign, recorded, simulated, "DN rms", j.where, nats, float(j.z[best]), note)
        )
    return out


def _sparsity(compared: Compared, j: Judgement, found: np.ndarray, time: str) -> list[_Piece]:
    size = compared.seen[j.where].size
    family = compared.recorded[j.where].families[j.family]
    groups: dict[tuple[str, int], list[int]] = defaultdict(list)
    for k in found:
        what = words.structure(*_cell(size, k), size)
        if what is not None:
            sign = 1 if j.recorded[k] < j.simulated[k] else -1
            groups[(f"{what} that are strong in few places", sign)].append(int(k))
    out = []
    for (what, sign), mine in groups.items():
        k = np.array(mine)
        best = k[np.argmax(np.abs(j.z[k]))]
        nats = len(family.values) * np.sum((j.recorded[k] - j.simulated[k]) ** 2 / family.size[k]) / 2
        a, b = (100 * float(np.exp(v[best])) for v in (j.recorded, j.simulated))
        out.append(
            _Piece(
                (what, time), sign, a, b,
                "% of the mean square in a typical place", j.where, float(nats), float(j.z[best]),
                words.block(*_cell(size, best)[1:]),
            )
        )  # fmt: skip
    return out


def _beyond(rms: float, white: float) -> float:
    """What a static map holds beyond the noise of its mean."""
    return float(np.sqrt(max(rms**2 - white**2, 0)))


def _moments(compared: Compared, j: Judgement, found: np.ndarray, time: str) -> list[_Piece]:
    kinds = len(bank.MOMENTS)
    variance = compared.recorded[j.where].families[j.family].size
    units = len(compared.recorded[j.where].families[j.family].values)
    out = []
    for order in range(3):
        mine = found[found // kinds == order]
        first = order * kinds
        for what, chosen in words.moments(order, time):
            k = np.array([m for m in mine if chosen(int(m - first))], int)
            if not k.size:
                continue
            best = k[np.argmax(np.abs(j.z[k]))]
            nats = float(np.sum(units * (j.recorded[k] - j.simulated[k]) ** 2 / variance[k]) / 2)
            if best == 0:
                nats *= 1e-3  # the energies say the same, and have its size in DN
            sign = 1 if j.recorded[best] > j.simulated[best] else -1
            place = bank.MOMENTS[best - first]
            note = "" if best == first else words.place(place)
            out.append(
                _Piece(
                    (what, time), sign, float(j.recorded[best]), float(j.simulated[best]),
                    words.MOMENT_UNITS[order], j.where, nats, float(j.z[best]), note,
                )
            )  # fmt: skip
    return out


def _neighbours(compared: Compared, j: Judgement, found: np.ndarray, time: str, family: str) -> list[_Piece]:
    at = bank.lags()
    variance = compared.recorded[j.where].families[j.family].size
    units = len(compared.recorded[j.where].families[j.family].values)
    out = []
    for sign in (1, -1):
        k = found[np.sign(j.z[found]) == sign]
        if not k.size:
            continue
        best = k[np.argmax(np.abs(j.z[k]))]
        near = bank.near_lags()
        lag = at[best] if family == "neighbours" else at[near[best % near.size]]
        what = "correlation of neighbouring pixels" if max(abs(lag)) <= 4 else "correlation of distant pixels"
        if family != "neighbours":
            what += ", unlike between the sites of the mosaic"
        nats = float(np.sum(units * (j.recorded[k] - j.simulated[k]) ** 2 / variance[k]) / 2)
        note = f"{lag[0]} down, {lag[1]:+d} across; {k.size} lags"
        out.append(
            _Piece(
                (what, time), sign, 100 * float(j.recorded[best]), 100 * float(j.simulated[best]), "%",
                j.where, nats, float(j.z[best]), note,
            )
        )  # fmt: skip
    return out


def _level(compared: Compared, j: Judgement, found: np.ndarray) -> list[_Piece]:
    best = found[np.argmax(np.abs(j.z[found]))]
    nats = float(np.sum(np.minimum(j.z[found] ** 2, 1e4)) / 2)
    sign = 1 if j.z[best] > 0 else -1
    return [
        _Piece(
            ("mean level of the darks", "fixed"), sign, float(j.recorded[best]), float(j.simulated[best]),
            "DN", j.where, nats, float(j.z[best]), f"site {divmod(int(best), 2)}",
        )
    ]  # fmt: skip


def _simple(compared: Compared, j: Judgement, found: np.ndarray, family: str, time: str) -> list[_Piece]:
    """Counts, and means whose size needs no more than their own unit."""
    out = []
    stored = compared.recorded[j.where].families[j.family]
    for sign in (1, -1):
        k = found[np.sign(j.z[found]) == sign]
        if not k.size:
            continue
        best = k[np.argmax(np.abs(j.z[k]))]
        a, b = float(j.recorded[best]), float(j.simulated[best])
        what, note = words.simple(family, int(best))
        if stored.law == "count":
            each = j.recorded[k] * np.log(np.maximum(j.recorded[k], 0.5) / np.maximum(j.simulated[k], 0.5))
            # Counts beyond several limits hold each other: the strongest stands for all.
            nats = float(np.max(each - j.recorded[k] + j.simulated[k]))
            pixels = compared.seen[j.where].size[0] * compared.seen[j.where].size[1]
            frames = compared.seen[j.where].frames if family in words.PER_FRAME else 1
            a, b, unit = 100 * a / pixels / frames, 100 * b / pixels / frames, "% of pixels"
        else:
            nats = float(
                np.sum(len(stored.values) * (j.recorded[k] - j.simulated[k]) ** 2 / stored.size[k]) / 2
            )
            unit = "DN" if family == "smooth maps" else "% correlation"
            scale = _scale(compared, j.where, "fixed") if family == "smooth maps" else 100.0
            a, b = a * scale, b * scale
        out.append(_Piece((what, time), sign, a, b, unit, j.where, max(nats, 0.0), float(j.z[best]), note))
    return out


def _line(compared: Compared, peak) -> _Piece:
    names = [n for n, s in compared.seen.items() if (s.kind in DARK) == (peak.where == "dark")]
    scale = float(np.mean([_scale(compared, n, "") for n in names]))
    y, x = peak.frequency
    frames = sum(compared.seen[n].frames for n in names)
    pixels = compared.seen[names[0]].size[0] * compared.seen[names[0]].size[1]
    excess = peak.amplitude**2 / 4 * pixels
    nats = frames * (excess - np.log1p(excess))
    sign = 1 if peak.z > 0 else -1
    amplitude = peak.amplitude * scale
    recorded, simulated = (amplitude, 0.0) if sign > 0 else (0.0, amplitude)
    note = words.frequency(y, x)
    return _Piece(
        (f"line at {abs(y):.4f}, {x:.4f} cycles a pixel", "frame to frame"), sign, recorded, simulated,
        "DN amplitude", f"all {peak.where}", float(nats), peak.z, note,
    )  # fmt: skip
