"""The sensor model: a Poisson-Gaussian baseline and fitted mechanisms in the order of the signal chain."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt16

from cannoise_jax.physics import registry
from cannoise_jax.physics.chain import maps_of, run_chain, to_codes
from cannoise_jax.physics.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.mechanism import Context, Mechanism, Scaling, scaling_factor
from cannoise_jax.physics.poisson_gaussian import electrons_from_nlf
from cannoise_jax.recordings.packing import pack, to_mosaic_order, unpack
from cannoise_jax.recordings.recording import PerChannel, per_channel


class Settings(NamedTuple):
    """How a recording is taken. Temperature None: that at which the model's parameters hold."""

    iso: float = 100.0
    exposure_s: float = 0.01
    temperature_c: float | None = None
    frames: int = 1


DEFAULT = Settings()


class ExtrapolationWarning(UserWarning):
    """A setting lies outside the range in which the model was calibrated."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class IsoTable:
    """A parameter tabulated over ISO: linear in between, held at the ends. iso, value: [N], ISO ascending."""

    iso: Float[Array, "n"]
    value: Float[Array, "n"]

    def at(self, iso) -> Array:
        """The parameter at an ISO."""
        return jnp.interp(iso, jnp.asarray(self.iso), jnp.asarray(self.value))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Fitted:
    """A mechanism with its parameters: numbers or `IsoTable`s by name, and the frozen maps that were
    measured.

    maps empty: they are drawn from the model's `unit_key`. point: for a mechanism without a name ("unnamed").
    """

    mechanism: str = field(metadata={"static": True})
    parameters: dict[str, Any]
    scaling: Scaling
    maps: dict[str, Array]
    point: Point | None = field(default=None, metadata={"static": True})

    @property
    def record(self) -> Mechanism:
        """The functions of this mechanism."""
        if self.point is not None:
            return mechanism_from_grammar(self.point, id=self.mechanism)
        return registry.mechanism(self.mechanism)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class SensorModel:
    """A camera: per ISO the system gain (DN/e-) and read noise (e-), then mechanisms, sorted along the chain.

    iso: [N] ascending. gain_dn_per_e, read_noise_e: [N, 4], mosaic order. black_level: [4] DN.
    white_level: DN, the highest code. code_step: DN between codes; 0: not on a lattice (codes are rounded
    to 1).
    unit_key: from which the frozen patterns of this camera unit are drawn where none were measured.
    """

    iso: Float[Array, "n"]
    gain_dn_per_e: Float[Array, "n 4"]
    read_noise_e: Float[Array, "n 4"]
    black_level: Float[Array, "4"]
    white_level: Float[Array, ""]
    code_step: Float[Array, ""]
    unit_key: Key[Array, ""]
    mechanisms: tuple[Fitted, ...]
    cfa: str = field(metadata={"static": True})
    camera: str = field(default="unknown", metadata={"static": True})

    @staticmethod
    def poisson_gaussian(
        gain_dn_per_e,
        read_noise_e,
        black_level: float | PerChannel = 0.0,
        white_level: float = 65535.0,
        cfa: str = "RGGB",
        *,
        iso: float | tuple[float, ...] = 100.0,
        code_step: float = 1.0,
        camera: str = "unknown",
        unit_key: Key[Array, ""] | None = None,
    ) -> SensorModel:
        """The baseline alone. Gain and read noise: one number, one per mosaic site, or [N, 1 or 4] for N
        ISOs.

        unit_key: default the key of 0. Raises ValueError for counts that do not match or ISOs out of order.
        """
        isos = np.atleast_1d(np.asarray(iso, np.float32))

        def table(values) -> np.ndarray:
            values = np.asarray(values, np.float32)
            values = values.reshape(isos.size, -1) if isos.size > 1 else values.reshape(1, -1)
            if values.shape[1] not in (1, 4):
                raise ValueError(
                    f"expected 1 or 4 values for each of {isos.size} ISOs, got shape {values.shape}"
                )
            return np.broadcast_to(values, (isos.size, 4)).copy()

        if np.any(np.diff(isos) <= 0):
            raise ValueError(f"ISOs must ascend, got {isos.tolist()}")
        return SensorModel(
            iso=isos,
            gain_dn_per_e=table(gain_dn_per_e),
            read_noise_e=table(read_noise_e),
            black_level=np.asarray(per_channel(black_level), np.float32),
            white_level=np.float32(white_level),
            code_step=np.float32(code_step),
            unit_key=jax.random.key(0) if unit_key is None else unit_key,
            mechanisms=(),
            cfa=cfa,
            camera=camera,
        )

    @staticmethod
    def from_nlf(
        shot,
        read,
        black_level: float | PerChannel = 0.0,
        white_level: float = 65535.0,
        cfa: str = "RGGB",
        **more,
    ) -> SensorModel:
        """The baseline of a noise level function `var = shot * clean + read` in normalised units (mosaic
        order)."""
        span = white_level - np.asarray(per_channel(black_level))
        gain, read_noise = electrons_from_nlf(np.asarray(shot), np.asarray(read), span)
        return SensorModel.poisson_gaussian(gain, read_noise, black_level, white_level, cfa, **more)

    @staticmethod
    def preset(name: str, iso: float | None = None) -> SensorModel:
        """A camera from published tables, see `presets`; iso: keep only this ISO."""
        from cannoise_jax.physics import presets

        return presets.preset(name, iso)

    def with_mechanism(
        self,
        id: str,
        *,
        scaling: Scaling | None = None,
        maps: dict[str, Array] | None = None,
        point: Point | None = None,
        **parameters,
    ) -> SensorModel:
        """The model with one more mechanism; parameters not given take their typical values.

        id: of the vocabulary; or any name with `point`, a bare place in the grammar. Parameters: numbers or
        `IsoTable`s; they hold at the scaling law's reference setting. Raises ValueError for unknown names.
        """
        record = registry.mechanism(id) if point is None else mechanism_from_grammar(point, id=id)
        known = record.defaults()
        unknown = sorted(set(parameters) - set(known))
        if unknown:
            raise ValueError(
                f"{id} has no parameter {', '.join(unknown)}: it has {', '.join(known) or 'none'}"
            )
        fitted = Fitted(id, {**known, **parameters}, scaling or record.scaling, dict(maps or {}), point)
        return dataclasses.replace(self, mechanisms=chain_order((*self.mechanisms, fitted)))

    def without(self, id: str) -> SensorModel:
        """The model with every mechanism of this id taken out."""
        return dataclasses.replace(self, mechanisms=tuple(f for f in self.mechanisms if f.mechanism != id))

    def with_unit(self, key: Key[Array, ""]) -> SensorModel:
        """Another unit of the same camera: frozen patterns are drawn anew, measured maps are dropped."""
        bare = tuple(dataclasses.replace(f, maps={}) for f in self.mechanisms)
        return dataclasses.replace(self, mechanisms=bare, unit_key=key)

    def with_maps(self, size: tuple[int, int]) -> SensorModel:
        """The same camera unit with its frozen patterns of [H, W] drawn once and kept, instead of at every
        `sample`. Maps that scale with the settings are kept before scaling."""
        context = context_of(self, jnp.zeros((1, *size)), Settings(iso=float(np.asarray(self.iso)[0])))
        values = resolve(self, context)
        drawn = tuple(
            dataclasses.replace(f, maps=maps_of(self, i, values[i], context))
            for i, f in enumerate(self.mechanisms)
        )
        return dataclasses.replace(self, mechanisms=drawn)

    def sample(
        self, key: Key[Array, ""], clean: Float[Array, "h w"], settings: Settings = DEFAULT
    ) -> UInt16[Array, "t h w"]:
        """Frames in DN of a clean mosaic (normalised): `uint16[T, H, W]`. Works under jit; outside it, a
        setting beyond the calibrated range draws one `ExtrapolationWarning`."""
        _warn_outside(self, settings)
        return _sample_codes(self, key, clean, settings._replace(frames=None), settings.frames)

    def expected(self, clean: Float[Array, "h w"], settings: Settings = DEFAULT) -> Float[Array, "h w"]:
        """Expected value in DN before rounding and clipping: black level, signal and the closed-form mean
        shift of every mechanism (the few without one leave it alone)."""
        _warn_outside(self, settings)
        clean = jnp.asarray(clean, jnp.float32)[None]
        context = context_of(self, clean, settings)
        values = resolve(self, context)
        mean = context.black_level + context.mean_dn
        for i, fitted in enumerate(self.mechanisms):
            effect = fitted.record.effect
            change = effect(values[i], maps_of(self, i, values[i], context), context).mean if effect else None
            mean = mean if change is None else mean + change
        return jnp.broadcast_to(mean, clean.shape)[0]

    def n_init(self, *, discretise: bool = True) -> Callable[..., Float[Array, "b h w 4"]]:
        """An init noise for training: `(key, clean[B,h,w,4], shot[B,4], read[B,4]) -> noise[B,h,w,4]`,
        packed and normalised. The baseline is that of shot and read; the mechanisms are this model's, at
        the ISO whose gain is theirs. discretise: round to the code step and clip at the rails, as stored
        frames are."""

        def draw(key, clean, shot, read):
            mosaic = unpack(clean, self.cfa)
            context = _context_of_nlf(self, mosaic, *(to_mosaic_order(v, self.cfa) for v in (shot, read)))
            values = resolve(self, context)
            y, step = run_chain(self, key, context, values, mosaic.shape[0])
            if discretise:
                y = to_codes(self, key, y, step, context, values)
            return pack((y - context.black_level) / context.span_dn - mosaic, self.cfa)

        return draw


def chain_order(fitted: tuple[Fitted, ...]) -> tuple[Fitted, ...]:
    """Fitted mechanisms in the order of the signal chain; equals keep their order."""
    return tuple(sorted(fitted, key=lambda f: registry.chain_position(f.mechanism, f.record)))


def _site_map(values: Float[Array, "... 4"], size: tuple[int, int]) -> Float[Array, "... h w"]:
    """One value per mosaic site spread over [H, W]; batched and traceable form of `mosaic_map`."""
    height, width = size
    cell = jnp.asarray(values).reshape(*values.shape[:-1], 2, 2)
    return cell[..., np.arange(height)[:, None] % 2, np.arange(width)[None, :] % 2]


def baseline_at(model: SensorModel, iso) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Gain and read noise at an ISO, mosaic order. Between tabulated ISOs both are linear in ISO; beyond them
    the gain is proportional to ISO and the read noise in e- stays at its last value."""
    isos, gains, reads = (jnp.asarray(v) for v in (model.iso, model.gain_dn_per_e, model.read_noise_e))
    inside = jnp.clip(iso, isos[0], isos[-1])
    at = jax.vmap(lambda column: jnp.interp(inside, isos, column), in_axes=1)
    return at(gains) * (iso / inside), at(reads)


def context_of(model: SensorModel, clean: Float[Array, "t h w"], settings: Settings) -> Context:
    """The context of a clean mosaic [T or 1, H, W] at a setting."""
    size = clean.shape[-2:]
    gain, read = baseline_at(model, settings.iso)
    black = _site_map(jnp.asarray(model.black_level), size)[None]
    white = jnp.asarray(model.white_level)
    temperature = settings.temperature_c
    return Context(
        mean_dn=jnp.maximum(clean, 0.0) * (white - black),
        gain_dn_per_e=_site_map(gain, size)[None],
        read_noise_e=_site_map(read, size)[None],
        black_level=black,
        white_level=white,
        code_step=jnp.asarray(model.code_step),
        iso=jnp.asarray(settings.iso, jnp.float32),
        exposure_s=jnp.asarray(settings.exposure_s, jnp.float32),
        temperature_c=None if temperature is None else jnp.asarray(temperature, jnp.float32),
        cfa=model.cfa,
        size=size,
    )


def _context_of_nlf(model: SensorModel, clean: Float[Array, "b h w"], shot, read) -> Context:
    """The context of mosaics with one noise level function each ([B, 4], mosaic order)."""
    first = context_of(model, clean, Settings())
    span = jnp.asarray(model.white_level) - jnp.asarray(model.black_level)
    gain, read_noise = electrons_from_nlf(shot, read, span)
    # The ISO at which this model has that gain, one per mosaic, so that tables over ISO apply.
    gains = jnp.mean(jnp.asarray(model.gain_dn_per_e), axis=1)
    ratio = jnp.mean(gain, axis=1) / jnp.clip(jnp.mean(gain, axis=1), gains[0], gains[-1])
    iso = jnp.interp(jnp.mean(gain, axis=1), gains, jnp.asarray(model.iso)) * ratio
    return dataclasses.replace(
        first,
        gain_dn_per_e=_site_map(gain, first.size),
        read_noise_e=_site_map(read_noise, first.size),
        iso=iso[:, None, None],
    )


def resolve(model: SensorModel, context: Context) -> tuple[dict[str, Array], ...]:
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
            values[scales] = values[scales] * scaling_factor(law, context, _site_map(reference, context.size))
        resolved.append(values)
    return tuple(resolved)


@partial(jax.jit, static_argnames="frames")
def _sample_codes(model: SensorModel, key, clean, settings: Settings, frames: int) -> UInt16[Array, "t h w"]:
    context = context_of(model, jnp.asarray(clean, jnp.float32)[None], settings)
    values = resolve(model, context)
    y, step = run_chain(model, key, context, values, frames)
    return to_codes(model, key, y, step, context, values).astype(jnp.uint16)


def _warn_outside(model: SensorModel, settings: Settings) -> None:
    iso = settings.iso
    if isinstance(iso, jax.core.Tracer) or isinstance(model.iso, jax.core.Tracer):
        return
    low, high = float(model.iso[0]), float(model.iso[-1])
    if not low <= iso <= high:
        warnings.warn(
            f"{model.camera}: ISO {iso:g} is outside the calibrated {low:g} to {high:g}: "
            "the gain is taken as proportional to ISO, the read noise in e- as constant",
            ExtrapolationWarning,
            stacklevel=3,
        )
