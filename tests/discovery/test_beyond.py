"""Effects beyond the core: a clean camera shows none, each is found by its own statistic."""

import numpy as np
import pytest

from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.signatures import events, gain_curve
from cannoise_jax.signatures.handed import Found
from cannoise_jax.signatures.score import Score
from tests.discovery.beyond_camera import BEYOND, SIZE, frames_of, rejects, scores
from tests.discovery.looks import SIGNATURES


def test_clean_cameras_show_none_of_them():
    for seed in (1, 2):
        found, _, _ = scores(frames_of(seed))
        assert not [n for n, s in found.items() if rejects(s)]


def test_tails_on_both_sides_and_telegraph_pixels_are_no_spikes():
    def tails(e, rng, kind, seconds):
        return e + 2 * rng.standard_t(3, e.shape)

    place = np.random.default_rng(0).random(SIZE) < 0.01

    def telegraph(e, rng, kind, seconds):
        return e + place * 60 * (rng.random(e.shape) < 0.15)

    for change in (tails, telegraph):
        found, _, _ = scores(frames_of(3, charge=change, scenes=0))
        assert not rejects(found["hits"]) and not rejects(found["clocking"])


def _tracks(e, rng, kind, seconds):
    for frame in e:
        for _ in range(rng.poisson(0.4 * seconds)):
            y, x = rng.integers(4, SIZE[0] - 4), rng.integers(4, SIZE[1] - 4)
            frame[y, x : x + rng.integers(2, 5)] += 300
    return e


def test_tracks_are_hits_with_their_rate_and_are_taken_out():
    found, fields, signatures = scores(frames_of(4, charge=_tracks, scenes=0))
    hits = found["hits"]
    assert rejects(hits) and not rejects(found["clocking"])
    rate = 0.4 / (SIZE[0] * SIZE[1] / 1e6)
    assert abs(hits.amplitude - rate) < 4 * hits.error + 0.1 * rate
    left = signatures["hits"].score(signatures["hits"].absorb(fields, hits))
    assert not rejects(left)
    assert events.find(fields)[2].up.sum() > 0


def test_single_spikes_as_often_in_short_darks_are_of_the_clocking():
    found, _, _ = scores(
        frames_of(5, charge=lambda e, rng, kind, s: e + 80 * (rng.random(e.shape) < 5e-4), scenes=0)
    )
    assert rejects(found["clocking"]) and not rejects(found["hits"])


def test_dead_pixels_with_their_share_and_place():
    dead = np.random.default_rng(1).random(SIZE) < 2e-3
    found, _, _ = scores(frames_of(6, mean=lambda e, rng, kind, s: np.where(dead, 0, e)))
    assert rejects(found["dead"]) and np.isclose(found["dead"].amplitude, dead.mean(), rtol=0.1)
    assert all(dead[tuple(at)] for at in found["dead"].where["index"])


@pytest.mark.parametrize(
    "place",
    [
        pytest.param(np.s_[:, 41], marks=pytest.mark.slow),
        pytest.param(np.s_[30:, 41], marks=pytest.mark.slow),
        np.s_[17:19, :],
    ],
)
def test_dead_lines_are_dead_pixels_and_edges_of_scenes_are_not(place):
    dead = np.zeros(SIZE, bool)
    dead[place] = True

    def mean(e, rng, kind, s):
        return np.where(dead, 0, e)

    found, _, _ = scores(frames_of(6, mean=mean, scenes=0))
    assert rejects(found["dead"]) and np.isclose(found["dead"].amplitude, dead.mean(), rtol=0.05)
    wide, _, _ = scores(frames_of(6, mean=lambda e, rng, kind, s: np.where(near(dead), 0, e), scenes=0))
    scene, _, _ = scores(frames_of(6, mean=mean))
    assert wide["dead"].where["pixels"] < 8 and scene["dead"].where["pixels"] < 8  # corners of lines


def near(lines):
    """Three lines for each."""
    return lines | np.roll(lines, 1, (0, 1)) | np.roll(lines, 2, (0, 1))


def test_pixels_painted_over_are_found_with_the_neighbours_they_were_made_of():
    listed = np.random.default_rng(2).random(SIZE) < 0.01

    def paint(code, rng, kind, seconds):
        return np.where(listed, (np.roll(code, 2, -1) + np.roll(code, -2, -1)) / 2, code)

    found, _, _ = scores(frames_of(7, code=paint, scenes=0))
    assert rejects(found["corrected"]) and found["corrected"].where["from"] == "row"
    assert abs(found["corrected"].amplitude - listed.mean()) < 0.2 * listed.mean()
    assert not rejects(found["lattice"]) and not rejects(found["peaks"])


def test_clamped_peaks_are_told_from_pits():
    from scipy import ndimage

    near = np.zeros((1, 5, 5), bool)
    near[0, ::2, ::2] = True
    near[0, 2, 2] = False

    def clamp(code, rng, kind, seconds):
        return np.minimum(code, ndimage.maximum_filter(code, footprint=near))

    found, _, _ = scores(frames_of(8, code=clamp, scenes=0))
    assert rejects(found["peaks"]) and found["peaks"].amplitude > 0.7


@pytest.mark.parametrize("kept", [pytest.param(0.03, marks=pytest.mark.slow), 0.1])
def test_charge_left_behind_has_its_share(kept):
    def lag(e, rng, kind, seconds):
        before = np.concatenate([np.zeros_like(e[:1]), e[:-1]])
        return e + kept * (before - e)

    found, _, _ = scores(frames_of(9, charge=lag))
    score = found["lag_in_time"]
    assert rejects(score) and abs(score.amplitude - kept) < 5 * score.error + 0.1 * kept


def test_a_lamp_that_drifts_leaves_no_charge_behind():
    def lamp(e, rng, kind, seconds):
        return e * (1 + 0.01 * np.cumsum(rng.standard_normal((len(e), 1, 1)), 0))

    found, _, _ = scores(frames_of(10, charge=lamp))
    assert not rejects(found["lag_in_time"]) and not rejects(found["excess_skewness"])


def test_a_bent_curve_is_no_step_of_the_gain_and_a_step_is():
    x = np.linspace(50, 10000, 24)
    noise = 1 + 0.01 * np.random.default_rng(3).standard_normal(x.size)
    error = 0.014 * (2 * x + 30)
    bent = gain_curve.two_lines(x, (2 * x + 30 - 2e-5 * x**2) * noise, error)
    step = gain_curve.two_lines(x, np.where(x < 3000, 2 * x + 30, 6030 + (x - 3000)) * noise, error)
    assert min(bent.one, bent.bent) - bent.two < 15 < min(step.one, step.bent) - step.two
    assert 2000 < step.at < 4000 and abs(step.ratio - 0.5) < 0.1


def test_codes_that_thin_out_with_the_signal_and_noise_of_the_gain():
    def compress(code, rng, kind, seconds):
        signal = np.sign(code - 400) * np.sqrt(np.abs(code - 400))
        level = np.round(signal * 10.0) / 10.0
        return 400 + level * np.abs(level)

    found, _, _ = scores(frames_of(11, code=compress, scenes=0))
    assert rejects(found["code_spacing"])
    assert abs(found["code_spacing"].parameters["exponent"][0] - 0.5) < 0.2

    def multiply(e, rng, kind, seconds):
        return np.where(e > 0, rng.gamma(np.maximum(e, 1e-9), 1.0), 0.0)

    found, _, _ = scores(frames_of(12, charge=multiply, scenes=0))
    assert rejects(found["excess_skewness"]) and not rejects(found["code_spacing"])
    assert abs(found["excess_skewness"].amplitude - 1) < 4 * found["excess_skewness"].error


def test_warm_frames_follow_the_map_of_the_dark_current():
    own = 20 * np.exp(0.5 * np.random.default_rng(4).standard_normal(SIZE))

    def current(kelvin):
        def add(e, rng, kind, seconds):
            return e + seconds * own * 2 ** (kelvin * rng.standard_normal((len(e), 1, 1)) / 6.3)

        return add

    warm, _, _ = scores(frames_of(13, mean=current(1.0), scenes=0))
    even, _, _ = scores(frames_of(13, mean=current(0.0), scenes=0))
    assert rejects(warm["warm"]) and 0.3 < warm["warm"].amplitude < 2
    assert not rejects(even["warm"])


def test_smear_and_motion_follow_the_scene():
    found, _, _ = scores(frames_of(14, charge=lambda e, rng, kind, s: e + 0.01 * e.mean(-2, keepdims=True)))
    assert rejects(found["smear"]) and abs(found["smear"].amplitude - 0.01) < 0.002

    def move(e, rng, kind, seconds):
        if kind != "scene":
            return e
        return np.stack([a + 0.1 * t * (np.roll(a, 1, 0) - a) for t, a in enumerate(e)])

    found, _, _ = scores(frames_of(15, mean=move))
    assert rejects(found["moving"]) and abs(found["moving"].amplitude - 0.1) < 0.06


def test_an_interpolated_lattice_is_told_from_blending_of_every_pixel():
    rows, columns = np.indices(SIZE)
    chess = (rows // 2 + columns // 2) % 2 == 1

    def near(code):
        return sum(np.roll(code, s, a) for s in (-2, 2) for a in (-2, -1)) / 4

    some, _, _ = scores(frames_of(16, code=lambda c, r, k, s: c + 0.5 * chess * (near(c) - c), scenes=0))
    every, _, _ = scores(frames_of(16, code=lambda c, r, k, s: c + 0.3 * (near(c) - c), scenes=0))
    assert rejects(some["lattice"]) and some["lattice"].where["lattice"] == "chess"
    assert not rejects(every["lattice"])


def test_every_finding_of_the_camera_has_a_place_in_its_model():
    given = ("charge_e", "exponent", "read_ratio", "iso_switch", "current")
    values = dict.fromkeys(given, (1.0, "1", 0.1))
    score = Score(
        log_p=0.0,
        gain=0.0,
        penalty=0.0,
        amplitude=0.5,
        error=0.1,
        shift=0.1,
        power=1,
        parameters=values,
        where={"axis": "row"},
    )
    for name in BEYOND:
        signature = SIGNATURES[name]
        found = Found(signature.mechanism, score, (), None, 1.0, 1.0, 1.0, 0.0, 1.0, SIZE)
        addition = signature.simulate(found)
        # A switch at a signal is not in the camera model, a scene that moves is not the camera's.
        assert (addition is None) == (name in ("signal_step", "moving"))
        if addition is not None:
            known = {p.name for p in MECHANISMS[signature.mechanism].record.parameters}
            assert addition.values and set(addition.values) <= known
