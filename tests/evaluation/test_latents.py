"""Maps of latents: t-SNE against what defines it, and the count of nearest neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.evaluation.tsne import neighbour_shares, same_among_nearest, tsne


def blobs(distance: float, each: int = 25, groups: int = 4):
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(groups), each)
    return distance * rng.normal(size=(groups, 8))[group] + rng.normal(size=(len(group), 8)), group


def test_weights_of_neighbours_have_the_perplexity_that_was_asked_for():
    points, _ = blobs(3.0)
    shares = neighbour_shares(points, 12.0)
    np.testing.assert_allclose(shares.sum(1), 1)
    assert np.all(np.diag(shares) == 0)
    entropy = -(shares * np.log(np.maximum(shares, 1e-300))).sum(1)
    np.testing.assert_allclose(np.exp(entropy), 12.0, rtol=1e-4)


def test_groups_that_lie_apart_stay_apart_in_the_plane():
    points, group = blobs(8.0)
    place = tsne(points)
    assert place.shape == (100, 2) and np.isfinite(place).all()
    assert same_among_nearest(place, group).mean() > 0.98
    np.testing.assert_array_equal(place, tsne(points))


def test_points_without_groups_have_neighbours_by_chance():
    points, group = blobs(0.0, each=60)
    # Three of the four groups' points are others': 59 of 239.
    assert same_among_nearest(points, group).mean() == pytest.approx(59 / 239, abs=0.06)
    assert same_among_nearest(points, np.zeros(len(points), int)).min() == 1
