"""The sensor model: a Poisson-Gaussian baseline and fitted mechanisms in the order of the signal chain."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt16

from cannoise_jax.physics.core import presets, ranges, registry
from cannoise_jax.physics.core.grammar import Point, bare
from cannoise_jax.physics.core.mechanism import HasRecord, Mechanism, Scaling
from cannoise_jax.physics.core.memory import check_room
from cannoise_jax.physics.core.poisson_gaussian import InitialNoise, electrons_from_nlf
from cannoise_jax.physics.core.sensor_draws import (
    closed_moments,
    draw_maps,
    sample_analogue,
    sample_codes,
    sample_digital,
)
from cannoise_jax.physics.core.sensor_json import check_place, read_model, write_sensor
from cannoise_jax.physics.core.sensor_noise import noise_at_exposure, noise_at_level, placed, with_drawn
from cannoise_jax.physics.core.settings import (
    DEFAULT,
    ExtrapolationWarning,
    Fitted,
    IsoTable,
    Numbers,
    Settings,
    chain_order,
    warn_outside,
)
from cannoise_jax.recordings.recording import BadInput, PerChannel

__all__ = ["ExtrapolationWarning", "Fitted", "IsoTable", "SensorModel", "Settings"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class SensorModel:
    """A camera: per ISO the system gain (DN/e-) and read noise (e-), then mechanisms, sorted along the chain.

    iso: [N] ascending. gain_dn_per_e, read_noise_e: [N, 4], mosaic order. black_level: [4] DN, at the first
    ISO. black_beyond: [N, 4] DN, by how much it lies beyond that at every ISO. white_level: DN, the highest
    code. code_step: DN between codes; 0: not on a lattice (codes are rounded to 1).
    unit_key: from which the frozen patterns of this camera unit are drawn where none were measured.
    """

    iso: Numbers
    gain_dn_per_e: Numbers
    read_noise_e: Numbers
    black_level: Numbers
    black_beyond: Numbers
    white_level: Numbers
    code_step: Numbers
    unit_key: Key[Array, ""]
    mechanisms: tuple[Fitted, ...]
    cfa: str = field(metadata={"static": True})
    camera: str = field(default="unknown", metadata={"static": True})

    @staticmethod
    def poisson_gaussian(
        gain_dn_per_e,
        read_noise_e,
        black_level: float | PerChannel | np.ndarray = 0.0,
        white_level: float = 65535.0,
        cfa: str = "RGGB",
        *,
        iso: float | tuple[float, ...] = 100.0,
        code_step: float = 1.0,
        camera: str = "unknown",
        unit_key: Key[Array, ""] | None = None,
    ) -> SensorModel:
        """The baseline alone. Gain and read noise: one number, one per mosaic site, or [N, 1 or 4] for N
        ISOs; the black level: one number, one per site, or [N, 4] where it is another at every ISO.

        unit_key: default the key of 0. Numbers may be traced. Raises ValueError for counts that do not match
        and for what `ranges.check_baseline` and `ranges.check_read_noise` refuse.
        """
        ranges.check_baseline(
            iso=iso, gain_dn_per_e=gain_dn_per_e, read_noise_e=read_noise_e,
            black_level=black_level, white_level=white_level, code_step=code_step, cfa=cfa,
        )  # fmt: skip
        isos = _array(iso).reshape(-1)

        def table(values) -> Numbers:
            values = _array(values)
            rows = isos.size if isos.size > 1 else 1
            if values.size not in (rows, 4 * rows):
                raise ValueError(
                    f"expected 1 or 4 values for each of {isos.size} ISOs, got shape {values.shape}"
                )
            return _spread(values.reshape(rows, -1), (isos.size, 4))

        black = _array(black_level)
        blacks = black if black.ndim == 2 else _spread(black, (1, 4))
        if blacks.shape not in ((1, 4), (isos.size, 4)):
            raise ValueError(f"expected black levels [{isos.size}, 4], got shape {blacks.shape}")
        gain, read = table(gain_dn_per_e), table(read_noise_e)
        ranges.check_read_noise(gain, read, blacks, white_level)
        return SensorModel(
            iso=isos,
            gain_dn_per_e=gain,
            read_noise_e=read,
            black_level=_spread(blacks[0], (4,)),
            black_beyond=_spread(blacks - blacks[:1], (isos.size, 4)),
            white_level=_array(white_level),
            code_step=_array(code_step),
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
        order); a read below 0, as metadata sometimes states, counts as 0. Raises ValueError as
        `poisson_gaussian`."""
        span = jnp.asarray(white_level) - jnp.asarray(black_level)
        gain, read_noise = electrons_from_nlf(jnp.asarray(shot), jnp.asarray(read), jnp.asarray(span))
        return SensorModel.poisson_gaussian(gain, read_noise, black_level, white_level, cfa, **more)

    @staticmethod
    def preset(name: str, iso: float | None = None) -> SensorModel:
        """A camera from published tables, see `presets`; iso: keep only this ISO."""
        found = presets.preset(name, iso)
        model = SensorModel.poisson_gaussian(
            found.gain_dn_per_e,
            found.read_noise_e,
            found.black_level,
            found.white_level,
            found.cfa,
            iso=found.iso,
            code_step=found.code_step,
            camera=name,
        )
        for id, parameters in found.mechanisms:
            model = model.with_mechanism(id, **cast(dict[str, Any], parameters))
        return model

    def with_mechanism(
        self,
        mechanism: str | Mechanism | HasRecord,
        /,
        *,
        scaling: Scaling | None = None,
        maps: dict[str, Array] | None = None,
        point: Point | None = None,
        again: bool = False,
        **parameters,
    ) -> SensorModel:
        """The model with one more mechanism; parameters not given take their typical values.

        mechanism: a name of the package; an entry or record of one's own; or any name with `point`, a bare
        place in the grammar. Parameters: numbers or `IsoTable`s, maybe traced; they hold at the scaling law's
        reference setting. again: one more of a name that the model has, as of two waves. For other parameters
        take the first out: `model.without(name).with_mechanism(name, ...)`. Raises TypeError for what is no
        mechanism, ValueError for a name that the model has (without again), unknown names, numbers outside
        the parameter's range (as its record states it), and maps that the mechanism does not have.
        """
        record = _record(mechanism, point)
        if not again and any(f.mechanism == record.id for f in self.mechanisms):
            raise ValueError(
                f"{record.id}: the model has it: take that out with without({record.id!r}), or add one more "
                "with again=True"
            )
        id, known = record.id, record.defaults()
        unknown = sorted(set(parameters) - set(known))
        if unknown:
            raise ValueError(
                f"{id} has no parameter {', '.join(unknown)}: it has {', '.join(known) or 'none'}"
            )
        fitted = Fitted(record, {**known, **parameters}, scaling or record.scaling, dict(maps or {}), point)
        ranges.check_fitted(fitted)
        ranges.check_maps(self, fitted)
        return dataclasses.replace(self, mechanisms=chain_order((*self.mechanisms, fitted)))

    def without(self, id: str) -> SensorModel:
        """The model with every mechanism of this id taken out."""
        return dataclasses.replace(self, mechanisms=tuple(f for f in self.mechanisms if f.mechanism != id))

    def under_steady_light(self) -> SensorModel:
        """The camera alone, without what the light and the scenes of its recordings did: lamps that flicker
        or drift, references that are off. So other scenes are simulated."""
        return dataclasses.replace(
            self, mechanisms=tuple(f for f in self.mechanisms if not f.record.of_light)
        )

    def with_unit(self, key: Key[Array, ""]) -> SensorModel:
        """Another unit of the same camera: frozen patterns are drawn anew, measured maps are dropped."""
        bare = tuple(dataclasses.replace(f, maps={}) for f in self.mechanisms)
        return dataclasses.replace(self, mechanisms=bare, unit_key=key)

    def with_maps(self, size: tuple[int, int]) -> SensorModel:
        """The same camera unit with its frozen patterns of [H, W] drawn once and kept, instead of at every
        `sample`. Maps that scale with the settings are kept before scaling."""
        return with_drawn(
            self, draw_maps(self, (float(np.asarray(self.iso)[0]), DEFAULT.exposure_s, None), size)
        )

    def placed(self, size: tuple[int, int]) -> SensorModel:
        """The model for frames of [H, W]: measured maps cut to them, from their first pixel on, or repeated
        where they are smaller."""
        return placed(self, None, size, repeat=True)

    def sample(
        self, key: Key[Array, ""], clean: Float[Array | np.ndarray, "h w"], settings: Settings = DEFAULT
    ) -> UInt16[Array, "t h w"]:
        """Frames in DN of a clean mosaic (normalised): `uint16[T, H, W]`.

        Values above 1 are light beyond the white level, as of highlights or flats that are too bright: their
        pixels are full. What no scene has is refused: a median above 4, values below -0.5, whole numbers
        above 4, truths. Works under jit; outside it, a setting beyond the calibrated range draws one
        `ExtrapolationWarning`, what `ranges.check_taken` refuses and more frames than memory holds raise
        ValueError, and what is no key TypeError. Under jit the values of `clean` are not known, so that one
        in DN is not refused: its frames are at the last code."""
        ranges.check_key(key)
        ranges.check_taken(clean, settings)
        if not isinstance(clean, jax.core.Tracer):
            check_room(settings.frames, np.shape(clean))
        warn_outside(self, settings)
        setting = (settings.iso, settings.exposure_s, settings.temperature_c)
        # The frozen patterns are drawn by a program of their own: fused with the frames they would be
        # drawn anew for each of them.
        drawn = draw_maps(self, setting, np.shape(clean))
        whole = with_drawn(self, drawn)
        if not any(f.record.acts_on == "code" and f.record.sample is not None for f in self.mechanisms):
            return sample_codes(whole, key, clean, setting, settings.frames)
        # So are the values that digital mechanisms change: a pixel that takes those of its neighbours would
        # draw each of them anew.
        analogue = sample_analogue(whole, key, clean, setting, settings.frames)
        return sample_digital(whole, key, clean, setting, analogue)

    def expected(self, clean: Float[Array, "h w"], settings: Settings = DEFAULT) -> Float[Array, "h w"]:
        """Expected value in DN before rounding and clipping: black level, signal and the closed-form mean
        shift of every mechanism (the few without one leave it alone). Raises as `sample`."""
        ranges.check_taken(clean, settings)
        warn_outside(self, settings)
        mean, _ = closed_moments(self, clean, settings)
        return mean

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Writes a sensor.json, and an .npz of the same stem for measured maps. Raises BadInput where the
        file exists (without force) or cannot be written."""
        if not isinstance(path, str | Path) or not str(path).strip():
            raise BadInput(f"path is {path!r}: name a file for the sensor model")
        check_place(Path(path), maps=False)
        if Path(path).exists() and not force:
            raise BadInput(f"{path}: exists: name another file, or replace it with force=True")
        write_sensor(path, self)

    @staticmethod
    def load(path: str | Path, mechanisms: Sequence[HasRecord] = ()) -> SensorModel:
        """The model of a sensor.json. mechanisms: entries from outside the package that it may name. Raises
        BadInput with one line for anything that is not one, and where an entry is missing."""
        return read_model(SensorModel.poisson_gaussian, path, mechanisms)

    def n_init(self, *, discretise: bool = True, exposure_s: float | None = None) -> InitialNoise:
        """An initial noise for training: `(key, clean[B,h,w,4], shot[B,4], read[B,4]) -> (noise, sigma)`,
        both [B,h,w,4], packed and normalised; sigma: the model's standard deviation in closed form.

        Without exposure_s the baseline is that of shot and read; the mechanisms are this model's, at the ISO
        whose gain is theirs. With it the noise is this model's own, dark charge and read noise included, at
        the gain setting whose shot noise is nearest. Measured maps larger than the patch are cropped, at
        another even place in every call. discretise: round to the code step and clip at the rails, as stored
        frames are.
        """
        if exposure_s is None:
            return noise_at_level(self, discretise)
        return noise_at_exposure(self, exposure_s, discretise)


def _record(mechanism: str | Mechanism | HasRecord, point: Point | None) -> Mechanism:
    if isinstance(mechanism, str):
        if point is None:
            return registry.mechanism(mechanism)
        ranges.check_point(mechanism, point)
        return bare(point, mechanism)
    record = mechanism if isinstance(mechanism, Mechanism) else getattr(mechanism, "record", None)
    if not isinstance(record, Mechanism):
        raise TypeError(
            f"mechanism is of type {type(mechanism).__name__}: expected its name, or an entry or record"
        )
    if point is not None:
        raise ValueError(f"{record.id}: has its place in the grammar: give a name with point, or it alone")
    registry.check_record(record)
    return record


def _array(values) -> Any:
    """Numbers as float32: of NumPy, or of JAX while they are traced."""
    traced = any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(values))
    return jnp.asarray(values, jnp.float32) if traced else np.asarray(values, np.float32)


def _spread(values: Any, shape: tuple[int, ...]) -> Any:
    xp = jnp if isinstance(values, jax.core.Tracer) else np
    return xp.broadcast_to(values, shape) + np.float32(0)
