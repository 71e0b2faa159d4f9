"""What the statistics of one family of one recording say of the lines of the table."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.compare import words
from cannoise_jax.discovery.compare.compared import Compared, Judgement, Peak
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures import bank


class Piece(NamedTuple):
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


Lines = Callable[[Compared, Judgement, np.ndarray, str], list[Piece]]
"""Of a comparison, one family of one recording, which of its statistics were found, and `Family.time`."""
Called = Callable[[int], tuple[str, str]]
"""What the statistic at an index is called, and which it is."""


def _by_sign(j: Judgement, found: np.ndarray) -> Iterator[tuple[int, np.ndarray, int]]:
    """Where the recordings have more, and where less: which statistics, and the one that shows it best."""
    return _parted(j, found, j.z > 0)


def _by_size(j: Judgement, found: np.ndarray) -> Iterator[tuple[int, np.ndarray, int]]:
    """The same of what may have either sign: where that of the recordings is larger, and where smaller."""
    return _parted(j, found, np.abs(j.recorded) > np.abs(j.simulated))


def _parted(j: Judgement, found: np.ndarray, more: np.ndarray) -> Iterator[tuple[int, np.ndarray, int]]:
    for sign, k in ((1, found[more[found]]), (-1, found[~more[found]])):
        if k.size:
            yield sign, k, int(k[np.argmax(np.abs(j.z[k]))])


def _nats_of_means(compared: Compared, j: Judgement, k: np.ndarray) -> float:
    own = compared.recorded[j.where].families[j.family]
    return float(np.sum(len(own.values) * (j.recorded[k] - j.simulated[k]) ** 2 / own.size[k]) / 2)


def _scale(compared: Compared, where: str, time: str) -> float:
    """DN per standard deviation of the fields: noise of a pixel, or of the mean of the frames."""
    seen = compared.seen[where]
    sigma = float(np.sqrt(np.mean(seen.sigma**2)))
    return sigma / np.sqrt(seen.frames) if time == words.STATIC else sigma


def _cell(size: tuple[int, int], k: int) -> tuple[int, bank.Scale, bank.Scale]:
    """Band, row scale and column scale of one of the energies."""
    band, *at = (int(i) for i in np.unravel_index(k, bank.counts(size).shape))
    rows, columns = (bank.scales(bank.cropped_side(n) // 2)[i] for n, i in zip(size, at, strict=True))
    return band, rows, columns


def structure(compared: Compared, j: Judgement, found: np.ndarray, time: str) -> list[Piece]:
    """Of the energies, by what they are energies of; the level of all fine scales is one line."""
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
        what = words.OF_PIXELS if time == words.STATIC else "noise of a pixel"
        recorded = simulated * np.sqrt(level)
        if time == words.STATIC:
            recorded, simulated = _beyond(recorded, scale), _beyond(simulated, scale)
        sign = 1 if level > 1 else -1
        note = f"{words.digits(100 * (float(np.sqrt(level)) - 1), 2, '+')} %" if time != words.STATIC else ""
        out.append(
            Piece((what, time), sign, recorded, simulated, "DN rms", j.where, nats, float(j.z[best]), note)
        )
    for (what, sign), mine in groups.items():
        k = np.array(mine)
        recorded, simulated = (
            float(np.sqrt(max(np.sum((v[k] - white) * count[k]) / pixels, 0))) * scale
            for v, white in ((j.recorded, level), (j.simulated, 1.0))
        )
        unit = "DN rms"
        if recorded == simulated == 0:  # both have less of it than white noise
            recorded, simulated = (
                float(np.average(v[k] / white, weights=count[k]))
                for v, white in ((j.recorded, level), (j.simulated, 1.0))
            )
            unit = "of the power of white noise"
        ratio = np.maximum(j.recorded[k], 1e-6) / np.maximum(j.simulated[k] * level, 1e-6)
        nats = float(np.sum(units * count[k] / 2 * (ratio - 1 - np.log(ratio))))
        best = k[np.argmax(np.abs(j.z[k]))]
        note = words.block(*_cell(seen.size, best)[1:])
        out.append(
            Piece((what, time), sign, recorded, simulated, unit, j.where, nats, float(j.z[best]), note)
        )
    return out


def sparsity(compared: Compared, j: Judgement, found: np.ndarray, time: str) -> list[Piece]:
    """Of how unevenly structures are spread."""
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
            Piece(
                (what, time), sign, a, b,
                "% of the mean square in a typical place", j.where, float(nats), float(j.z[best]),
                words.block(*_cell(size, best)[1:]),
            )
        )  # fmt: skip
    return out


def _beyond(rms: float, white: float) -> float:
    """What a static map holds beyond the noise of its mean."""
    return float(np.sqrt(max(rms**2 - white**2, 0)))


def moments(compared: Compared, j: Judgement, found: np.ndarray, time: str) -> list[Piece]:
    """Of second, third and fourth moments, of the frame and of its parts."""
    kinds = len(bank.MOMENTS)
    out = []
    for order in range(3):
        mine = found[found // kinds == order]
        first = order * kinds
        for what, chosen in words.moments(order, time):
            k = np.array([m for m in mine if chosen(int(m - first))], int)
            if not k.size:
                continue
            best = k[np.argmax(np.abs(j.z[k]))]
            nats = _nats_of_means(compared, j, k)
            if best == 0:
                nats *= 1e-3  # the energies say the same, and have its size in DN
            recorded, simulated = float(j.recorded[best]), float(j.simulated[best])
            if order == 1 or (order == 0 and best > first):  # how uneven or lopsided, whichever side has more
                recorded, simulated = abs(recorded), abs(simulated)
            sign = 1 if recorded > simulated else -1
            place = bank.MOMENTS[best - first]
            note = "" if best == first else words.place(place)
            out.append(
                Piece(
                    (what, time), sign, float(j.recorded[best]), float(j.simulated[best]),
                    words.MOMENT_UNITS[order], j.where, nats, float(j.z[best]), note,
                )
            )  # fmt: skip
    return out


def correlations(lag_of: Callable[[int], np.ndarray], also: str = "") -> Lines:
    """Of correlations of neighbours, by size; lag_of: rows down and columns across of the one at an index."""

    def lines(compared: Compared, j: Judgement, found: np.ndarray, time: str) -> list[Piece]:
        out = []
        for sign, k, best in _by_size(j, found):
            lag = lag_of(best)
            far = "neighbouring" if max(abs(lag)) <= 4 else "distant"
            out.append(
                Piece(
                    (f"correlation of {far} pixels{also}", time), sign,
                    100 * float(j.recorded[best]), 100 * float(j.simulated[best]), "%",
                    j.where, _nats_of_means(compared, j, k), float(j.z[best]),
                    f"{lag[0]} down, {lag[1]:+d} across; {k.size} lags",
                )
            )  # fmt: skip
        return out

    return lines


def level(compared: Compared, j: Judgement, found: np.ndarray, time: str) -> list[Piece]:
    """Of the mean of the darks."""
    best = found[np.argmax(np.abs(j.z[found]))]
    nats = float(np.sum(np.minimum(j.z[found] ** 2, 1e4)) / 2)
    sign = 1 if j.z[best] > 0 else -1
    return [
        Piece(
            ("mean level of the darks", time), sign, float(j.recorded[best]), float(j.simulated[best]),
            "DN", j.where, nats, float(j.z[best]), f"site {divmod(int(best), 2)}",
        )
    ]  # fmt: skip


def counts(called: Called, per_frame: bool = False) -> Lines:
    """Of counted pixels, by sign; per_frame: whether those of every frame are counted."""

    def lines(compared: Compared, j: Judgement, found: np.ndarray, time: str) -> list[Piece]:
        seen, out = compared.seen[j.where], []
        for sign, k, best in _by_sign(j, found):
            what, note = called(best)
            each = j.recorded[k] * np.log(np.maximum(j.recorded[k], 0.5) / np.maximum(j.simulated[k], 0.5))
            # Counts beyond several limits hold each other: the strongest stands for all.
            nats = float(np.max(each - j.recorded[k] + j.simulated[k]))
            pixels, frames = seen.size[0] * seen.size[1], seen.frames if per_frame else 1
            a, b = (100 * float(v[best]) / pixels / frames for v in (j.recorded, j.simulated))
            z = float(j.z[best])
            out.append(Piece((what, time), sign, a, b, "% of pixels", j.where, max(nats, 0.0), z, note))
        return out

    return lines


def means(
    called: Called, unit: str = "% correlation", shown: Callable[[float], float] | None = None
) -> Lines:
    """Of means, by size; unit: DN for those of the static map in standard deviations of its noise. shown: of
    one in the table; None: percent."""

    def lines(compared: Compared, j: Judgement, found: np.ndarray, time: str) -> list[Piece]:
        out = []
        for sign, k, best in _by_size(j, found):
            what, note = called(best)
            scale = _scale(compared, j.where, words.STATIC) if unit == "DN" else 100.0
            both = (float(v[best]) for v in (j.recorded, j.simulated))
            a, b = (v * scale if shown is None else shown(v) for v in both)
            nats = max(_nats_of_means(compared, j, k), 0.0)
            out.append(Piece((what, time), sign, a, b, unit, j.where, nats, float(j.z[best]), note))
        return out

    return lines


def line(compared: Compared, peak: Peak) -> Piece:
    """Of one frequency."""
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
    return Piece(
        (f"line at {abs(y):.4f}, {x:.4f} cycles a pixel", words.TEMPORAL), sign, recorded, simulated,
        "DN amplitude", f"all {peak.where}", float(nats), peak.z, note,
    )  # fmt: skip
