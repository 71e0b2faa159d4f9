"""Series of exposures, each with darks of its own: what dark charge adds belongs to no black level and to no
light. A plain NumPy camera."""

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.draws import draw_like, drawing
from cannoise_jax.discovery.frames.faults import at_one_temperature
from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.search.model import baseline_model
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet, Recording

GAIN, READ, BLACK, RATE = 1.6, 4.0, 300.0, 40.0


def series(seed=0, exposures=(1.0, 2.0, 4.0), celsius=(None,), size=(96, 112), base=RATE, read=READ):
    """A flat and darks of every exposure; the dark current doubles in 7 K."""
    rng, out = np.random.default_rng(seed), []
    for kind, light in (("dark", 0.0), ("flat", 400.0)):
        for seconds in exposures:
            for warm in celsius if kind == "dark" else celsius[:1]:
                rate = base * 2 ** ((warm - celsius[0]) / 7) if warm is not None else base
                charge = rng.poisson((light + rate) * seconds, (5, *size))
                codes = BLACK + GAIN * (charge + read * rng.standard_normal(charge.shape))
                out.append(
                    Recording(
                        np.rint(codes).astype(np.uint16), "MONO", (BLACK,) * 4, 16383.0, kind=kind,
                        exposure_s=seconds, temperature_c=warm, path=f"{kind}_{seconds:g}_{warm}",
                    )
                )  # fmt: skip
    return CaptureSet("made", tuple(out))


@pytest.fixture(scope="module")
def found():
    return diagnose(series(), key=jax.random.key(1), compare=False)


def test_dark_current_is_named_confirmed_and_has_its_size(found):
    (step,), (proof,) = found.fitted.steps, found.proofs
    assert step.named.mechanism == "dark_current" and proof.confirmed
    value, _, error = proof.score.parameters["dark_current"]
    assert abs(value - RATE) < 4 * error and error < 0.03 * RATE


def test_the_black_level_of_the_model_is_that_of_no_exposure(found):
    assert np.asarray(found.model.black_level) == pytest.approx([BLACK] * 4, abs=1.5)
    assert np.asarray(found.model.read_noise_e)[0] == pytest.approx([READ] * 4, rel=0.08)


@pytest.mark.parametrize("charge", [pytest.param(0.0, marks=pytest.mark.slow), 90.0])
def test_light_of_flats_is_asked_for_by_their_mean(charge):
    """Whatever a simulator adds to it, the mean of its draws is that of the recording."""
    capture = series(2, exposures=(1.0, 2.0))
    first = splits_of(capture).looking
    plain = drawing(baseline_model(capture, first), jax.random.key(3))

    def more(number, clean, settings):
        return plain(number, clean, settings) + np.uint16(charge)

    drawn = draw_like(more, first)
    for field in (f for f in first.fields if f.lit):
        error = float(field.sigma.mean()) / np.sqrt(drawn[field.number].size)
        assert abs(drawn[field.number].mean() - field.mean.mean()) < 8 * error + 0.002 * field.signal.mean()


def test_darks_of_another_temperature_are_left_out_and_said():
    capture = series(4, exposures=(1.0, 2.0), celsius=(10.0, 24.0))
    kept, (line,) = at_one_temperature(capture)
    assert [r.temperature_c for r in kept.recordings] == [10.0] * 4
    assert "dark_1_24.0 (24 C)" in line and "bin/calibrate" in line
    assert at_one_temperature(kept)[1] == ()


@pytest.mark.parametrize("read", [READ, 1.3 * READ])
def test_noise_of_dark_charge_is_no_read_noise(read):
    """Of a simulator with half of the dark current the shortest dark is less noisy; its noise there is told
    beside that charge."""
    drawn = series(6, base=RATE / 2, read=read)
    looking = splits_of(series(5), True, drawn).looking
    names = ("stated_read", "dark_level")
    scores = {s.name: s.score(looking.fields) for s in looking.signatures if s.name in names}
    assert scores["dark_level"].log_p < -50
    error, _, doubt = scores["stated_read"].parameters["relative_error"]
    own, simulated = (r**2 + RATE / 2 * 1.0 for r in (READ, read))  # in the shortest dark, of 1 s
    assert abs(error - (np.sqrt(own / simulated) - 1)) < 4 * doubt + 0.01
    assert (scores["stated_read"].log_p < -20) == (read != READ)


@pytest.mark.slow
def test_the_black_level_of_a_simulator_that_is_right_stays():
    """Of one that lacks half of the dark current."""
    given = SensorModel.poisson_gaussian(
        np.full((1, 4), GAIN), np.full((1, 4), READ), np.full((1, 4), BLACK), 16383.0, "MONO", iso=(100.0,)
    ).with_mechanism("dark_current", e_per_s=RATE / 2)
    found = diagnose(series(8), given, jax.random.key(2), compare=False)
    assert [s.named.mechanism for s in found.fitted.steps] == ["dark_current"]
    assert np.asarray(found.model.black_level) == pytest.approx([BLACK] * 4, abs=0.1)
    parts = [f.parameters["e_per_s"] for f in found.model.mechanisms if f.record.id == "dark_current"]
    assert len(parts) == 2 and sum(parts) == pytest.approx(RATE, rel=0.03)
