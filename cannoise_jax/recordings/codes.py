"""The spacing of the stored codes: raw files often hold ADC codes shifted left, and sometimes none at all.

The rule, on a histogram of stored values:
1. A code's weight is its count, cut at a thousandth of all pixels, so that neither one crowded code nor a
   few hot pixels decide. The step is the largest s for which 95 % of the weight lies on one lattice
   r + s k. Missing codes do not change it (they leave wider gaps on the same lattice), nor do a clip level
   or a few repaired pixels off the lattice.
2. A step above 1 needs evidence that the codes between are truly unused: eleven codes on the lattice (the
   chance that a step half as large fills only every second code is below 0.001), or ten pixels in
   neighbouring populated codes with nothing between. Otherwise the outcome is `undetermined`.
3. Where signal is sparse, gaps scatter widely (geometric law) and the smallest gap still appears. Gaps that
   are regular and all wider than the step come from a table or a digital gain, not from sparse signal. If
   some part of the range has them and another has the plain step, or their width changes along the range,
   the values are `compressed`; if all of it has them, `scaled`. Neither is one lattice.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.packing import SITES

_CODES = 1 << 16
_LARGEST_STEP = 4096
_WINDOW = 32  # gaps that are looked at together
_FEW_GAPS = 10
"""Gaps from which on fewer than two windows tell: of sparse signal ten are hardly ever alike."""
_REGULAR = 0.35
"""Standard deviation of gaps over their mean up to which they are those of a table or a gain."""
_CROWDED = 50.0
"""Values a code from which gaps beside it are none of sparse light."""
_TAIL = 0.01
"""Share of the values on either side that is left out where spacings are told: codes there are sparse."""


class Spacing(NamedTuple):
    """Where the codes of a recording lie, DN, and how wide the cell of each is."""

    codes: Float[np.ndarray, "n"]
    cells: Float[np.ndarray, "n"]

    def at(self, level: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
        """The spacing of the codes at a level, DN."""
        return np.interp(level, self.codes, self.cells)


class CodeLattice(NamedTuple):
    """What the stored codes lie on. step: DN between codes, 0 unless `outcome` is "lattice"."""

    step: float
    outcome: Literal["lattice", "compressed", "scaled", "undetermined"]
    codes: int
    """How many distinct codes occur."""


def detect_code_step(frames: Any) -> float:
    """Spacing of the stored codes in DN over all pixels, 0 where they are not one lattice.

    Channels of different steps share no lattice: see `code_histograms`.
    frames: integer DN, an array of any shape or the lazy frames of a recording.
    """
    return code_lattice(code_histogram(frames)).step


def code_histogram(frames: Any) -> Int[np.ndarray, "65536"]:
    """How often each stored value occurs. Raises ValueError for values that are not 16-bit whole numbers."""
    return sum((_histogram(part) for part in _parts(frames)), np.zeros(_CODES, np.int64))


def code_histograms(frames: Any) -> Int[np.ndarray, "4 65536"]:
    """`code_histogram` of each mosaic site, mosaic order."""
    counts = np.zeros((4, _CODES), np.int64)
    for part in _parts(frames):
        for site in range(4):
            counts[site] += _histogram(part[..., *SITES[site]])
    return counts


def code_lattice(histogram: Int[np.ndarray, "65536"]) -> CodeLattice:
    """The lattice of the codes in a histogram of stored values, by the rule in the module's docstring."""
    codes = np.flatnonzero(histogram)
    counts = histogram[codes]
    if len(codes) < 2:
        return CodeLattice(0.0, "undetermined", len(codes))
    step, on_lattice = _largest_step(codes, counts)
    if step > 1 and not _evident(codes[on_lattice], counts[on_lattice], step):
        return CodeLattice(0.0, "undetermined", len(codes))
    kind = _gap_kind(codes[on_lattice], step)
    return CodeLattice(float(step) if kind == "lattice" else 0.0, kind, len(codes))


def spacing_of(histogram: Int[np.ndarray, "65536"]) -> Spacing | None:
    """How far apart codes lie along their range, which is one number only on a lattice; None where too few
    values tell."""
    codes = np.flatnonzero(histogram)
    if len(codes) < 2:
        return None
    share = np.cumsum(histogram[codes]) / histogram.sum()
    first, last = (int(np.searchsorted(share, q)) for q in (_TAIL, 1 - _TAIL))
    around = codes[max(first - 1, 0) : last + 2]
    if len(around) < 2 or histogram[codes[first : last + 1]].mean() < _CROWDED:
        return None
    return Spacing(around.astype(np.float64), np.gradient(around.astype(np.float64)))


def _parts(frames: Any):
    return chunks(frames, 16 << 20) if len(frames.shape) == 3 else [np.asarray(frames)]


def _histogram(values: np.ndarray) -> np.ndarray:
    whole = values.astype(np.int64)
    if values.dtype.kind not in "iu" and not np.array_equal(whole, values):
        raise ValueError("stored codes are whole numbers: give the DN as stored, not normalised values")
    if whole.size and not 0 <= whole.min() <= whole.max() < _CODES:
        raise ValueError("stored codes are 16 bits: 0 to 65535")
    return np.bincount(whole.ravel(), minlength=_CODES)


def _largest_step(codes: np.ndarray, counts: np.ndarray) -> tuple[int, np.ndarray]:
    """The largest step that carries 95 % of the weight, and which codes lie on its lattice."""
    weight = np.minimum(counts, max(1.0, counts.sum() / 1000))
    heaviest = np.argsort(-counts, kind="stable")
    codes = codes.astype(np.int32)  # whose remainders take half the time
    # On the lattice of a step beyond their range one code lies alone.
    steps = np.arange(1, min(_LARGEST_STEP, int(np.ptp(codes))) + 1, dtype=np.int32)
    sample, first = heaviest[:64], heaviest[:16]
    total = weight[sample].sum()
    best = (1, np.ones(len(codes), bool))

    def fits(steps: np.ndarray, some: np.ndarray, origin: int) -> np.ndarray:
        return ((codes[some, None] - origin) % steps == 0).T @ weight[some]

    # The three most frequent codes as origins: one of them may be a clip level off the lattice.
    for origin in codes[heaviest[:3]]:
        # Whoever misses more among the first than may be missed among all is out.
        likely = steps[fits(steps, first, origin) >= weight[first].sum() - 0.11 * total]
        for step in likely[fits(likely, sample, origin) >= 0.9 * total][::-1]:
            if step <= best[0]:
                break
            on_lattice = (codes - origin) % step == 0
            if on_lattice.sum() > 1 and weight[on_lattice].sum() >= 0.95 * weight.sum():
                best = (int(step), on_lattice)
                break
    return best


def _evident(codes: np.ndarray, counts: np.ndarray, step: int) -> bool:
    neighbours = np.diff(codes) == step
    return len(codes) >= 11 or np.minimum(counts[1:], counts[:-1])[neighbours].sum() >= 10


def _gap_kind(codes: np.ndarray, step: int) -> Literal["lattice", "compressed", "scaled"]:
    gaps = np.diff(codes) / step
    if _FEW_GAPS <= len(gaps) < 2 * _WINDOW:  # those of one level of light, or of a dark
        few = np.sort(gaps)[len(gaps) // 10 : -(len(gaps) // 10)]
        return "scaled" if few[0] >= 2 and few.std() < _REGULAR * few.mean() else "lattice"
    windows = [np.sort(gaps[at : at + _WINDOW]) for at in range(0, len(gaps) - _WINDOW + 1, _WINDOW)]
    inner = [w[_WINDOW // 10 : -(_WINDOW // 10)] for w in windows]
    plain = [w for w in inner if w[0] < 2]
    # Gaps of sparse signal have a std near their mean; those of a table or a gain hardly scatter.
    regular = [w for w in inner if w[0] >= 2 and w.std() < _REGULAR * w.mean()]
    if len(regular) < max(2, len(windows) // 8):
        return "lattice"
    widths = [w.mean() for w in regular]
    return "compressed" if plain or max(widths) > 1.25 * min(widths) else "scaled"


def share_above(index: Int[np.ndarray, "n"], counts: Int[np.ndarray, "n"], period: int, phase: int) -> float:
    """Of the values of every so-manieth code, which is missing, the share that the next code holds; the one
    before has the others. index, counts: of codes in a row. 1 where every code is beside two missing ones."""
    if period < 3:
        return 1.0
    # Over one period values are moved, none is lost.
    usual = np.convolve(counts, np.ones(period) / period, "same")
    above, below = (
        float(np.sum((counts - usual)[index % period == (phase + side) % period])) for side in (1, -1)
    )
    above, below = max(above, 0.0), max(below, 0.0)
    return above / (above + below) if above + below > 0 else 1.0
