"""Forward selection: both of two effects are found, and p-values are those of the final model."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.discovery.search.maps import beside_others
from cannoise_jax.signatures import groups
from cannoise_jax.signatures.fields import Fields, helmert, refit
from cannoise_jax.signatures.score import sidak
from tests.discovery.capture import SIZE as FRAME
from tests.discovery.capture import capture_set, row_offsets
from tests.discovery.looks import SIGNATURES

SIZE = (64, 96)
KIN = ("tile", "diagonal", "antidiagonal", "site", "row", "column", "frame", "pixel", "scene")
LOOKED_FOR = tuple(s for s in SIGNATURES.values() if s.name.startswith(KIN) and "slope" not in s.name)
ALLOWED = frozenset({"row_noise", "column_noise", "row_fpn", "column_fpn", "dsnu"})


def dark(rng, number, tiles=0.0, columns=0.0, frames=6):
    """A dark of unit noise with offsets of tiles and of columns, both new in every frame."""
    tile = groups.layout("tile_16", SIZE).of
    values = rng.standard_normal((frames, *SIZE)) + columns * rng.standard_normal((frames, 1, SIZE[1]))
    values += tiles * rng.standard_normal((frames, tile.max() + 1))[:, tile]
    one = np.ones(SIZE, np.float32)
    contrasts = np.einsum("nt,tij->nij", helmert(frames), values).astype(np.float32)
    static = (values.mean(0) * np.sqrt(frames)).astype(np.float32)
    return Fields(
        "d", "dark", frames, number, 0, 1.0, 0.1, one, 0 * one, one, 0 * one, one > 0,
        contrasts, static, None, np.ones(4), np.zeros(4),
    )  # fmt: skip


@pytest.fixture(scope="module")
def fitted():
    rng = np.random.default_rng(4)
    fields = refit(tuple(dark(rng, n, 0.25, 0.3) for n in range(3)))
    return stepwise(fields, LOOKED_FOR, ALLOWED, float(np.log(0.01)))


def test_both_effects_are_found_and_nothing_else(fitted):
    assert {s.named.signature.name for s in fitted.steps} == {"tile_16_redrawn", "column_additive_temporal"}
    assert {s.named.mechanism for s in fitted.steps} == {"unknown", "column_noise"}


def test_p_of_the_first_is_taken_with_the_second_in_the_model(fitted):
    first, second = fitted.steps
    without = refit(second.named.signature.absorb(first.before, second.named.score), first.before)
    expected = sidak(first.named.signature.score(without).log_p, fitted.first.tests)
    assert first.log_p == pytest.approx(expected)
    assert first.log_p != pytest.approx(sidak(first.named.score.log_p, fitted.first.tests))
    assert second.log_p == pytest.approx(sidak(second.named.score.log_p, fitted.first.tests))


def test_nothing_is_found_where_there_is_nothing():
    rng = np.random.default_rng(5)
    found = [
        stepwise(tuple(dark(rng, n) for n in range(2)), LOOKED_FOR, ALLOWED, float(np.log(0.01))).steps
        for _ in range(15)
    ]
    assert sum(map(bool, found)) <= 2  # 0.15 expected: more than 2 has probability 4e-4


def test_what_the_final_model_does_not_need_is_given_up_again():
    """Row noise of two frames shows in their mean first; beside it in the model nothing is left to stay."""
    capture = capture_set(70, row_offsets(1.5), kinds="df", frames=2)
    prepared = prepare_split(capture, split_recordings(capture))
    signatures = tuple(p for p in prepared.signatures if p.name.startswith("row_"))
    said = []
    found = stepwise(
        prepared.fields,
        signatures,
        frozenset({"row_fpn", "row_noise"}),
        float(np.log(0.01)),
        tell=said.append,
    )
    assert [s.named.mechanism for s in found.steps] == ["row_noise"]
    assert any(text.startswith("given up: row_fpn") for text in said)
    assert all(s.log_p < np.log(0.01) for s in found.steps)


def two_looks(rng, columns):
    """The frames that look, and all frames, of two darks with the same columns' offsets in every look."""
    sizes = (4, 16)
    return (tuple(dark(rng, n, columns=columns, frames=f) for n in range(2)) for f in sizes)


def test_a_second_look_sees_what_the_first_suspects_and_charges_its_share():
    late = 0
    for seed in range(12):
        looked, together = two_looks(np.random.default_rng(seed), 0.05)
        found = stepwise(
            looked, LOOKED_FOR, ALLOWED, float(np.log(0.01)), every=lambda together=together: together
        )
        for step in found.steps:
            assert step.named.mechanism in ("column_noise", "column_fpn")  # their mean shows some of it, too
            assert step.log_p < np.log(0.01)
            if step.late:
                late += 1
                assert step.named.score == found.first.scores[step.named.signature.name]
                assert np.log(0.006) < found.first.log_p[step.named.signature.name] < 0
                alone = sidak(step.named.signature.score(together).log_p, found.first.tests)
                assert step.log_p == pytest.approx(alone - np.log(0.4))
    assert late >= 3


@pytest.mark.slow
def test_two_looks_find_nothing_where_there_is_nothing():
    found = []
    for seed in range(40):
        looked, together = two_looks(np.random.default_rng(100 + seed), 0.0)
        every = lambda together=together: together  # noqa: E731
        found.append(stepwise(looked, LOOKED_FOR, ALLOWED, float(np.log(0.01)), every=every).steps)
    assert sum(map(bool, found)) <= 3  # 0.4 expected: more than 3 has probability 1e-3


def test_a_wave_fitted_anew_is_not_taken_for_rows_that_wander():
    """Found beside the noise of rows, it is fitted in fields that hold that noise again."""
    wave = SIGNATURES["wave_redrawn"]
    rng, (y, x) = np.random.default_rng(6), np.indices(SIZE)

    def lines(f, law):
        values = np.array([law() for _ in range(f.frames)], np.float32)
        contrasts = np.einsum("nt,tij->nij", helmert(f.frames), values).astype(np.float32)
        return f._replace(contrasts=f.contrasts + contrasts)

    def weak():
        return 0.06 * np.cos(2 * np.pi * (0.21 * y + 0.37 * x + rng.random()))

    def wandering():
        return np.repeat(0.2 * np.cumsum(rng.standard_normal(SIZE[0]))[:, None], SIZE[1], 1)

    alone = refit(tuple(lines(dark(rng, n), weak) for n in range(3)))
    beside = refit(tuple(lines(f, wandering) for f in alone))
    found, elsewhere = wave.score(alone), wave.score(beside)
    assert found.log_p < np.log(0.01) and abs(found.payload.fy - 0.21) < 0.01
    assert elsewhere.log_p < found.log_p and not elsewhere.same_spot(found)
    assert wave.refitted(beside, found).same_spot(found)
    assert wave.refitted(alone, found) == found


def test_maps_have_their_strengths_beside_frames_that_drift_by_as_much_as_pixels_are_noisy():
    """Maps are told by the noise of pixels, which drift is no part of, whichever is found first."""

    def alter(rng):
        offsets, response = 6.0 * rng.standard_normal(FRAME), 0.01 * rng.standard_normal(FRAME)
        return lambda dn, signal, kind, t: dn + offsets + signal * response + 3.0 * rng.standard_normal()

    capture = capture_set(72, alter, kinds="df", read=1.7, frames=8)
    prepared = prepare_split(capture, split_recordings(capture))
    names = ("pixel_additive_static", "pixel_relative_static", "frame_additive")
    found = stepwise(
        prepared.fields,
        tuple(s for s in prepared.signatures if s.name in names),
        frozenset({"dsnu", "prnu", "offset_drift"}),
        float(np.log(0.01)),
    )
    told = {s.named.signature.name: s.named.score for s in beside_others(found.steps)}
    assert set(told) == set(names)
    assert told["pixel_additive_static"].amplitude == pytest.approx(6.0, rel=0.02)
    assert told["pixel_relative_static"].amplitude == pytest.approx(0.01, rel=0.02)
