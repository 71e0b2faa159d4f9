"""Random bits for the samplers: Threefry-2x32 with 20 rounds, written out so that XLA fuses it with its use.

It is the generator behind `jax.random` (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011).
On a CPU, JAX runs its rounds as a loop over whole arrays in memory. Written out, every pixel goes through all
rounds in registers and its number is used at once: several times faster, the same quality.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, UInt32

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)
"""Bits that rounds turn by, and the word that extends the key, of Threefry-2x32
(Salmon, Moraes, Dror & Shaw, Parallel random numbers: as easy as 1, 2, 3, SC 2011)."""
_DOMAIN = np.uint32(0x63616E6E)
"""High word of every counter: `jax.random` counts there from zero, so that no draw repeats one of its."""


def threefry(keys: tuple[Array, Array], x0: Array, x1: Array) -> tuple[Array, Array]:
    """Two words of Threefry-2x32-20 for the counter (x0, x1)."""
    schedule = (keys[0], keys[1], keys[0] ^ keys[1] ^ _PARITY)
    x0, x1 = x0 + schedule[0], x1 + schedule[1]
    for block in range(5):
        for turn in _ROTATIONS[block % 2]:
            x0 = x0 + x1
            x1 = ((x1 << np.uint32(turn)) | (x1 >> np.uint32(32 - turn))) ^ x0
        x0 = x0 + schedule[(block + 1) % 3]
        x1 = x1 + schedule[(block + 2) % 3] + np.uint32(block + 1)
    return x0, x1


@partial(jax.jit, static_argnums=1, inline=True)
def random_bits(key: Key[Array, ""], shape: tuple[int, ...]) -> UInt32[Array, "..."]:
    """Independent 32-bit words, a function of the key and of the flat index alone (at most 2^32 of them). In
    a program it is part of it; outside of any its hundred steps are one."""
    data = jax.random.key_data(key).astype(jnp.uint32)
    if data.shape[-1] == 4:  # keys of the other generators have four words
        data = data[..., :2] ^ data[..., 2:]
    index = jax.lax.iota(jnp.uint32, math.prod(shape)).reshape(shape)
    return threefry((data[0], data[1]), index, jnp.full_like(index, _DOMAIN))[0]
