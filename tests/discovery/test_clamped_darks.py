"""Dark current beside a clamp of loud pixels: what the clamp does to levels does not keep it from being
asked for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.mechanisms import MECHANISMS
from tests.discovery.capture import capture_set

_ABOUT = np.zeros((5, 5), bool)
_ABOUT[::2, ::2] = True
_ABOUT[2, 2] = False


def clamped(rng):
    """Charge of 30 e-/s, and pixels that stand out are lowered to their neighbours."""

    def change(dn, signal, kind, seconds):
        full = dn + 1.5 * rng.poisson(30.0 * seconds, dn.shape)
        limit = ndimage.maximum_filter(full, footprint=_ABOUT, mode="mirror")
        return np.where(full > limit + full.std(), limit, full)

    return change


def test_charge_is_found_beside_a_clamp():
    looking = splits_of(capture_set(7, clamped, kinds="df")).looking
    steps = stepwise(looking.fields, looking.signatures, frozenset(MECHANISMS), float(np.log(0.01))).steps
    scores = {s.named.mechanism: s.named.score for s in steps}
    assert {"hot_pixel_suppression", "dark_current"} <= set(scores)
    # The clamp lowers noise, and with it the gain.
    assert scores["dark_current"].amplitude == pytest.approx(30.0, rel=0.12)
