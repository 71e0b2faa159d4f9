"""Rows whose even and odd columns part: told from rows that move as a whole, and from offsets of sites."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from tests.discovery.capture import capture_set, row_offsets

PARTED, WHOLE = "odd_even_row_noise", "row_noise"


def by_parity(even, odd, shared):
    """Offsets of the even and the odd columns of every row, and one of all, DN rms, new in every frame."""

    def alter(rng):
        def change(dn, signal, kind, exposure):
            height, width = dn.shape
            own = rng.standard_normal((height, 2)) * (even, odd)
            return dn + own[:, np.arange(width) % 2] + shared * rng.standard_normal((height, 1))

        return change

    return alter


@pytest.mark.parametrize(
    ("alter", "truth"),
    [
        pytest.param(
            by_parity(1.5, 1.5, 0.0), {WHOLE: 1.5 / 2**0.5, PARTED: 1.5 / 2**0.5}, marks=pytest.mark.slow
        ),
        (by_parity(1.5, 1.5, 2.0), {WHOLE: (1.5**2 / 2 + 4) ** 0.5, PARTED: 1.5 / 2**0.5}),
        pytest.param(row_offsets(1.5), {WHOLE: 1.5}, marks=pytest.mark.slow),
    ],
    ids=["apart", "apart and together", "together"],
)
def test_what_rows_share_and_what_parts_their_columns_are_both_found(alter, truth):
    found = diagnose(capture_set(5, alter, kinds="d"), compare=False)
    amplitudes = {s.named.mechanism: s.named.score.amplitude for s in found.fitted.steps}
    assert amplitudes == {name: pytest.approx(value, rel=0.08) for name, value in truth.items()}
    noise = [f for f in found.model.mechanisms if "sigma_dn" in f.parameters]
    fitted = {f.mechanism: float(np.ravel(f.parameters["sigma_dn"])[0]) for f in noise}
    assert fitted == {name: pytest.approx(value, rel=0.1) for name, value in truth.items()}
