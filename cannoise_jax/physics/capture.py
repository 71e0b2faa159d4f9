"""Mechanisms of this stage of the chain."""

from cannoise_jax.physics.mechanism import Mechanism

MECHANISMS: tuple[Mechanism, ...] = ()
