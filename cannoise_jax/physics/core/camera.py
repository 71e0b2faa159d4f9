"""What a sensor model is to those that draw it, store it and read it back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, Self

from jaxtyping import Array, Key

from cannoise_jax.physics.core.settings import Fitted, Numbers


class Camera(Protocol):
    """All that they need of `sensor.SensorModel`, which has their functions as its methods; its fields are
    described there."""

    @property
    def iso(self) -> Numbers: ...

    @property
    def gain_dn_per_e(self) -> Numbers: ...

    @property
    def read_noise_e(self) -> Numbers: ...

    @property
    def black_level(self) -> Numbers: ...

    @property
    def black_beyond(self) -> Numbers: ...

    @property
    def white_level(self) -> Numbers: ...

    @property
    def code_step(self) -> Numbers: ...

    @property
    def unit_key(self) -> Key[Array, ""]: ...

    @property
    def mechanisms(self) -> tuple[Fitted, ...]: ...

    @property
    def cfa(self) -> str: ...

    @property
    def camera(self) -> str: ...

    @property
    def poisson_gaussian(self) -> Callable[..., Self]: ...

    def with_mechanism(self, mechanism: Any, /, **more: Any) -> Self: ...
