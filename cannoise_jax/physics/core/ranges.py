"""What a camera model may hold, in one place: for models that are composed in code and for those that are
read from files, so that whatever can be composed can be stored and read again.

Every check raises ValueError with one line. Numbers that are traced under jit are unknown and pass.
"""

from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Mapping
from typing import Any, get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.physics.core.grammar import Point, contradiction
from cannoise_jax.physics.core.mechanism import Mechanism, Parameter, Scaling
from cannoise_jax.physics.core.setting_numbers import check_numbers
from cannoise_jax.physics.core.settings import Fitted, IsoTable, Settings
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import CFA_PATTERNS, LEAST, MOST, in_one_line

LARGEST = float(np.finfo(np.float32).max)
"""Numbers are kept as float32."""
HIGHEST_CODE = 65535
"""Of 16 bits, as frames are stored."""
_MAY_BE_NONE = ("doubling_c", "reference_iso", "reference_temperature_c")
_ABOVE_ZERO = ("doubling_c", "reference_iso", "reference_exposure_s")
_FEWEST_STEPS = 15
"""Between black and white, of codes that are further apart than whole numbers: 4 bits, the least that cameras
send of a pixel with more than two shades (Mono4p of the GenICam pixel formats, PFNC)."""
BRIGHTEST, DARKEST = 4.0, -0.5
"""Median and least value of a clean mosaic: scenes beyond the white level are fine, codes in DN are not."""
NOT_NORMALISED = (
    "so it is not normalised: give (DN - black) / (white - black), 0 at the black level and 1 at the "
    "white level"
)


def known(value: Any, what: str) -> np.ndarray | None:
    """The numbers of a value as float64; None while they are traced. Raises ValueError for what is no finite
    number of float32."""
    if isinstance(value, jax.core.Tracer):
        return None
    if isinstance(value, list | tuple) and any(isinstance(v, jax.core.Tracer) for v in value):
        return None
    try:
        numbers = np.asarray(value)
        if numbers.dtype.kind not in "fiu":
            raise TypeError
        numbers = numbers.astype(np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{what} is {reprlib.repr(value)}, {not_held(value)}") from None
    if not np.all(np.abs(numbers) <= LARGEST):  # holds for nan
        worst = float(numbers[~(np.abs(numbers) <= LARGEST)].flat[0])
        raise ValueError(f"{what} is {worst:g}, {not_held(worst)}")
    return numbers


def not_held(value: Any) -> str:
    """Why a value is no number of a camera model, in words."""
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    if plain and LARGEST < abs(value) < float("inf"):
        return f"more than {LARGEST:.2g}, the largest number that is kept: check its unit"
    return "not a finite number"


def check_baseline(
    *, iso, gain_dn_per_e, read_noise_e, black_level, white_level, code_step, cfa: str
) -> None:
    """The baseline: an RGB Bayer pattern or MONO, ISOs that ascend from above 0, gains above 0 by which one
    electron does not saturate, read noises from 0, black below white below 2^16, a code step from 0 (none) to
    below white, that leaves shades where it is above 1."""
    if not isinstance(cfa, str) or cfa not in CFA_PATTERNS:
        raise ValueError(f"cfa is {in_one_line(cfa)}, not one of {', '.join(CFA_PATTERNS)}")
    isos = known(iso, "iso")
    isos = isos if isos is None else np.atleast_1d(isos)
    if isos is not None and isos.min() < LEAST:
        raise ValueError(f"iso must be above 0, got {isos.min():g}")
    if isos is not None and isos.max() > MOST:
        raise ValueError(f"iso must be at most {MOST:g}, got {isos.max():g}")
    if isos is not None and np.any(np.diff(isos) <= 0):
        raise ValueError(f"ISOs must ascend, got {isos.tolist()}")
    gain, read = known(gain_dn_per_e, "gain_dn_per_e"), known(read_noise_e, "read_noise_e")
    if gain is not None and gain.min() <= 0:
        raise ValueError(f"gain_dn_per_e must be positive, got {gain.min():g}")
    if read is not None and read.min() < 0:
        raise ValueError(f"read_noise_e must be positive, got {read.min():g}")
    black, white = known(black_level, "black_level"), known(white_level, "white_level")
    if black is not None and black.ndim < 2 and black.size not in (1, 4):
        raise ValueError(f"black_level has {black.size} values: give 1, or 4 in mosaic order")
    step = known(code_step, "code_step")
    if white is not None and white > HIGHEST_CODE:
        raise ValueError(f"white_level {white:g} is above {HIGHEST_CODE}, the highest code of 16 bits")
    if black is not None and white is not None and not black.max() < white:
        raise ValueError(f"white_level {white:g} is not above black_level {black.max():g}")
    if step is not None and white is not None and not 0 <= step < white:
        raise ValueError(f"code_step {step:g} is not from 0 to below white_level {white:g}")
    if black is None or white is None:
        return
    span = float(white - black.min())
    # Values from 0 to the span have at most the variance mean (span - mean) (Bhatia and Davis, Am. Math. Mon.
    # 107, 2000), which shot noise, gain times mean, would exceed.
    if gain is not None and gain.max() > span:
        raise ValueError(
            f"gain_dn_per_e {gain.max():g} is more than the {span:g} DN from black to white, so that one "
            "electron saturates: give DN per electron"
        )
    if step is not None and step > max(1.0, span / _FEWEST_STEPS):
        raise ValueError(
            f"code_step {step:g} leaves {int(span // step) + 1} codes from black to white: give the spacing "
            "of the stored codes in DN"
        )


def check_read_noise(gain_dn_per_e, read_noise_e, black_level, white_level) -> None:
    """Of a baseline's tables by ISO and site: in DN no wider than the range from black to white."""
    gain, read = known(gain_dn_per_e, "gain_dn_per_e"), known(read_noise_e, "read_noise_e")
    black, white = known(black_level, "black_level"), known(white_level, "white_level")
    if gain is None or read is None or black is None or white is None:
        return
    widest = float(np.max(gain * read))
    span = float(white - black.min())
    if widest > span * (1 + 1e-5):  # of float32
        raise ValueError(
            f"read_noise_e {read.max():g} is {widest:g} DN, wider than the {span:g} DN from black "
            "to white: give electrons"
        )


def check_fitted(fitted: Fitted) -> None:
    """The parameters, tables and scaling law of one mechanism of a model, and its place in the grammar."""
    id = fitted.mechanism
    for p in fitted.record.parameters:
        _check_parameter(id, p, fitted.parameters[p.name])
    for name in (f.name for f in dataclasses.fields(Scaling)):
        value = getattr(fitted.scaling, name)
        if value is None and name in _MAY_BE_NONE:
            continue
        number = known(value, f"{id}: scaling {name}")
        if number is not None and name in _ABOVE_ZERO and number <= 0:
            raise ValueError(f"{id}: scaling {name} is {number:g}, not above 0")


def _check_parameter(id: str, p: Parameter, value: Any) -> None:
    if isinstance(value, IsoTable):
        isos = known(value.iso, f"{id}: {p.name}")
        if np.shape(value.iso) != np.shape(value.value):
            raise ValueError(
                f"{id}: {p.name} has {np.size(value.iso)} ISOs and {np.size(value.value)} values"
            )
        if isos is not None and (isos.ndim != 1 or isos.size == 0 or np.any(np.diff(isos) <= 0)):
            raise ValueError(f"{id}: {p.name} needs ISOs that ascend")
        value = value.value
    numbers = known(value, f"{id}: {p.name}")
    # Stored numbers are float32: an end of the range may round beyond itself.
    low, high = min(p.low, float(np.float32(p.low))), max(p.high, float(np.float32(p.high)))
    if numbers is not None and numbers.size and not (low <= numbers.min() and numbers.max() <= high):
        wrong = numbers.min() if numbers.min() < p.low else numbers.max()
        raise ValueError(f"{id}: {p.name} = {wrong:g} is outside {p.low:g} to {p.high:g}")


def clipped(record: Mechanism, values: Mapping[str, float]) -> dict[str, float]:
    """Measured parameters by name, moved into the ranges of the mechanism: an estimate can lie beyond."""
    bounds = {p.name: (p.low, p.high) for p in record.parameters}
    return {name: float(np.clip(v, *bounds.get(name, (-np.inf, np.inf)))) for name, v in values.items()}


def check_maps(model: Any, fitted: Fitted) -> None:
    """The measured maps of one mechanism: the names that it draws, each a finite image [H, W] or
    [1, H, W]."""
    if not fitted.maps:
        return
    alone = dataclasses.replace(model, mechanisms=(dataclasses.replace(fitted, maps={}),))
    drawn = jax.eval_shape(lambda: alone.with_maps((8, 8)).mechanisms[0].maps)
    if set(fitted.maps) != set(drawn):
        wanted = ", ".join(sorted(drawn)) or "none"
        raise ValueError(f"{fitted.mechanism}: maps are {', '.join(sorted(fitted.maps))}, it has {wanted}")
    for name, measured in fitted.maps.items():
        shape = np.shape(measured)
        if len(shape) not in (2, 3) or 0 in shape or (len(shape) == 3 and shape[0] != 1):
            raise ValueError(f"{fitted.mechanism}: map {name} has shape {shape}, not [H, W]")
        if not isinstance(measured, jax.core.Tracer) and not np.isfinite(np.asarray(measured)).all():
            raise ValueError(f"{fitted.mechanism}: map {name} holds values that are not finite")


def check_point(id: str, point: Point) -> None:
    """A place in the grammar: words of its axes that go together, whole numbers that fit, a kernel where it
    needs one."""
    side = round(len(point.kernel) ** 0.5)
    if side**2 != len(point.kernel) or side % 2 == (point.spectrum != "kernel") or side > 65:
        raise ValueError(
            f"{id}: grammar kernel has {len(point.kernel)} values, not those of a square of odd side"
        )
    for axis, kind in get_type_hints(Point).items():
        choices = get_args(kind)
        if choices and axis not in ("blocks", "kernel") and getattr(point, axis) not in choices:
            value = reprlib.repr(getattr(point, axis))
            raise ValueError(f"{id}: grammar {axis} is {value}, not one of {', '.join(choices)}")
    known(point.signal, f"{id}: grammar signal")
    known(point.kernel, f"{id}: grammar kernel")
    if len(point.blocks) != 2 or not all(v and is_whole(v, 4096) for v in point.blocks):
        raise ValueError(f"{id}: grammar blocks is {reprlib.repr(point.blocks)}, not two whole numbers")
    counts = (point.group, point.phase, point.interleave)
    if not all(is_whole(v, 4096) for v in counts) or not (point.phase < point.group and point.interleave):
        raise ValueError(f"{id}: grammar group, phase, interleave are {counts}: phase is below group")
    wrong = contradiction(point)
    if wrong:
        raise ValueError(f"{id}: grammar: {wrong}")


def is_whole(value: Any, highest: int) -> bool:
    """Whether a value is a whole number from 0 to `highest`."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and 0 <= int(value) <= highest


def check_key(key: Any) -> None:
    """Raises TypeError for what is no single key of JAX."""
    if not isinstance(key, (jax.Array, np.ndarray)):
        raise TypeError(f"key is of type {type(key).__name__}: expected a key of JAX, as jax.random.key(0)")
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ()
    if not typed and not (key.dtype == np.uint32 and key.shape == (2,)):  # as jax.random.PRNGKey makes them
        raise TypeError(
            f"key is an array {key.dtype}{list(key.shape)}: expected one key, as jax.random.key(0)"
        )


def check_taken(clean: Any, settings: Settings) -> None:
    """What is recorded and how: a finite mosaic [H, W], and one setting (see `check_numbers`)."""
    if not isinstance(settings, Settings):
        raise TypeError(f"settings is a {type(settings).__name__}: expected Settings(iso=..., frames=...)")
    check_numbers(settings)  # again: what comes out of a tree of JAX was not checked
    for name in ("iso", "exposure_s", "temperature_c"):
        value = getattr(settings, name)
        if value is None and name != "temperature_c":  # among the axes of vmap None is one
            raise ValueError(f"{name} is None: give a number")
        if np.size(value) != 1:
            raise ValueError(f"{name} has {np.size(value)} values: give one, and jax.vmap for several")
    shape = np.shape(clean)
    if len(shape) != 2 or 0 in shape:
        raise ValueError(f"clean must be a mosaic [H, W], got shape {shape}")
    if isinstance(clean, np.ma.MaskedArray):
        raise ValueError("clean is a masked array: give the values to draw, as clean.filled(0)")
    if not isinstance(clean, jax.core.Tracer) and np.asarray(clean).dtype.kind == "b":
        raise ValueError(
            "clean holds truths, as a mask does: give the light on every pixel, 0 black, 1 white"
        )
    if not isinstance(clean, jax.core.Tracer) and np.asarray(clean).dtype.kind == "c":
        raise ValueError("clean holds complex values: give real ones")
    if not isinstance(clean, jax.core.Tracer) and not np.isfinite(np.asarray(clean)).all():
        raise ValueError("clean holds values that are not finite")
    if not isinstance(clean, jax.core.Tracer):
        _check_normalised(np.asarray(clean))


def _check_normalised(clean: np.ndarray) -> None:
    middle, least, most = float(median(clean)), float(clean.min()), float(clean.max())
    if most > BRIGHTEST and np.array_equal(clean, np.rint(clean)):
        raise ValueError(f"clean holds whole numbers up to {most:.4g}, {NOT_NORMALISED}")
    if middle > BRIGHTEST or least < DARKEST:
        raise ValueError(f"clean has median {middle:.4g} and lowest value {least:.4g}, {NOT_NORMALISED}")
