import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.recordings.packing import (
    PACKED_CHANNELS,
    green_sites,
    pack,
    to_mosaic_order,
    to_packed_order,
    unpack,
)
from cannoise_jax.recordings.recording import CFA_PATTERNS

BAYER = [c for c in CFA_PATTERNS if c != "MONO"]


def colour_names(cfa):
    """The mosaic cell with its greens named by the colour they share a row with."""
    cell = np.array(list(cfa), dtype=object).reshape(2, 2)
    for i in range(2):
        for j in range(2):
            if cell[i, j] == "G":
                cell[i, j] = "G" + cell[i, 1 - j].lower()
    return cell


@pytest.mark.parametrize("cfa", BAYER)
def test_channels_are_red_green_green_blue(cfa):
    names = np.tile(colour_names(cfa), (2, 3))
    assert names.shape == (4, 6)
    packed = pack(names, cfa)
    assert packed.shape == (2, 3, 4)
    for channel, name in enumerate(PACKED_CHANNELS):
        assert (packed[..., channel] == name).all()
    assert tuple(to_packed_order(colour_names(cfa).reshape(4), cfa)) == PACKED_CHANNELS


def test_mono_keeps_the_four_positions_in_order():
    mosaic = np.arange(24).reshape(4, 6)
    packed = pack(mosaic, "MONO")
    for i in range(2):
        for j in range(2):
            np.testing.assert_array_equal(packed[..., 2 * i + j], mosaic[i::2, j::2])


@pytest.mark.parametrize("cfa", CFA_PATTERNS)
@pytest.mark.parametrize("lead", [(), (3,), (2, 3)])
def test_unpack_is_the_exact_inverse_in_numpy_and_jax(cfa, lead):
    mosaic = np.random.default_rng(0).integers(0, 65536, (*lead, 6, 10)).astype(np.uint16)
    packed = pack(mosaic, cfa)
    assert packed.dtype == np.uint16 and packed.shape == (*lead, 3, 5, 4)
    np.testing.assert_array_equal(unpack(packed, cfa), mosaic)
    np.testing.assert_array_equal(pack(unpack(packed, cfa), cfa), packed)
    traced = jax.jit(lambda m: pack(m, cfa))(jnp.asarray(mosaic))
    np.testing.assert_array_equal(traced, packed)
    np.testing.assert_array_equal(jax.jit(lambda p: unpack(p, cfa))(traced), mosaic)


@pytest.mark.parametrize("cfa", CFA_PATTERNS)
def test_per_channel_orders_agree_with_packing(cfa):
    values = np.array([1.0, 2.0, 3.0, 4.0])
    packed = pack(values.reshape(2, 2), cfa)[0, 0]
    np.testing.assert_array_equal(to_packed_order(values, cfa), packed)
    np.testing.assert_array_equal(to_mosaic_order(packed, cfa), values)
    np.testing.assert_array_equal(to_packed_order((1.0, 2.0, 3.0, 4.0), cfa), packed)
    np.testing.assert_array_equal(to_packed_order(jnp.stack([values] * 3), cfa), [packed] * 3)


def test_what_cannot_be_packed_is_refused():
    with pytest.raises(ValueError, match="even"):
        pack(np.zeros((5, 6)), "RGGB")
    with pytest.raises(ValueError, match="even"):
        pack(np.zeros((4, 7)), "MONO")
    with pytest.raises(ValueError, match="unknown CFA 'RGBG'"):
        pack(np.zeros((4, 6)), "RGBG")
    with pytest.raises(
        ValueError, match=r"unknown CFA array\(\[\[0, 1\], \[1, 2\]\]\): use one of RGGB, "
    ) as caught:
        pack(np.zeros((4, 6)), np.array([[0, 1], [1, 2]]))
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="unknown CFA 'rggb': use one of RGGB"):
        green_sites("rggb")
    with pytest.raises(ValueError, match="4 channels"):
        unpack(np.zeros((4, 6, 3)), "RGGB")
    with pytest.raises(ValueError, match=r"cannot unpack an array of shape \(4, 6\): expected packed pixels"):
        unpack(np.zeros((4, 6)), "RGGB")
    for verb in (pack, unpack):
        for value in (None, [[1, 2], [3, 4]]):
            with pytest.raises(TypeError, match=f"cannot {verb.__name__} a {type(value).__name__}: expected"):
                verb(value, "RGGB")
