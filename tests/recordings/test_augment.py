import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.recordings.augment import crop_packed, mirror_mosaic, mirror_packed
from cannoise_jax.recordings.packing import pack, unpack
from cannoise_jax.recordings.recording import CFA_PATTERNS, mosaic_map

SITES = {cfa: np.array([100.0 * "RGBMONO".index(c) for c in cfa]) for cfa in CFA_PATTERNS if cfa != "MONO"}


def colours(cfa, size):
    """The colour number of every pixel."""
    return mosaic_map(SITES[cfa], size)


@pytest.mark.parametrize("cfa", SITES)
def test_a_mirrored_mosaic_keeps_its_colour_order_and_mirrors_places(cfa):
    columns = np.broadcast_to(np.arange(10.0), (6, 10))
    mosaic = colours(cfa, (6, 10)) + columns  # the colour in the hundreds, the column in the units
    mirrored = mirror_mosaic(mosaic)
    np.testing.assert_array_equal(mirrored // 100 * 100, colours(cfa, (6, 8)))
    np.testing.assert_array_equal(mirrored % 100, columns[:, 8:0:-1])


@pytest.mark.parametrize("cfa", CFA_PATTERNS)
def test_packing_and_mirroring_commute(cfa):
    mosaic = np.random.default_rng(0).integers(0, 65535, (3, 8, 12)).astype(np.uint16)
    mirrored = mirror_packed(pack(mosaic, cfa), cfa)
    np.testing.assert_array_equal(mirrored, pack(mirror_mosaic(mosaic), cfa))
    np.testing.assert_array_equal(unpack(mirrored, cfa), mirror_mosaic(mosaic))
    again = jax.jit(mirror_packed, static_argnums=1)(jnp.asarray(pack(mosaic, cfa)), cfa)
    np.testing.assert_array_equal(again, mirrored)


@pytest.mark.parametrize("cfa", CFA_PATTERNS)
def test_mirroring_twice_is_a_crop(cfa):
    packed = pack(np.random.default_rng(2).random((8, 12)), cfa)
    np.testing.assert_array_equal(mirror_packed(mirror_packed(packed, cfa), cfa), packed[:, 1:-1])


def test_windows():
    packed = np.random.default_rng(3).random((2, 10, 12, 4))
    np.testing.assert_array_equal(crop_packed(packed, 2, 3, (4, 5), False, "BGGR"), packed[:, 2:6, 3:8])
    np.testing.assert_array_equal(
        crop_packed(packed, 2, 3, (4, 5), True, "BGGR"), mirror_packed(packed[:, 2:6, 3:9], "BGGR")
    )
    assert crop_packed(packed, 6, 6, (4, 5), True, "BGGR").shape == (2, 4, 5, 4)
    for top, left, mirrored in ((7, 0, False), (0, 8, False), (0, 7, True), (-1, 0, False)):
        with pytest.raises(ValueError, match="leaves"):
            crop_packed(packed, top, left, (4, 5), mirrored, "BGGR")
