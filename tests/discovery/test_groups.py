"""Layouts without a name: found where they are, silent where they are not, gone once taken out."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.battery import prepare_split, split_recordings
from cannoise_jax.discovery.fields import Fields, helmert, refit
from cannoise_jax.discovery.statistics import groups
from tests.discovery.capture import capture_set, row_offsets

SIZE = (64, 96)


def field(rng, frames=4, offsets=None, number=0):
    """A dark of unit noise, plus offsets [frames, h, w]."""
    values = rng.standard_normal((frames, *SIZE)) + (0 if offsets is None else offsets)
    one = np.ones(SIZE, np.float32)
    return Fields(
        "d", "dark", frames, number, 0, 1.0, 0.1, one, 0 * one, one, 0 * one, one > 0,
        np.einsum("nt,tij->nij", helmert(frames), values).astype(np.float32),
        (values.mean(0) * np.sqrt(frames)).astype(np.float32), None, np.ones(4), np.zeros(4),
    )  # fmt: skip


def log_p(fields, name, time):
    return groups.group_score(fields, probe=name, name=name, time=time).log_p


@pytest.mark.parametrize("name", groups.LAYOUTS)
def test_p_is_uniform_without_an_effect(name):
    rng = np.random.default_rng(0)
    p = np.exp([log_p((field(rng), field(rng)), name, "redrawn") for _ in range(200)])
    for level in (0.5, 0.1):
        assert np.mean(p < level) == pytest.approx(level, abs=3.5 * np.sqrt(level / 200))


@pytest.mark.parametrize("name", groups.LAYOUTS)
def test_an_offset_new_in_every_frame_is_found_and_taken_out(name):
    rng = np.random.default_rng(1)
    layout = groups.layout(name, SIZE)
    draws = rng.standard_normal((6, layout.max() + 1))
    draws -= draws.mean(1, keepdims=True)
    sigma = 0.6
    fields = (field(rng, 6, sigma * draws[:, layout]),)
    score = groups.group_score(fields, probe=name, name=name, time="redrawn")
    assert score.log_p < np.log(1e-4)
    drawn = sigma * np.sqrt(np.mean(draws**2) * (layout.max() + 1) / layout.max())
    assert abs(score.amplitude - drawn) < 3 * score.error
    after = groups.group_absorb(fields, score, name=name, time="redrawn")
    assert log_p(after, name, "redrawn") > np.log(1e-3)
    assert after[0].contrasts.std() == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("name", ["tile_8", "diagonal"])
def test_an_offset_that_stays_is_not_taken_for_one_that_is_redrawn(name):
    rng = np.random.default_rng(2)
    layout = groups.layout(name, SIZE)
    pattern = 0.3 * rng.standard_normal(layout.max() + 1)[layout]
    fields = tuple(field(rng, 4, pattern, n) for n in range(2))
    assert log_p(fields, name, "redrawn") > np.log(1e-3)
    score = groups.group_score(fields, probe=name, name=name, time="frozen")
    assert score.log_p < np.log(1e-6)
    after = groups.group_absorb(fields, score, name=name, time="frozen")
    assert log_p(after, name, "frozen") > np.log(1e-3)


def tile_offsets(sigma):
    """An offset of every 16 x 16 pixels, new in every frame."""

    def alter(rng):
        def change(dn, signal, kind, exposure):
            h, w = dn.shape
            cells = sigma * rng.standard_normal((-(-h // 16), -(-w // 16)))
            return dn + np.kron(cells, np.ones((16, 16)))[:h, :w]

        return change

    return alter


@pytest.mark.parametrize("name", ["row_additive_temporal", "row_slope", "tile_16_redrawn"])
def test_what_is_left_of_strong_offsets_is_white(name):
    """The modelled noise holds strong offsets too: once out, no line or tile stands above its pixels."""
    alter = tile_offsets(2.0) if name.startswith("tile") else row_offsets(2.0)
    capture = capture_set(57, alter, kinds="df")
    prepared = prepare_split(capture, split_recordings(capture))
    probes = {p.name: p for p in prepared.probes}
    fields = prepared.fields
    score = probes[name].score(fields)
    if name == "row_slope":  # flat, as white offsets are, but of the strength that the probe of lines finds
        strength = probes["row_additive_temporal"].score(fields).payload
        score = score._replace(payload=(strength, 0.0))
    left = refit(probes[name].absorb(fields, score))
    again = probes["tile_16_redrawn" if name.startswith("tile") else "row_additive_temporal"].score(left)
    assert again.log_p > np.log(0.01)
