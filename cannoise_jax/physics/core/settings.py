"""A sensor model at one setting: tables over ISO, scaling laws, and the context that the mechanisms see."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cannoise_jax.physics.core import registry
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Context, Mechanism, Scaling, scaling_factor
from cannoise_jax.physics.core.poisson_gaussian import electrons_from_nlf
from cannoise_jax.physics.core.setting_numbers import check_numbers
from cannoise_jax.recordings.recording import Recording

Numbers = Array | np.ndarray | np.floating | float
"""Numbers as they come: of NumPy outside jit, traced inside."""


@jax.tree_util.register_pytree_with_keys_class
@dataclass(frozen=True)
class Settings:
    """How a recording is taken. Temperature None: that at which the model's parameters hold.

    An argument of jit and vmap like any other: numbers are traced, frames is part of its structure. The axes
    of its numbers under vmap are `jax.tree.map(lambda value: 0, settings)`.
    Raises ValueError for numbers that no recording has, of Python, NumPy or JAX; traced ones pass, and None,
    which among axes says that a number has none: what draws refuses it.
    """

    iso: float = 100.0
    exposure_s: float = 0.01
    temperature_c: float | None = None
    frames: int = 1

    def __post_init__(self) -> None:
        check_numbers(self)

    def tree_flatten_with_keys(self) -> tuple[tuple[tuple[Any, Any], ...], int]:
        """Its numbers by name, and the frames."""
        return tuple((jax.tree_util.GetAttrKey(name), getattr(self, name)) for name in _NUMBERS), self.frames

    @classmethod
    def tree_unflatten(cls, frames: int, numbers: Sequence[Any]) -> Settings:
        """Without a check: JAX puts tracers, axes and marks of its own where the numbers were."""
        made = object.__new__(cls)
        for name, value in zip((*_NUMBERS, "frames"), (*numbers, frames), strict=True):
            object.__setattr__(made, name, value)
        return made


_NUMBERS = ("iso", "exposure_s", "temperature_c")


DEFAULT = Settings()


def settings_of(recording: Recording, iso: float, frames: int) -> Settings:
    """The settings of a recording, of so many frames; an exposure that is not known counts as that of
    `DEFAULT`."""
    known = recording.exposure_s
    return Settings(iso, DEFAULT.exposure_s if known is None else known, recording.temperature_c, frames)


class ExtrapolationWarning(UserWarning):
    """A setting lies outside the range in which the model was calibrated."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class IsoTable:
    """A parameter tabulated over ISO: linear in between, held at the ends. iso, value: [N], ISO ascending."""

    iso: Numbers
    value: Numbers

    def at(self, iso) -> Array:
        """The parameter at an ISO."""
        return jnp.interp(iso, jnp.asarray(self.iso), jnp.asarray(self.value))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Fitted:
    """A mechanism with its parameters: numbers or `IsoTable`s by name, and the frozen maps that were
    measured.

    maps empty: they are drawn from the model's `unit_key`. point: of a mechanism that is nothing but a place
    in the grammar, under whatever name.
    """

    record: Mechanism = field(metadata={"static": True})
    parameters: dict[str, Any]
    scaling: Scaling
    maps: dict[str, Array]
    point: Point | None = field(default=None, metadata={"static": True})

    @property
    def mechanism(self) -> str:
        """Its name."""
        return self.record.id


def of_larger_gain(fitted: Fitted, grown: float) -> Fitted:
    """The mechanism beside a gain `grown` times as large: what is in electrons stays as it is in DN."""
    named = {p.name for p in fitted.record.parameters if p.unit.startswith("e-")}

    def less(value: Any) -> Any:
        return IsoTable(value.iso, value.value / grown) if isinstance(value, IsoTable) else value / grown

    changed = {name: less(v) if name in named else v for name, v in fitted.parameters.items()}
    return dataclasses.replace(fitted, parameters=changed)


def chain_order(fitted: tuple[Fitted, ...]) -> tuple[Fitted, ...]:
    """Fitted mechanisms in the order of the signal chain; equals keep their order."""
    return tuple(sorted(fitted, key=lambda f: registry.chain_position(f.record)))


def site_map(values: Float[Array, "... 4"], size: tuple[int, int]) -> Float[Array, "... h w"]:
    """One value per mosaic site spread over [H, W]; batched and traceable form of `mosaic_map`."""
    a, b, c, d = (jnp.asarray(values)[..., k, None, None] for k in range(4))
    # Selections by constant parity fuse into the loop over pixels; a gather would not.
    odd_row = (np.arange(size[0]) % 2 == 1)[:, None]
    odd_column = (np.arange(size[1]) % 2 == 1)[None, :]
    return jnp.where(odd_row, jnp.where(odd_column, d, c), jnp.where(odd_column, b, a))


def baseline_at(model: Any, iso) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Gain and read noise at an ISO, mosaic order. Between tabulated ISOs both are linear in ISO; beyond them
    the gain is proportional to ISO and the read noise in e- stays at its last value."""
    isos, gains, reads = (jnp.asarray(v) for v in (model.iso, model.gain_dn_per_e, model.read_noise_e))
    inside = jnp.clip(iso, isos[0], isos[-1])
    at = jax.vmap(lambda column: jnp.interp(inside, isos, column), in_axes=1)
    return at(gains) * (iso / inside), at(reads)


def black_at(model: Any, iso) -> Float[Array, "4"]:
    """Black level at an ISO, DN, mosaic order: linear between tabulated ones, held at the ends."""
    isos, beyond = jnp.asarray(model.iso), jnp.asarray(model.black_beyond)
    more = jax.vmap(lambda column: jnp.interp(iso, isos, column), in_axes=1)(beyond)
    return jnp.asarray(model.black_level) + more


def black_levels(model: Any) -> Float[np.ndarray, "n 4"]:
    """Black level at every tabulated ISO, DN, of a model that is not traced."""
    return np.asarray(model.black_level, np.float64) + np.asarray(model.black_beyond, np.float64)


def with_black_levels(model: Any, levels: Float[np.ndarray, "n 4"]) -> Any:
    """The model with these black levels, DN, of its ISOs."""
    first, beyond = levels[0].astype(np.float32), (levels - levels[0]).astype(np.float32)
    return dataclasses.replace(model, black_level=first, black_beyond=beyond)


def context_of(model: Any, clean: Float[Array, "t h w"], settings: Settings) -> Context:
    """The context of a clean mosaic [T or 1, H, W] at a setting."""
    size = (clean.shape[-2], clean.shape[-1])
    gain, read = baseline_at(model, settings.iso)
    black = site_map(black_at(model, settings.iso), size)[None]
    white = jnp.asarray(model.white_level)
    temperature = settings.temperature_c
    return Context(
        mean_dn=jnp.maximum(clean, 0.0) * (white - black),
        gain_dn_per_e=site_map(gain, size)[None],
        read_noise_e=site_map(read, size)[None],
        black_level=black,
        white_level=white,
        code_step=jnp.asarray(model.code_step),
        iso=jnp.asarray(settings.iso, jnp.float32),
        exposure_s=jnp.asarray(settings.exposure_s, jnp.float32),
        temperature_c=None if temperature is None else jnp.asarray(temperature, jnp.float32),
        cfa=model.cfa,
        size=size,
    )


def context_of_nlf(model: Any, clean: Float[Array, "b h w"], shot, read) -> Context:
    """The context of mosaics with one noise level function each ([B, 4], mosaic order)."""
    lowest: Any = jnp.asarray(model.iso)[0]
    first = context_of(model, clean, Settings(iso=lowest))
    span = jnp.asarray(model.white_level) - jnp.asarray(model.black_level)
    gain, read_noise = electrons_from_nlf(shot, read, span)
    # The ISO at which this model has that gain, one per mosaic, so that tables over ISO apply.
    gains = jnp.mean(jnp.asarray(model.gain_dn_per_e), axis=1)
    ratio = jnp.mean(gain, axis=1) / jnp.clip(jnp.mean(gain, axis=1), gains[0], gains[-1])
    iso = jnp.interp(jnp.mean(gain, axis=1), gains, jnp.asarray(model.iso)) * ratio
    return dataclasses.replace(
        first,
        gain_dn_per_e=site_map(gain, first.size),
        read_noise_e=site_map(read_noise, first.size),
        iso=iso[:, None, None],
    )


def resolve(model: Any, context: Context) -> tuple[dict[str, Array], ...]:
    """The parameters of every mechanism at the context's setting: tables read, scaling law applied."""
    resolved = []
    for fitted in model.mechanisms:
        values = {
            name: v.at(context.iso) if isinstance(v, IsoTable) else jnp.asarray(v, jnp.float32)
            for name, v in fitted.parameters.items()
        }
        scales = fitted.record.scales
        if scales is not None:
            iso = fitted.scaling.reference_iso
            reference, _ = baseline_at(model, jnp.asarray(model.iso)[0] if iso is None else iso)
            # A table over ISO already says how the strength moves with the gain.
            law = fitted.scaling
            if isinstance(fitted.parameters[scales], IsoTable):
                law = dataclasses.replace(law, gain=0.0)
            values[scales] = values[scales] * scaling_factor(law, context, site_map(reference, context.size))
        resolved.append(values)
    return tuple(resolved)


def warn_outside(model: Any, settings: Settings) -> None:
    """One `ExtrapolationWarning` that names every setting beyond what the model was calibrated for, and the
    law that is used there. Silent under jit, where the settings are unknown."""
    iso, exposure, temperature = settings.iso, settings.exposure_s, settings.temperature_c
    if any(isinstance(v, jax.core.Tracer) for v in (iso, exposure, temperature, model.iso)):
        return
    low, high = float(model.iso[0]), float(model.iso[-1])
    said = []
    if not low <= np.float32(iso) <= high:
        span = f"outside the calibrated {low:g} to {high:g}"
        alone = f"not the calibrated {low:g}, which also stands for the one setting of a camera without ISO"
        said.append(
            f"ISO {iso:g} is {span if low < high else alone}: "
            "the gain is taken as proportional to ISO, the read noise in e- as constant"
        )
    for fitted in model.mechanisms:
        law = fitted.scaling
        if isinstance(law.exposure, jax.core.Tracer):
            return
        said += _beyond_iso(fitted, iso, (low, high))
        said += _beyond(fitted.mechanism, law, temperature)
        shortest, longest = fitted.scaling.exposure_low_s, fitted.scaling.exposure_high_s
        if (
            fitted.scaling.exposure
            and longest > 0
            and not np.float32(shortest) <= np.float32(exposure) <= np.float32(longest)
        ):
            said.append(
                f"{exposure:g} s is outside the calibrated {shortest:g} to {longest:g} s of "
                f"{fitted.mechanism}: it is taken to grow as exposure^{law.exposure:g}"
            )
    if said:
        warnings.warn(f"{model.camera}: {'; '.join(said)}", ExtrapolationWarning, stacklevel=3)


def _beyond_iso(fitted: Fitted, iso: float, calibrated: tuple[float, float]) -> list[str]:
    """What to say of one mechanism beyond the ISOs of its tables, or beyond those of the gain it follows."""
    said: list[str] = []
    for name, value in fitted.parameters.items():
        power = fitted.scaling.gain if name == fitted.record.scales else 0.0
        table = np.asarray(value.iso) if isinstance(value, IsoTable) and _is_known(value.iso) else None
        if table is not None and not table[0] <= np.float32(iso) <= table[-1]:
            end = table[0] if iso < table[0] else table[-1]
            said.append(f"{name} of {fitted.mechanism} is held at its value of ISO {end:g}")
        beyond = not calibrated[0] <= np.float32(iso) <= calibrated[1]
        if beyond and not isinstance(value, IsoTable) and _is_known(power) and power:
            said.append(f"{name} of {fitted.mechanism} is taken to grow as gain^{power:g}")
    return said


def _is_known(value: Any) -> bool:
    return not isinstance(value, jax.core.Tracer)


def _beyond(id: str, law: Scaling, temperature: float | None) -> list[str]:
    """What to say of one mechanism whose strength depends on the temperature."""
    if law.doubling_c is None or temperature is None:
        return []
    reference = law.reference_temperature_c
    if reference is None:
        return [f"{temperature:g} C does not change {id}: its reference temperature is unknown"]
    if abs(temperature - reference) <= law.doubling_c:
        return []
    return [
        f"{temperature:g} C is far from the {float(reference):g} C of {id}: "
        f"it is taken to double every {float(law.doubling_c):g} K"
    ]
