"""What a run says of mechanisms that it did not find: their smallest detectable strength, what hid them."""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.compare import words
from cannoise_jax.discovery.compare.table import Difference
from cannoise_jax.discovery.proof.white_maps import NOISE
from cannoise_jax.discovery.result import Result
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.signatures.curve import VARIANCE_CURVE
from cannoise_jax.signatures.handed import Asked
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.signature import NO_STRENGTH, Axes, Signature


def detectable(diagnosis: Result, mechanism: str) -> tuple[float, str] | None:
    """Amplitude of a mechanism that this run would find with probability one half, and its unit; None for
    one whose amplitude is no strength but a level or a period."""
    scores = diagnosis.fitted.first.scores
    mine = [s for s in diagnosis.first.signatures if s.mechanism == mechanism and s.name in scores]
    mine = [s for s in mine if s.decides][:1] or mine
    share = SHARED.names if diagnosis.remains else 1.0
    log_p = float(np.log(diagnosis.alpha * share / diagnosis.fitted.first.tests))
    looks = tuple(p.fields for p in (diagnosis.first, diagnosis.second) if p is not None)
    share = SHARED.together if diagnosis.second else 1.0
    found = [
        s.detectable(Asked(looks, log_p, share, s.weight), scores[s.name], mechanism)
        for s in mine
        if s.detectable is not NO_STRENGTH
    ]
    best = min(found, default=np.inf)
    return (float(best), diagnosis.terms[mechanism].unit) if np.isfinite(best) else None


def still_differs(diagnosis: Result, mechanism: str) -> list[str]:
    """Lines of what still differs that are of the kind of a mechanism, so that no limit says that it is not
    there: they hold more of it than chance, of whatever cause."""
    if diagnosis.remains is None:
        return []
    scores = diagnosis.fitted.first.scores
    mine = [s.axes for s in diagnosis.first.signatures if s.mechanism == mechanism and s.name in scores]
    told = diagnosis.remains.after.differences
    return list(dict.fromkeys(d.what for d in told if any(_of_the_kind(d, axes) for axes in mine)))


def _of_the_kind(d: Difference, axes: Axes) -> bool:
    """Whether a line is of what an effect of these axes makes, and of little else. A simulator that has too
    much of it lacks none."""
    if d.sign < 0:
        return False
    over, stays = axes.varies_over, axes.time == "frozen"
    if axes.law == NOISE:
        # One line tells of rows and columns, and of pixels above and below, whichever are more so.
        lines = over in ("row", "column") and d.what == words.LINES_UNLIKE
        return lines or (over == "pixel" and d.what == words.NOISIER)
    if over in ("row", "column") and axes.law == "white":
        return d.what == f"{over}s" and (d.time == words.STATIC) == stays
    if over != "pixel" or not stays:
        return False
    if axes.law == "sparse":
        return d.what in (words.DARK, words.HOT)
    return axes.law == "white" and d.what == words.OF_PIXELS


def asked_of_a_curve(diagnosis: Result) -> tuple[Signature, ...]:
    """Signatures of how the response bends that flats were asked, where a curve of the variance that counts
    for them was found and has no name: the means of the flats did not bear one out."""
    unnamed = (s.named.signature for s in diagnosis.fitted.steps if s.named.mechanism == UNKNOWN)
    curves = {s.name for s in unnamed if s.axes.law == VARIANCE_CURVE}
    asked = (s for s in diagnosis.first.signatures if s.name in diagnosis.fitted.first.scores)
    return tuple(s for s in asked if s.axes.varies_over == "signal" and curves & {*s.lifted_by})


def absorbed_by(diagnosis: Result, mechanism: str) -> list[str]:
    """Findings that took away what spoke for a mechanism; none where nothing ever spoke for it. Its
    statistic stood out before anything was taken out, so that no limit says that it is not there; nor does
    one where a curve without a name was found that counts for it."""
    first, steps = diagnosis.fitted.first, diagnosis.fitted.steps
    mine = [s for s in diagnosis.first.signatures if s.mechanism == mechanism and s.name in first.scores]
    if any(s.mechanism == mechanism for s in asked_of_a_curve(diagnosis)):
        return [UNKNOWN]
    level = float(np.log(diagnosis.alpha))
    if not any(first.log_p.get(s.name, 0.0) < level for s in mine):
        return []
    names = {s.name for s in mine}
    over = {s.axes.varies_over for s in mine}
    taken = [
        s.named for s in steps if names & {*s.named.signature.covers, *s.named.signature.hides(s.named.score)}
    ]
    taken = taken or [s.named for s in steps if s.named.signature.axes.varies_over in over]
    return list(dict.fromkeys(n.mechanism for n in taken or [s.named for s in steps]))
