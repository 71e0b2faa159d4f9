"""A name stays where it accounts for its own part of the mismatch, and goes where it only comes nearest."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.discovery.compare.families import STATIC, STRUCTURE, of
from cannoise_jax.discovery.compare.run import compare_bank
from cannoise_jax.discovery.compare.sources import modelled
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.adequacy import LEFT, beside, doubt, uneven
from cannoise_jax.discovery.proof.claims import empty
from cannoise_jax.discovery.proof.own_part import (
    Borne,
    borne_by,
    most_at,
    most_of,
    overshadowed,
    own_part,
    owned,
    share_of,
)
from cannoise_jax.discovery.proof.shadow import outweighs, shadowed, undrawn
from cannoise_jax.discovery.proof.white_maps import gathered, patterned, ranged
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt, Named
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.off_reference import near_filter
from cannoise_jax.signatures.reference import reference_score
from cannoise_jax.signatures.signature import CONTRASTS, FILES
from cannoise_jax.signatures.signature import STATIC as STATIC_FIELDS
from tests.discovery.capture import capture_set, row_offsets

KEY = jax.random.key(5)
GAIN, READ, BLACK, WHITE, SIGMA = 1.5, 3.0, 200.0, 16383.0, 1.5


def parts_of_rows(rng):
    """Offsets of the first 70 columns of every row, new in every frame."""
    return lambda dn, signal, kind, t: (
        dn + np.where(np.arange(dn.shape[1]) < 70, 1.0, 0.0) * 1.6 * rng.standard_normal((dn.shape[0], 1))
    )


def both(alter):
    """The layer with row noise in the simulator, and without."""
    capture = capture_set(8, alter, kinds="d")
    plain = SensorModel.poisson_gaussian([[GAIN] * 4], [[READ] * 4], (BLACK,) * 4, WHITE, "RGGB")
    with_rows = plain.with_mechanism("row_noise", sigma_dn=SIGMA)
    return [compare_bank(capture, modelled(m, KEY), sets=2, alpha=0.002) for m in (with_rows, plain)]


def test_a_mechanism_that_is_there_is_not_doubted():
    full, less = both(row_offsets(SIGMA))
    part = own_part(borne_by(full, less))
    assert part.before > 500 and part.after < 0.1 * part.before
    assert doubt(full, borne_by(full, less)) is None


def test_one_that_only_resembles_what_is_there_is_doubted_and_why_is_said():
    full, less = both(parts_of_rows)
    found = doubt(full, borne_by(full, less))
    assert found is not None and found.left > LEFT
    assert any("rows" in line for line in found.against)


def tears(rng):
    """One step along each frame at a row of its own: the mean energies of slow noise along rows."""

    def alter(dn, signal, kind, t):
        dn[rng.integers(8, dn.shape[0] - 8) :] += 4 * SIGMA * rng.standard_normal()
        return dn

    return alter


@pytest.mark.parametrize(("alter", "doubted"), [(tears, True), (row_offsets(SIGMA), False)])
def test_steps_in_few_places_are_no_noise_along_rows(alter, doubted):
    full, less = both(alter)
    against = uneven(full, borne_by(full, less))
    assert (against is not None) == doubted
    if against is not None:
        assert any("few places" in line for line in against.against)


def test_what_another_mechanism_bears_on_far_more_speaks_of_that_one():
    judged = SimpleNamespace(family="mean", where="dark", z=np.full(4, 9.0), passing=4.0)

    def moved(before, after):
        before, after = np.array(before, float), np.array(after, float)
        own = np.abs(before - after) > 4
        return Borne(judged, before, after, own, np.zeros(4, bool), np.ones(4))

    weak, strong = moved([900, 60, 9, 80], [850, 2, 9, 30]), moved([9000, 2, 9, 150], [850, 2, 9, 30])
    most = most_of([[weak], [strong]])
    (own,) = owned([weak], most)
    assert own.own.tolist() == [False, True, False, True]  # the first is the other's, the last of both
    (all_of_it,) = owned([strong], most)
    assert all_of_it.own.tolist() == [True, False, False, True]
    (kept,) = owned([weak._replace(claimed=np.ones(4, bool))], most)
    assert kept.own.tolist() == weak.own.tolist()


def test_what_hardly_changes_with_a_mechanism_hardly_speaks_against_it():
    """It explains one statistic wholly; of another, ten times as far off, a seventh."""
    before, after = np.array([100.0, 1000.0]), np.array([0.0, 860.0])
    judged = SimpleNamespace(family=of(STATIC, STRUCTURE), where="dark", z=np.array([0.5, 40.0]), passing=4.0)
    even = Borne(judged, before, after, np.ones(2, bool), np.zeros(2, bool), np.ones(2))
    one, other = own_part([even._replace(weight=share_of(before, after))]), own_part([even])
    assert other.after / other.before > 0.7 and one.after / one.before == pytest.approx(0.5, abs=0.02)
    assert one.number == other.number and one.more and other.more and len(one.left) == len(other.left) == 1


def test_a_withdrawn_name_hands_its_probability_to_the_unknown():
    named = Named(None, None, "row_noise", (("row_noise", 0.9), (UNKNOWN, 0.06), ("banding", 0.04)), True)  # type: ignore[arg-type]
    gone = named.withdrawn(Doubt(0.6, ("rows (frame to frame)",)))
    assert gone.mechanism == gone.candidates[0][0] == UNKNOWN and not gone.ambiguous
    assert dict(gone.candidates) == pytest.approx({UNKNOWN: 0.96, "banding": 0.04, "row_noise": 0.0})
    assert gone.doubt is not None and gone.doubt.nearest == "row_noise"


def per_colour(image, change):
    """A change of every colour plane by itself."""
    out = np.empty_like(image)
    for at in SITES:
        out[at] = change(image[at])
    return out


SHIFTED = partial(ndimage.shift, shift=(0.1, -0.12), order=3, mode="nearest")
SOFT = partial(ndimage.gaussian_filter, sigma=0.35)


@pytest.mark.parametrize(
    ("light", "kind", "fits"),
    [
        (lambda s: per_colour(s, SHIFTED), "shift", True),
        pytest.param(lambda s: per_colour(s, SOFT), "blur", True, marks=pytest.mark.slow),
        (lambda s: 0.98 * s + 0.02 * np.roll(s, 14, 1), "shift", False),
    ],
    ids=["shift", "soft", "ghost"],
)
def test_a_reference_that_is_shifted_or_soft_is_told_from_light_from_further_away(light, kind, fits):
    def alter(rng):
        return lambda dn, signal, what, t: dn + light(signal) - signal if what == "scene" else dn

    capture = capture_set(3, alter, kinds="sd", size=(64, 96))
    fields = prepare(capture, all_frames(split_recordings(capture)), False).fields
    score = reference_score(fields, kind=kind, span=WHITE - BLACK, edge=kind)
    assert score is not None and score.log_p < -20
    plain = modelled(
        SensorModel.poisson_gaussian([[GAIN] * 4], [[READ] * 4], (BLACK,) * 4, WHITE, "RGGB"), KEY
    )
    off = near_filter(fields, score, np.random.default_rng(0))
    full, less = (
        compare_bank(capture, source, sets=2, alpha=0.002)
        for source in (beside(plain, [off], capture), plain)
    )
    scenes = frozenset({"scene"})
    assert (doubt(full, borne_by(full, less, scenes), scenes) is None) == fits


def borne(before, after, where="dark"):
    """Energies of what stays, all of one part."""
    before, after = np.array(before, float), np.array(after, float)
    judged = SimpleNamespace(
        family=of(STATIC, STRUCTURE), where=where, z=np.full(before.size, 9.0), passing=4.0
    )
    return Borne(
        judged, before, after, np.abs(before - after) > 4, np.zeros(before.size, bool), np.ones(before.size)
    )


def test_a_name_that_another_outshines_wherever_it_is_seen_is_not_judged_by_what_is_left():
    weak, strong = borne([20, 12], [9, 8]), borne([1000, 1200], [60, 50])
    largest = most_at([[weak], [strong]])
    assert overshadowed([weak], largest) and not overshadowed([strong], largest)
    # In a recording of its own it is.
    alone = borne([20, 12], [9, 8], "flat")
    assert not overshadowed([weak, alone], most_at([[weak, alone], [strong]]))


def test_a_name_is_not_judged_by_a_little_of_what_another_leaves():
    """A sixth of one statistic changes with it, and the layer holds nothing else of it."""
    before, after = np.array([187.0]), np.array([156.0])
    little = borne(before, after)._replace(weight=share_of(before, after))
    assert not own_part([little]).tells and own_part([borne(before, after)]).tells
    assert doubt(None, [little]) is None
    assert shadowed([little], {}, of_its_own=True) is None
    assert shadowed([little], {}, of_its_own=False) is not None


def test_a_name_in_the_shadow_of_something_unknown_is_none():
    name, other = borne([50, 40, 3], [4, 5, 2]), borne([900, 700, 3], [10, 10, 2])
    unknown = most_of([[other]])
    found = shadowed([name], unknown, of_its_own=True)
    assert found is not None and found.instead and "without a name" in found.against[0]
    # Of its own: elsewhere, or as much as the unknown.
    assert shadowed([name], most_of([[borne([60, 40, 3], [9, 9, 2])]]), of_its_own=True) is None
    assert shadowed([name, borne([90], [2], "flat")], unknown, of_its_own=True) is None
    # It bears on nothing that the layer sees: the frames held back decide.
    nothing = borne([1, 1, 1], [1, 1, 1])
    assert shadowed([nothing], unknown, of_its_own=True) is None
    assert shadowed([nothing], unknown, of_its_own=False) is not None


def test_what_a_recording_shows_that_the_unknown_hardly_moves_is_no_trace_of_it():
    """Offsets of columns in a bias, beside a glow without a name that long darks show."""
    biased, shaded = borne([80, 60, 3], [4, 5, 2], "bias"), borne([30, 9, 3], [14, 5, 2], "long")
    glow = [borne([5000, 4000, 3], [10, 10, 2], "long"), borne([9, 5, 3], [4, 5, 2], "bias")]
    unknown, larger = most_of([glow]), most_at([glow])
    assert shadowed([biased, shaded], unknown, of_its_own=False, larger=larger) is None
    assert shadowed([shaded], unknown, of_its_own=False, larger=larger) is not None


def found(gain, reads, frozen=True):
    signature = SimpleNamespace(reads=reads, frozen=frozen)
    return SimpleNamespace(named=SimpleNamespace(score=SimpleNamespace(gain=gain), signature=signature))


def test_a_name_that_is_never_drawn_needs_more_beside_a_strong_unknown():
    """No draw can be held against it: a black level as stated, a scale of the description."""
    assert undrawn(found(9.0, STATIC_FIELDS), [found(30_000.0, CONTRASTS, False)]) is not None
    assert undrawn(found(9.0, STATIC_FIELDS), [found(50.0, CONTRASTS, False)]) is None
    assert undrawn(found(9.0, STATIC_FIELDS), []) is None
    # Of the codes as they are stored rows say nothing.
    assert undrawn(found(9.0, FILES), [found(30_000.0, CONTRASTS, False)]) is None
    assert undrawn(found(9.0, FILES), [found(30_000.0, FILES, False)]) is not None


def test_what_the_files_hold_as_it_is_may_be_the_trace_of_what_is_found_there():
    curve, ceiling, rows = found(900.0, FILES, False), found(50.0, FILES), found(900.0, CONTRASTS, False)
    assert outweighs(curve, ceiling) and not outweighs(ceiling, curve)
    assert not outweighs(rows, ceiling) and not outweighs(rows, found(50.0, STATIC_FIELDS))
    assert outweighs(found(900.0, STATIC_FIELDS), found(50.0, STATIC_FIELDS))


def step_of(capture, name, mechanism, log_p):
    """The finding of one signature in all frames, surer than log_p, under a name."""
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    signature = next(s for s in prepared.signatures if s.name == name)
    score = signature.score(prepared.fields)
    assert score is not None and score.log_p < log_p
    return Step(Named(score, signature, mechanism, ((mechanism, 1.0),), False), prepared.fields, score.log_p)


def response(pattern):
    """Flats whose light meets a fixed map of gains."""
    return lambda rng: lambda dn, signal, kind, t: dn + (signal * pattern if kind == "flat" else 0)


@pytest.mark.parametrize(
    "texture",
    [
        "white",
        pytest.param("blurred", marks=pytest.mark.slow),
        "fringes",
        pytest.param("rings and white", marks=pytest.mark.slow),
        pytest.param("white and some fringes", marks=pytest.mark.slow),
    ],
)
def test_a_gain_map_of_fringes_is_no_map_of_single_pixels(texture):
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:96, :128]
    white, fringes = rng.standard_normal((96, 128)), np.sqrt(2) * np.sin(x / 2.3 + y / 7.0)
    # As of a wafer whose middle lies beside the frame: a period of 4 pixels, which no block of two has.
    rings = np.sqrt(2) * np.sin(np.hypot(x + 40, y - 200) * np.pi / 2)
    pattern = {
        "white": white,
        "blurred": ndimage.convolve(white, [[0, 0.05, 0], [0.05, 0.8, 0.05], [0, 0.05, 0]], mode="wrap"),
        "fringes": fringes,
        "rings and white": 0.82 * rings + 0.57 * white,
        "white and some fringes": 0.9 * white + 0.4 * fringes,
    }[texture]
    capture = capture_set(4, response(0.02 * pattern), kinds="df")
    against = patterned(step_of(capture, "pixel_relative_static", "prnu", -50))
    structured = {"fringes": 1.0, "rings and white": 0.67}
    assert (against is not None) == (texture in structured)
    if against is not None:
        assert against.left == pytest.approx(structured[texture], abs=0.1) and "px" in against.against[0]


@pytest.mark.parametrize("of", ["halves", pytest.param("halves and white", marks=pytest.mark.slow), "white"])
def test_gains_of_the_columns_of_each_half_are_no_map_of_single_pixels(of):
    """Read from both ends, a column has two amplifiers, which differ by what their mean leaves."""
    rng = np.random.default_rng(5)
    halves, white = np.repeat(rng.standard_normal((2, 128)), 48, 0), rng.standard_normal((96, 128))
    pattern = {"halves": halves, "halves and white": halves + 0.5 * white, "white": white}[of]
    shared = 0.5 * rng.standard_normal(128)  # what whole columns have
    capture = capture_set(4, response(0.02 * (pattern + shared)), kinds="df")
    step, columns = (
        step_of(capture, f"{name}_relative_static", mechanism, -50)
        for name, mechanism in (("pixel", "prnu"), ("column", "column_gain"))
    )
    rest = columns.named.signature.absorb(step.before, columns.named.score)
    score = step.named.signature.score(rest)
    assert score is not None and score.log_p < -50
    against = patterned(step._replace(named=step.named._replace(score=score), before=rest))
    assert (against is not None) == (of != "white")
    if of == "halves":  # an eighth of the pairs lie in both; of 128 columns some are alike by chance
        assert against.left == pytest.approx(0.78, abs=0.1) and "parts of columns" in against.against[0]


def test_an_offset_map_that_repeats_is_no_map_of_single_pixels():
    y, x = np.mgrid[:96, :128]
    checks = np.sign(np.sin(2 * np.pi * y / 7.3)) * np.sign(np.sin(2 * np.pi * x / 11.1))
    white = 0.4 * np.random.default_rng(2).standard_normal(checks.shape)
    capture = capture_set(4, lambda rng: lambda dn, *_: dn + checks + white, kinds="d")
    against = patterned(step_of(capture, "pixel_additive_static", "dsnu", -50))
    assert against is not None and against.left > 0.25 and "repeats" in against.against[0]


@pytest.mark.parametrize("where", [pytest.param("anywhere", marks=pytest.mark.slow), "edge columns"])
def test_pixels_that_lie_in_few_columns_are_no_single_pixels(where):
    rng = np.random.default_rng(6)
    chosen = rng.random((96, 128)) < 0.02 if where == "anywhere" else np.arange(128) < 3

    def jumps(rng):
        return lambda dn, signal, kind, t: dn + 30 * chosen * (rng.random(dn.shape) < 0.5)

    capture = capture_set(4, jumps, kinds="d", frames=10)
    against = gathered(step_of(capture, "telegraph", "rts", -50))
    assert (against is not None) == (where == "edge columns")
    if against is not None:
        assert "columns" in against.against[0]


@pytest.mark.parametrize("map_of", ["single pixels", "a gradient"])
def test_noise_that_grows_over_the_frame_is_no_noise_of_single_pixels(map_of):
    rng = np.random.default_rng(8)
    single = np.exp(0.3 * rng.standard_normal((96, 128)))
    factor = single if map_of == "single pixels" else np.broadcast_to(np.linspace(0.6, 1.4, 128), (96, 128))

    def alter(rng):
        return lambda dn, signal, kind, t: BLACK + (dn - BLACK) * factor

    capture = capture_set(4, alter, kinds="d", frames=10)
    against = patterned(step_of(capture, "pixel_spread", "pixel_read_noise_map", -20))
    assert (against is not None) == (map_of == "a gradient")


@pytest.mark.parametrize(
    "columns",
    [
        "single",
        pytest.param("a few single", marks=pytest.mark.slow),
        "an edge",
        pytest.param("a wave", marks=pytest.mark.slow),
        pytest.param("one place", marks=pytest.mark.slow),
    ],
)
def test_columns_that_are_like_their_neighbours_are_no_single_columns(columns):
    rng, at = np.random.default_rng(4), np.arange(128)
    pattern = {
        "single": 0.005 * rng.standard_normal(128),
        "a few single": 0.02 * np.isin(at, rng.choice(128, 4, False)),
        "an edge": -0.02 * (at < 7),
        "one place": 0.02 * rng.standard_normal(128) * ((at > 40) & (at < 52)),
        "a wave": 0.005 * np.sin(at / 2.3),
    }[columns]
    capture = capture_set(4, response(pattern), kinds="df")
    against = ranged(step_of(capture, "column_relative_static", "column_gain", -20))
    assert (against is not None) == (columns in ("an edge", "a wave", "one place"))
    if against is not None:
        assert "neighbouring columns" in against.against[0]


def rare_steps(height):
    """One value in two hundred is too high, by as many DN in every exposure."""
    return lambda rng: lambda dn, signal, kind, t: dn + height * (rng.random(dn.shape) < 0.005)


def test_charge_of_the_clocking_whose_draws_leave_all_that_stands_out_is_none():
    capture = capture_set(5, rare_steps(32), kinds="d", frames=10)
    step = step_of(capture, "clocking", "clock_induced_charge", -50)
    plain = SensorModel.poisson_gaussian([[GAIN] * 4], [[READ] * 4], (BLACK,) * 4, WHITE, "RGGB")
    one = plain.with_mechanism("clock_induced_charge", charge_e=step.named.score.amplitude)
    full, less = (compare_bank(capture, modelled(m, KEY), sets=2, alpha=0.002) for m in (one, plain))
    found = empty(full, borne_by(full, less), step)
    assert found is not None and found.left == 1.0 and any("one frame" in line for line in found.against)
    # Where nothing differs, or the draws move it, nothing speaks against it.
    clean = compare_bank(capture_set(5, kinds="d", frames=10), modelled(plain, KEY), sets=2, alpha=0.002)
    assert empty(clean, borne_by(clean, clean), step) is None
    assert empty(full, [borne([90], [2])], step) is None


def test_what_rare_values_lift_the_darks_by_is_no_black_level():
    capture = capture_set(5, rare_steps(32), kinds="d", frames=10, black=200.37)
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    black, spikes = (
        next(s for s in prepared.signatures if s.name == name) for name in ("black_level", "clocking")
    )
    first, found = black.score(prepared.fields), spikes.score(prepared.fields)
    assert first is not None and found is not None and first.gain > 20
    left = black.score(spikes.absorb(prepared.fields, found))
    assert left is not None and left.gain < 3
    # Pixels that stand out for good are none of the level either.
    hot = capture_set(5, lambda rng: lambda dn, *_: dn + 50 * (np.arange(128) == 9), kinds="d", black=200.37)
    score = black.score(prepare(hot, all_frames(split_recordings(hot)), False).fields)
    assert score is not None and score.gain < 5
