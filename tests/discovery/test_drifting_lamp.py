"""A score that is learned from draws of a lamp that drifts, of several simulators with the same lamp."""

import jax
import numpy as np

from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.proof.quality import NAMED, WITH_REST, open_panel
from cannoise_jax.discovery.proof.sides import of_model, simulators
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, GAIN, READ, BLACK = (64, 96), 0.8, 3.0, 100.0


def capture(rng: np.random.Generator) -> CaptureSet:
    """Darks, and flats of a lamp that hardly moved in the frames that are held back."""
    out = []
    for kind, light in (("dark", 0.0), ("flat", 400.0), ("flat", 1500.0)):
        lamp = 1 + (0.01 * rng.standard_normal(8) if light else np.zeros(8))
        lamp[3::4] = lamp.mean()
        electrons = rng.poisson(np.broadcast_to(light * lamp[:, None, None], (8, *SIZE)))
        codes = np.round(BLACK + GAIN * (electrons + READ * rng.standard_normal((8, *SIZE))))
        frames = np.clip(codes, 0, 4095).astype(np.uint16)
        path = f"{kind}_{light:g}"
        out.append(Recording(frames, "MONO", (BLACK,) * 4, 4095.0, kind=kind, exposure_s=0.01, path=path))
    return CaptureSet("made up", tuple(out))


def test_what_the_lamp_happens_to_be_is_no_difference_between_simulators():
    recorded = capture(np.random.default_rng(1))
    plain = SensorModel.poisson_gaussian(GAIN, READ, BLACK, 4095.0, "MONO")
    drifting = plain.with_mechanism("illumination_drift", sigma=0.01)
    # Nothing to the noise, and another order of random numbers where they are drawn one after the other.
    more = drifting.with_mechanism("row_noise", sigma_dn=1e-6)
    splits = splits_of(recorded)
    sides = simulators(recorded, splits.looking, ())
    panel = open_panel(jax.random.key(3), splits.looking, splits.held_back, sides, None)
    one, two = (panel.look(of_model(m), n).side.composite for m, n in ((drifting, NAMED), (more, WITH_REST)))
    np.testing.assert_allclose(one, two, atol=2e-4)
