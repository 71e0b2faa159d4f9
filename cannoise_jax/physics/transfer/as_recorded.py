"""Where a camera model has other numbers than the photon transfer table, and why.

Table, EMVA 1288 sheet and noise profiles are of the codes as they were recorded, which is what the standard
asks for (release 4.0, linear model) and what a denoiser of such codes meets. A camera model draws the noise
before the response bends and before neighbours are mixed, so it has the numbers that were there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.model import Finding
from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer


def as_recorded(
    model: SensorModel, transfers: Sequence[PhotonTransfer], findings: Sequence[Finding]
) -> tuple[str, ...]:
    """A line for each reason why gain, read noise or sensitivities of the camera model are others than those
    of the table; none where they agree. Of the first setting that has a baseline."""
    base = next((t.baseline for t in transfers if isinstance(t.baseline, Baseline)), None)
    if base is None:
        return ()
    measured = [f for f in findings if f.measured]
    smooth = ", ".join(f.mechanism.replace("_", " ") for f in measured if f.estimator.smooths)
    bent = ", ".join(f.mechanism for f in measured if f.estimator.corrects)
    gain, read = (float(np.mean(np.asarray(v)[0])) for v in (model.gain_dn_per_e, model.read_noise_e))
    table = float(np.mean(base.gain)), float(np.mean(base.read_noise_e))
    here = f"the gain of {table[0]:.4g} DN/e- and the read noise of {table[1]:.3g} e-"
    where, others = "in table, sheet and profiles", f"the camera model has {gain:.4g} DN/e- and {read:.3g} e-"
    lines = []
    if smooth:
        lines.append(f"{smooth} lowers the variance: {here} {where} are those of smoothed noise, {others}")
    if bent:
        lines.append(
            f"{bent} bends the response: {here}, and PRNU1288, {where} are those of the codes as recorded, "
            f"not corrected for it, as EMVA 1288 has them; {others}{_sensitivities(measured)}"
        )
    return tuple(lines)


def _sensitivities(measured: Sequence[Finding]) -> str:
    """What shares of the light the model has, as they are before the response bends."""
    shares = [
        (f.mechanism, next(iter(f.measured.values())))
        for f in measured
        if f.measured and f.estimator.of_light
    ]
    return "".join(f", {name} of {100 * share.value:.3g} %" for name, share in shares)
