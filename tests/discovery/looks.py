"""Signatures without recordings, and fields of exactly white noise to look at."""

from __future__ import annotations

import numpy as np

from cannoise_jax.mechanisms import signatures
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.recorded import Codes, GroupBaseline, Occurred, Recorded, Stated
from cannoise_jax.signatures.signature import Signature

_GAIN, _READ = np.full(4, 1.5), np.full(4, 2.0)
RECORDED = Recorded(
    black=np.full((1, 4), 100.0),
    greens=(1, 2),
    tolerance=0.5,
    jitter=0.0,
    codes=Codes(np.zeros(200), 0.0, (), (), 1.0, 1.0, None),
    baselines=(
        GroupBaseline(
            gain=_GAIN,
            read_noise=_READ,
            black_level=np.full(4, 100.0),
            gain_stderr=0.01 * _GAIN,
            read_stderr=0.01 * _READ,
            white_level=1100.0,
            code_step=1.0,
            iso=100.0,
            levels=(),
            pedestal=np.full(4, 100.0),
        ),
    ),
    stated=(Stated(_GAIN, _READ, np.zeros(4), np.zeros(4)),),
    fitted_too=False,
    step=1.0,
    span=1000.0,
    mono=False,
    times={},
    occurred=Occurred(np.zeros(0, int), np.zeros(0), np.zeros(0), 1.0),
    units=(1.0,),
    seconds=(0.01, 1.0),
    rise=(0.0, 0.0),
    charge=(0.0,),
    unlit=(),
)
"""What files say that state the gain and read noise which was fitted, and hold no codes."""
SIGNATURES: dict[str, Signature] = {s.name: s for s in signatures(RECORDED)}


def white(rng, *, kinds=("dark", "dark", "flat"), frames=4, size=(64, 96), sigma=3.0, signal=3.6):
    """Fields of exactly white noise."""
    out = []
    for n, kind in enumerate(kinds):
        level = np.full(size, signal if kind != "dark" else 0.0, np.float32)
        out.append(
            Fields(
                f"{n}",
                kind,
                frames,
                n,
                0,
                0.1 * (n + 1),
                1.0,
                level + 100,
                level,
                np.full(size, sigma, np.float32),
                np.full(size, 0.6 if kind != "dark" else 0.0, np.float32),
                np.ones(size, bool),
                rng.standard_normal((frames - 1, *size)).astype(np.float32),
                rng.standard_normal(size).astype(np.float32),
                None,
                np.full(4, 1.5),
                np.full(4, 100.0),
            )
        )
    return tuple(out)
