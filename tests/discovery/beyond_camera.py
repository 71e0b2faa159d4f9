"""A plain NumPy camera for effects beyond the core: each changes the mean, the charge or the codes of one
recording's frames."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import Signature
from tests.discovery.capture import scene

SIZE = (96, 128)
GAIN, READ, BLACK, WHITE = 2.0, 3.0, 400.0, 16383.0
Change = Callable[[np.ndarray, np.random.Generator, str, float], np.ndarray]


def frames_of(
    seed: int,
    *,
    mean: Change | None = None,
    charge: Change | None = None,
    code: Change | None = None,
    spread: float = 1.0,
    frames: int = 8,
    scenes: int = 1,
) -> CaptureSet:
    """Darks of three exposures, flats of five levels and scenes. spread: of the read noise."""
    rng = np.random.default_rng(seed)
    plan = [("dark", np.zeros(SIZE), t) for t in (0.01, 1.0, 10.0)]
    plan += [("flat", np.full(SIZE, level), 0.02) for level in (0.02, 0.08, 0.2, 0.4, 0.65)]
    plan += [("scene", scene(rng, SIZE), 0.02) for _ in range(scenes)]
    out = []
    for n, (kind, clean, seconds) in enumerate(plan):
        e = np.broadcast_to(clean * (WHITE - BLACK) / GAIN, (frames, *SIZE)).copy()
        e = mean(e, rng, kind, seconds) if mean else e
        e = rng.poisson(e).astype(float)
        e = charge(e, rng, kind, seconds) if charge else e
        dn = np.round(BLACK + GAIN * (e + spread * READ * rng.standard_normal(e.shape)))
        dn = np.round(code(dn, rng, kind, seconds)) if code else dn
        lit = clean.astype(np.float32) if kind == "scene" else None
        out.append(
            Recording(
                np.clip(dn, 0, WHITE).astype(np.uint16),
                "RGGB",
                (BLACK,) * 4,
                WHITE,
                kind=kind,
                clean=lit,
                iso=100.0,
                exposure_s=seconds,
                reference="independent" if kind == "scene" else None,
                path=f"{n}_{kind}.h5",
            )
        )
    return CaptureSet("plain camera", tuple(out))


BEYOND = (
    "hits",
    "clocking",
    "dead",
    "corrected",
    "peaks",
    "lag_in_time",
    "signal_step",
    "iso_step",
    "code_spacing",
    "excess_skewness",
    "warm",
    "smear",
    "moving",
    "lattice",
)


def scores(capture: CaptureSet) -> tuple[dict[str, Score], tuple[Fields, ...], dict[str, Signature]]:
    """Scores of all signatures beyond the core on the frames that look, the fields, and the signatures."""
    prepared = splits_of(capture).looking
    own = {s.name: s for s in prepared.signatures if s.name in BEYOND}
    found = {n: s for n, p in own.items() if (s := p.score(prepared.fields)) is not None}
    return found, prepared.fields, own


def rejects(score: Score) -> bool:
    """Whether the score alone would be rejected among as many tests as the battery has."""
    return score.log_p < np.log(1e-4)
