"""A lamp that drifts: what scores learn of it, and how strong it is told beside what else moves frames."""

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.proof.quality import NAMED, WITH_REST, open_panel
from cannoise_jax.discovery.proof.sides import of_model, simulators
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.discovery.search.maps import beside_others, one_draw
from cannoise_jax.mechanisms import ENTRIES
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


LOOKED_FOR = ("flicker", "frame_relative", "frame_additive", "row_additive_temporal", "row_relative_temporal")
ROWS = np.arange(SIZE[0])[:, None]


def frames_of(
    rng: np.random.Generator, beside: str, light: float, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Frames of one level of light, and how bright the lamp is in each."""
    lamp = 1 + 0.004 * rng.standard_normal(count) if light else np.ones(count)
    shape, level = (count, *SIZE), lamp[:, None, None] * np.ones((count, *SIZE))
    moved = np.zeros((count, 1, 1))
    if beside == "flicker":
        phase = rng.uniform(0, 2 * np.pi, (count, 1, 1))
        level = level * (1 + 0.012 * np.sin(2 * np.pi * ROWS / 20.7 + phase))
    if beside == "row_noise":
        moved = 1.5 * rng.standard_normal((count, SIZE[0], 1))
    if beside == "offset_drift":
        moved = 0.8 * rng.standard_normal((count, 1, 1))
    electrons = rng.poisson(light * level)
    codes = np.round(BLACK + moved + GAIN * (electrons + READ * rng.standard_normal(shape)))
    return np.clip(codes, 0, 4095).astype(np.uint16), lamp


@pytest.mark.parametrize("beside", ["", "flicker", "row_noise", "offset_drift"])
def test_the_drift_of_a_lamp_has_its_strength_beside_what_else_moves_frames_or_rows(beside):
    rng, recorded, lamps = np.random.default_rng(5), [], []
    for n, light in enumerate((0.0, 500.0, 1200.0, 2500.0)):
        frames, lamp = frames_of(rng, beside, light, 16)
        kind = "flat" if light else "dark"
        recorded.append(
            Recording(frames, "MONO", (BLACK,) * 4, 4095.0, kind=kind, exposure_s=0.01, path=f"{n}_{kind}")
        )
        lamps += [lamp / lamp.mean()] if light else []
    splits = splits_of(CaptureSet("made up", tuple(recorded)))
    first = splits.looking
    signatures = tuple(s for s in first.signatures if s.name in LOOKED_FOR)
    fitted = stepwise(first.fields, signatures, frozenset(e.id for e in ENTRIES), np.log(0.01))
    found = {s.named.mechanism: s.named.score for s in fitted.steps}
    assert beside in found or not beside
    looked = [lamp[chosen] for lamp, (chosen, _) in zip(lamps, splits.frames[1:], strict=True)]
    drawn = np.sqrt(np.mean([np.var(values, ddof=1) for values in looked]))
    assert found["illumination_drift"].amplitude == pytest.approx(drawn, rel=0.15)


def test_sensitivities_of_pixels_are_no_stronger_beside_a_lamp_that_drifts():
    """The drift is in the noise that maps are measured beside until it is found, and is taken out before them
    then."""
    rng, recorded = np.random.default_rng(8), []
    response = 1 + 0.02 * rng.standard_normal(SIZE)
    for n, light in enumerate((0.0, 1500.0, 4000.0)):
        lamp = 1 + (0.01 * rng.standard_normal(8) if light else np.zeros(8))
        electrons = rng.poisson(light * response * lamp[:, None, None])
        codes = np.round(BLACK + GAIN * (electrons + READ * rng.standard_normal((8, *SIZE))))
        frames, kind = np.clip(codes, 0, 4095).astype(np.uint16), "flat" if light else "dark"
        recorded.append(
            Recording(frames, "MONO", (BLACK,) * 4, 4095.0, kind=kind, exposure_s=0.01, path=f"{n}_{kind}")
        )
    first = splits_of(CaptureSet("made up", tuple(recorded))).looking
    looked_for = ("pixel_relative_static", "frame_relative")
    signatures = tuple(s for s in first.signatures if s.name in looked_for)
    fitted = stepwise(first.fields, signatures, frozenset(e.id for e in ENTRIES), np.log(0.01))
    assert max(fitted.first.scores.items(), key=lambda s: s[1].evidence)[0] == looked_for[0]
    assert [s.named.signature.name for s in fitted.steps] == [*reversed(looked_for)]
    steps = beside_others(fitted.steps)
    assert steps[1].named.score.amplitude == pytest.approx(response.std(), rel=0.02)
    pattern = one_draw(steps)[1]
    assert pattern.std() == pytest.approx(response.std(), rel=0.02)
    # A draw of what is known: half of what it is off by is that the frames have noise.
    noise = np.sqrt(2 / (6 * (1500 + 4000)))
    assert np.std(pattern - response) == pytest.approx(noise, rel=0.15)
