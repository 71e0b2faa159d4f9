"""The grammar of mechanisms: where it enters x what it varies over x how it behaves in time x how it scales x
its distribution or spectrum. Every point is a field of one random number per site, added to or multiplied
into the chain, and `mechanism_from_grammar` turns a point into a full mechanism: it can be sampled, its
effect is known in closed form, and it can be stored, whether the field has a name for it or not.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import Array

from cannoise_jax.physics.core import fields
from cannoise_jax.physics.core.grammar_effects import effect_of, signal_factor
from cannoise_jax.physics.core.mechanism import (
    ActsOn,
    Context,
    Mechanism,
    Parameter,
    Scaling,
    Stage,
    Values,
)
from cannoise_jax.physics.core.places import NO_LINE, Site, place

Time = Literal["frozen", "redrawn", "telegraph", "drifting", "modulated"]
Spectrum = Literal["white", "power_law", "sinusoid", "kernel"]
Distribution = Literal["gaussian", "tukey_lambda", "sparse"]
TIMES: tuple[Time, ...] = ("frozen", "redrawn", "telegraph", "drifting", "modulated")


@dataclass(frozen=True)
class Point:
    """A point of the grammar.

    over: the sites that carry one number each. "raster" orders the pixels as they are read; "frame" is one
      number per frame; "block" cuts the frame into `blocks` = (down, across) amplifier regions.
    time: "frozen" belongs to the camera unit; "redrawn" in every frame; "telegraph" jumps between two levels
      at fixed sites; "drifting" is redrawn with a memory of the frames before; "modulated" is a map of the
      camera unit times one number that is redrawn in every frame.
    combine: "add" or "multiply" into what the stage carries. signal: exponent p of a further factor
      (signal / white level)^p, for noise that grows with the signal otherwise than in proportion.
    spectrum: along the sites; a "sinusoid" of pixels is a plane wave; "kernel": pixels correlate with their
      neighbours, as white noise does after a filter by `kernel`, a square of odd side, row by row, of norm 1.
    distribution: of one number; "sparse": a few sites, exponential heights.
    group, phase: so many neighbouring rows (or columns) share one number, as where two are read at once;
      `phase` of the first group's lie before the frame. interleave: so many columns of a row (or rows of a
      column) take turns and have numbers of their own, as where even and odd columns are read apart.
    """

    stage: Stage
    acts_on: ActsOn
    over: Site
    time: Time
    combine: Literal["add", "multiply"] = "add"
    signal: float = 0.0
    spectrum: Spectrum = "white"
    distribution: Distribution = "gaussian"
    blocks: tuple[int, int] = (1, 2)
    group: int = 1
    phase: int = 0
    interleave: int = 1
    kernel: tuple[float, ...] = ()

    @property
    def plain(self) -> bool:
        """Whether every row (or column) has one number of its own."""
        return self.group == 1 and self.interleave == 1


def contradiction(point: Point) -> str | None:
    """What does not go together in a point, as one clause; None where all of it does."""
    spectrum, over, time, distribution = point.spectrum, point.over, point.time, point.distribution
    if not point.plain and (over not in ("row", "column") or spectrum != "white"):
        return "only rows and columns with a white spectrum come in groups"
    runs = place(over).lag is not NO_LINE or (spectrum, over) == ("sinusoid", "pixel")
    if spectrum in ("power_law", "sinusoid") and not runs:
        return f"a {spectrum} spectrum runs over rows, columns or the raster, not over {over}"
    if spectrum == "kernel" and over != "pixel":
        return f"a kernel filters pixels, not {over}"
    if spectrum != "white" and distribution != "gaussian":
        return f"a {spectrum} spectrum has no {distribution} distribution, it is gaussian"
    if time == "telegraph" and (spectrum != "white" or distribution == "tukey_lambda"):
        return f"a telegraph has two levels at sites of its own, no {spectrum} {distribution} field"
    if time == "modulated" and over != "pixel":
        return f"a map that is modulated has a number for every pixel, not for every {over}"
    if spectrum == "sinusoid" and time == "drifting":
        return "a sinusoid has a new phase in every frame or the same in all, it does not drift"
    return None


def amplitude_name(point: Point) -> str:
    """Name of the parameter that sets the strength: sigma_dn, sigma_e or sigma, amplitude for a sinusoid."""
    kind = "amplitude" if point.spectrum == "sinusoid" else "sigma"
    if point.combine == "multiply":
        return kind
    return f"{kind}_e" if point.acts_on == "mean" else f"{kind}_dn"


def point_parameters(point: Point, default: float) -> tuple[Parameter, ...]:
    """The parameters that a point of the grammar needs, strength first."""
    unit = {"_e": "e-", "dn": "DN"}.get(amplitude_name(point)[-2:], "1")
    top = 1e4 if point.combine == "add" else 1.0
    what = "peak" if point.spectrum == "sinusoid" else "rms"
    strength = "of the field" if point.combine == "add" else "as a fraction of the signal"
    found = [Parameter(amplitude_name(point), unit, default, 0.0, top, f"{what} {strength}")]
    if point.spectrum == "power_law":
        found.append(Parameter("exponent", "1", 1.0, 0.0, 2.0, "power falls as 1/f^exponent"))
    if point.spectrum == "sinusoid" and point.over == "pixel":
        found.append(Parameter("frequency_y", "cycles/pixel", 0.1, -0.5, 0.5, "cycles per row, down"))
        found.append(Parameter("frequency_x", "cycles/pixel", 0.1, 0.0, 0.5, "cycles per column, across"))
    elif point.spectrum == "sinusoid":
        step = {"raster": "pixel of the scan", "row": "row"}.get(point.over, point.over)
        found.append(Parameter("frequency", f"cycles/{point.over}", 0.1, 0.0, 0.5, f"cycles per {step}"))
    if point.distribution == "tukey_lambda":
        shape = "shape of the tails: 0.135 is Gaussian"
        found.append(Parameter("tukey_lambda", "1", -0.05, -0.24, 0.3, shape))
    if point.distribution == "sparse" or point.time == "telegraph":
        found.append(Parameter("fraction", "1", 0.01, 1e-6, 1.0, "share of the sites affected"))
    if point.time == "telegraph":
        found.append(Parameter("rate", "1/frame", 0.2, 0.0, 1.0, "chance of a jump per frame"))
    if point.time == "drifting":
        found.append(Parameter("memory_frames", "frames", 8.0, 0.1, 1e4, "correlation time"))
    return tuple(found)


def _fields(key, frames: int, point: Point, values: Values, context: Context) -> Array:
    """Unit-rms (unit-peak for a sinusoid) field [frames, ...] that broadcasts against x[T, H, W]."""
    size = context.size
    sites = fields.site_shape(point, size)
    if point.spectrum == "kernel":
        drawn = fields.neighbours(key, frames, size, point.kernel)
        return fields.remember(drawn, values["memory_frames"]) if point.time == "drifting" else drawn
    if point.spectrum == "sinusoid":
        if point.over == "pixel":
            return fields.plane_wave(key, frames, size, values["frequency_y"], values["frequency_x"])
        drawn = fields.sinusoid(key, frames, sites, values["frequency"], redrawn=point.time != "frozen")
    elif point.time == "telegraph":
        raise ValueError("a telegraph field needs its map of sites")
    else:
        coloured = point.spectrum == "power_law"
        if coloured:
            sites = (*sites[:-1], 2 * sites[-1])
        raw = fields.numbers(key, (frames, *sites), point.distribution, values)
        if coloured:
            raw = fields.colour(raw, values["exponent"])
        if point.time == "drifting":  # about its mean, which a sparse field has
            mean = fields.numbers_mean(point.distribution, values)
            drawn = mean + fields.remember(raw - mean, values["memory_frames"])
        else:
            drawn = raw
    return fields.spread(drawn, point, size)


def _draw_maps(point: Point):
    def draw(unit_key, values: Values, context: Context) -> dict[str, Array]:
        if point.time == "telegraph":
            where = fields.sparse_sites(
                unit_key, (1, *fields.site_shape(point, context.size)), values["fraction"]
            )
            return {"field": fields.spread(where, point, context.size)}
        return {"field": _fields(unit_key, 1, point, values, context)}

    return draw if point.time in ("frozen", "telegraph", "modulated") else None


def _strength(point: Point, name: str, values: Values, context: Context) -> Any:
    """Strength in the unit of what the stage carries, before any dependence on the signal."""
    strength = values[name]
    in_dn = point.combine == "add" and point.acts_on == "charge"
    return strength / context.gain_dn_per_e if in_dn else strength


def _sample(point: Point, name: str):
    def sample(key, x, values, maps, context):
        if point.time == "frozen":
            unit = maps["field"]
        elif point.time == "telegraph":
            levels = fields.telegraph(key, x.shape[0], fields.site_shape(point, context.size), values["rate"])
            unit = maps["field"] * fields.spread(levels, point, context.size)
        elif point.time == "modulated":
            unit = maps["field"] * fields.numbers(key, (x.shape[0], 1, 1), "gaussian", values)
        else:
            unit = _fields(key, x.shape[0], point, values, context)
        change = _strength(point, name, values, context) * unit * signal_factor(point, context)
        if point.combine == "add":
            return x + change
        level = context.black_level if point.acts_on in ("signal", "code") else 0.0
        return x + (x - level) * change

    return sample


def mechanism_from_grammar(
    point: Point,
    *,
    id: str = "unnamed",
    default: float | None = None,
    sentence: str = "A structure without a name: see where it enters and what it varies over.",
    equation: str | None = None,
    reference: str = "",
    needs: tuple[str, ...] = (),
    confused_with: tuple[str, ...] = (),
    scaling: Scaling | None = None,
    parameters: tuple[Parameter, ...] | None = None,
    amplitude=None,
    strength: str | None = None,
    of_light: bool = False,
) -> Mechanism:
    """The mechanism at a point of the grammar. What is not given follows from the point. Raises ValueError
    for axes that do not go together, see `contradiction`.

    scaling: default: a field in DN follows the gain, for it arises before the amplifier.
    strength: name of the parameter that sets the strength, when `parameters` name it otherwise.
    """
    wrong = contradiction(point)
    if wrong:
        raise ValueError(f"{id}: grammar: {wrong}")
    if parameters is None:
        parameters = point_parameters(point, default if default is not None else 0.01)
    name = strength or amplitude_name(point)
    if scaling is None:
        scaling = Scaling(gain=1.0 if name.endswith("_dn") else 0.0)
    if equation is None:
        symbol = {"add": "x + {s}\\,f", "multiply": "x\\,(1 + {s}\\,f)"}[point.combine]
        equation = "x \\to " + symbol.format(s="A" if point.spectrum == "sinusoid" else "\\sigma")
    return Mechanism(
        id=id,
        point=point,
        parameters=parameters,
        equation=equation,
        sentence=sentence,
        reference=reference,
        needs=needs,
        confused_with=confused_with,
        amplitude=amplitude or (lambda values, context: values[name]),
        sample=_sample(point, name),
        draw_maps=_draw_maps(point),
        effect=effect_of(point, name),
        of_light=of_light,
        scaling=scaling,
        scales=name,
    )


@functools.cache
def bare(point: Point, id: str) -> Mechanism:
    """The mechanism at a point of the grammar with nothing else given: one record for each, so that models
    that share a point share compiled code."""
    return mechanism_from_grammar(point, id=id)
