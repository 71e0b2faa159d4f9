"""Known shapes in the mean where parts of the frame say nothing."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.signatures.means import step_score
from tests.discovery.capture import capture_set


@pytest.mark.filterwarnings("error")
def test_a_border_without_usable_pixels_is_no_step():
    capture = capture_set(61, kinds="d")
    out = []
    for f in prepare_split(capture, split_recordings(capture)).fields:
        usable = f.usable.copy()
        usable[:, :20] = False
        static = (f.static + 0.01) * usable
        out.append(f._replace(usable=usable, static=static, contrasts=f.contrasts * usable))
    score = step_score(tuple(out))
    assert score.log_p > np.log(1e-3) and np.isfinite([score.amplitude, score.error]).all()
    assert score.error > 0


def test_no_usable_pixel_gives_no_score():
    capture = capture_set(62, kinds="d")
    fields = prepare_split(capture, split_recordings(capture)).fields
    none = tuple(f._replace(usable=np.zeros_like(f.usable), static=f.static * 0) for f in fields)
    assert step_score(none) is None
