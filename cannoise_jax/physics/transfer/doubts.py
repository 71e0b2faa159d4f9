"""What bears on all numbers of a photon transfer, and is said where it is run as well as beside them."""

from __future__ import annotations

import numpy as np

from cannoise_jax.physics.transfer.estimate import Estimate
from cannoise_jax.physics.transfer.multiplied import multiplied
from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer
from cannoise_jax.physics.transfer.smoothed import flats_alike, smoothed
from cannoise_jax.physics.transfer.stated_gain import far_from_stated
from cannoise_jax.physics.transfer.two_offsets import two_offsets
from cannoise_jax.physics.transfer.unlike_biases import unlike_biases


def doubts(result: PhotonTransfer) -> tuple[str, ...]:
    """Reasons why the gain of one setting, all that is in electrons, or the read noise, may be none of the
    sensor's."""
    gains = [o.value for o in result.outcomes("system gain") if isinstance(o, Estimate)]
    lines = [q.doubt for q in result.quantities if q.doubt]
    lines = [max(lines, key=len)] if lines else []
    lines.append(smoothed(result.statistics) or flats_alike(result.statistics))
    lines.append(multiplied(s.recording for s in result.statistics))
    lines.append(two_offsets(result.statistics))
    lines.append(far_from_stated((s.recording for s in result.statistics), gains))
    lines.append(unlike_biases(result.statistics, float(np.mean(gains)) if gains else 0.0))
    return tuple(filter(None, lines))
