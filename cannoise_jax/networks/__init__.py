"""Generator, critic, camera encoder, and the layers under them. Linen modules, no state but their
variables."""

from cannoise_jax.networks.discriminator import Discriminator
from cannoise_jax.networks.encoder import Encoder
from cannoise_jax.networks.generator import Generator

__all__ = ["Discriminator", "Encoder", "Generator"]
