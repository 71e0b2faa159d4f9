"""What a mechanism is: a record of pure functions that says how a camera departs from Poisson-Gaussian noise.

The chain carries one array `x[T, H, W]` through five stages, and a mechanism changes it where it enters:

    acts on "mean"    expected charge, e-     photons, and charge that brings its own shot noise
       -> shot noise (Poisson)
    acts on "charge"  collected charge, e-    pixel: leaks, traps, full well
       -> gain, black level, read noise
    acts on "signal"  analogue value, DN      readout: rows, columns, interference; converter faults
       -> rounding to the code step, clipping at the rails
    acts on "code"    stored codes, DN        digital: what the camera did to the codes

A mechanism that changes the shot noise, read noise or code step themselves (gain_error, heavy_tails,
quantization, ...) does so by `baseline` instead of `sample`. See `grammar` for the axes that describe a
mechanism.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

Stage = Literal["photons", "pixel", "readout", "converter", "digital"]
STAGES: tuple[Stage, ...] = ("photons", "pixel", "readout", "converter", "digital")
ActsOn = Literal["mean", "charge", "signal", "code"]
ACTS_ON: tuple[ActsOn, ...] = get_args(ActsOn)
"""In the order of the signal chain."""

Values = Mapping[str, Any]
"""Parameters by name, each a number or an array that broadcasts against `x[T, H, W]`."""
Maps = Mapping[str, Array]
"""Frozen patterns of a camera unit by name, each broadcasting against `x[T, H, W]`."""


class Parameter(NamedTuple):
    """One continuous parameter: unit, a typical value and bounds. absent: its value in files of versions that
    had none; None: a file has to state it."""

    name: str
    unit: str
    default: float
    low: float
    high: float
    definition: str = ""
    absent: float | None = None


DOUBLING_C = 7.0
"""Kelvin per doubling of the dark current: 6 to 8 K for silicon near room temperature."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scaling:
    """How an amplitude moves with the settings: times (K/K0)^gain (t/t0)^exposure 2^((T - T0) / doubling_c).

    K is the system gain, t the exposure, T the temperature; index 0 is the setting at which the parameters
    hold.
    doubling_c: kelvin per doubling; None: no dependence on temperature. reference_iso None: the first ISO of
    the model's baseline. An unknown temperature counts as the reference.
    exposure_low_s, exposure_high_s: exposures between which it was measured; high 0: unknown.
    """

    gain: float = 0.0
    exposure: float = 0.0
    doubling_c: float | None = None
    reference_iso: float | None = None
    reference_exposure_s: float = 1.0
    reference_temperature_c: float | None = None
    exposure_low_s: float = 0.0
    exposure_high_s: float = 0.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Context:
    """Where and how a frame was taken, as a mechanism sees it. Fields broadcast against `x[T, H, W]`.

    mean_dn: expected signal above black without any mechanism, DN. gain_dn_per_e, read_noise_e: the
    baseline's; for mechanisms of the charge, as other mechanisms altered them.
    cfa, size: colour pattern and (H, W), static under jit. frame_before: whether the last frame of x is the
    one before the first, static.
    """

    mean_dn: Array
    gain_dn_per_e: Array
    read_noise_e: Array
    black_level: Array
    white_level: Array
    code_step: Array
    iso: Array
    exposure_s: Array
    temperature_c: Array | None
    cfa: str = field(metadata={"static": True})
    size: tuple[int, int] = field(metadata={"static": True})
    frame_before: bool = field(default=False, metadata={"static": True})

    @property
    def span_dn(self) -> Array:
        """White minus black level, DN."""
        return self.white_level - self.black_level

    def mean_charge(self) -> Array:
        """Expected charge of the baseline, e-."""
        return self.mean_dn / self.gain_dn_per_e

    def own_variance(self) -> Array:
        """Variance of the Poisson-Gaussian baseline, DN^2."""
        return self.gain_dn_per_e * self.mean_dn + (self.gain_dn_per_e * self.read_noise_e) ** 2


class Noise(NamedTuple):
    """The two noise steps and the rounding, as `baseline` functions alter them.

    tukey_lambda: shape of the read noise; None: Gaussian. poisson_share: 1: Poisson shot noise, 0: Gaussian.
    code_step: spacing of the stored codes, DN.
    """

    gain_dn_per_e: Array
    read_noise_e: Array
    code_step: Array
    tukey_lambda: Array | None = None
    poisson_share: Array | None = None


class Effect(NamedTuple):
    """Change that a mechanism makes to the pixel statistics, given its frozen maps; None: no change.

    All refer to the analogue signal in DN before rounding and clipping, and broadcast to [H, W].
    mean: of the expected value. variance: of the total variance over frames, what is shared included.
    row, column, frame: the part of that variance that is common to a row, a column or a frame, so that two
      of its pixels a, b covary by sqrt(v_a v_b).
    lags: covariance with the pixel (dy, dx) away in the same frame. temporal: with the same pixel n frames
    later.
    third, fourth: of the third and fourth cumulant over frames, DN^3 and DN^4.
    lattice: which stored codes can occur, as a sentence-free mapping: "step" DN, "missing_period" steps,
      "low" and "high" rails, DN.
    """

    mean: Any = None
    variance: Any = None
    row: Any = None
    column: Any = None
    frame: Any = None
    lags: Mapping[tuple[int, int], Any] | None = None
    temporal: Mapping[int, Any] | None = None
    third: Any = None
    fourth: Any = None
    lattice: Mapping[str, Any] | None = None


SampleFn = Callable[[Key[Array, ""], Float[Array, "t h w"], Values, Maps, Context], Float[Array, "t h w"]]


def effect_in_dn(context: Context, mean=None, variance=None, **more) -> Effect:
    """An effect whose mean and variance are given in e- and e-^2, [1, H, W]."""
    gain = context.gain_dn_per_e
    return Effect(
        mean=None if mean is None else (gain * mean)[0],
        variance=None if variance is None else (gain**2 * variance)[0],
        **more,
    )


def _first(values: Values, context: Context) -> Any:
    return next(iter(values.values()))


@dataclass(frozen=True, eq=False)
class Mechanism:
    """One way in which cameras depart from Poisson-Gaussian noise.

    id: its name, or "unnamed" for a bare grammar point.
    point: its place in the grammar (see `grammar.Point`), which says where it enters the chain.
    parameters: what is fitted; `scales` names the one that the scaling law multiplies, if any.
    sample(key, x, parameters, maps, context) -> x: pure, over all frames at once.
    baseline(noise, parameters, maps, context) -> noise: for mechanisms that alter the noise steps themselves.
    draw_maps(unit_key, parameters, context) -> maps: frozen patterns of a camera unit; None: it has none.
    effect(parameters, maps, context) -> Effect: closed form; None: there is none.
    amplitude(parameters, context) -> the one number that its term defines, of parameters at that setting; the
      first parameter unless said.
    looks_back: it needs the frame before, x rolled by one: another is drawn through the same chain as the
      last of x, and dropped.
    needs: data kinds that identify it, of "pair", "pair_independent", "burst", "dark", "flat", "iso",
      "exposure", "temperature". confused_with: ids. equation: LaTeX without dollar signs.
    of_light: of the light or the scenes that recordings were taken of, not of the camera.
    home: "module:NAME" of the entries that hold it, where it is none of the package's; stored models say it.

    Raises ValueError where the scaling law has no parameter to multiply: it would do nothing.
    """

    id: str
    point: Any
    parameters: tuple[Parameter, ...]
    equation: str = ""
    sentence: str = ""
    reference: str = ""
    needs: tuple[str, ...] = ()
    confused_with: tuple[str, ...] = ()
    amplitude: Callable[[Values, Context], Any] = _first
    sample: SampleFn | None = None
    baseline: Callable[[Noise, Values, Maps, Context], Noise] | None = None
    draw_maps: Callable[[Key[Array, ""], Values, Context], dict[str, Array]] | None = None
    effect: Callable[[Values, Maps, Context], Effect] | None = None
    looks_back: bool = False
    of_light: bool = False
    scaling: Scaling = field(default_factory=Scaling)
    scales: str | None = None
    home: str = ""

    def __post_init__(self) -> None:
        law = self.scaling
        if self.scales is not None or not isinstance(law, Scaling):
            return
        if law.gain or law.exposure or law.doubling_c is not None:
            raise ValueError(
                f"{self.id}: has a scaling law: name in `scales` the parameter that it multiplies"
            )

    @property
    def stage(self) -> Stage:
        """Where it enters the chain."""
        return self.point.stage

    @property
    def acts_on(self) -> ActsOn:
        """What it changes there."""
        return self.point.acts_on

    def defaults(self) -> dict[str, float]:
        """Typical values of the parameters."""
        return {p.name: p.default for p in self.parameters}


class HasRecord(Protocol):
    """Anything that holds a mechanism, as an entry of `mechanisms` does."""

    @property
    def record(self) -> Mechanism: ...


def scaling_factor(scaling: Scaling, context: Context, reference_gain: Array) -> Array:
    """The factor of `Scaling` at the context's setting; `reference_gain`: K0 in DN/e-, broadcasting like
    K."""
    factor = (context.gain_dn_per_e / reference_gain) ** scaling.gain
    factor = factor * (context.exposure_s / scaling.reference_exposure_s) ** scaling.exposure
    temperature, reference = context.temperature_c, scaling.reference_temperature_c
    if scaling.doubling_c is not None and temperature is not None and reference is not None:
        factor = factor * jnp.exp2((temperature - reference) / scaling.doubling_c)
    return factor
