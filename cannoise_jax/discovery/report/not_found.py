"""What a run says of mechanisms that it did not find: their smallest detectable strength, what hid them."""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.result import Result
from cannoise_jax.signatures.handed import Asked
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.signature import NO_STRENGTH


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


def absorbed_by(diagnosis: Result, mechanism: str) -> list[str]:
    """Findings that took away what spoke for a mechanism; none where nothing ever spoke for it. Its
    statistic stood out before anything was taken out, so that no limit says that it is not there."""
    first, steps = diagnosis.fitted.first, diagnosis.fitted.steps
    mine = [s for s in diagnosis.first.signatures if s.mechanism == mechanism and s.name in first.scores]
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
