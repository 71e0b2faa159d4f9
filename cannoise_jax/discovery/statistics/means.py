"""Known shapes in the mean: a step in offset and glow, and what all templates in the mean share."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.fields import Fields, channel_index, least_squares
from cannoise_jax.discovery.statistics.lines import static_sums
from cannoise_jax.discovery.statistics.score import Probe, Score, normal_log_p, sidak

_DARK = ("dark", "bias")


class Described(NamedTuple):
    """What the files say, for the probes that judge it: black level, stated read noise and gain, greens."""

    black: np.ndarray
    greens: tuple[int, int] | None
    tolerance: float


def project(field: Fields, template: np.ndarray) -> np.ndarray:
    """Standardised template with what the recording's own mean fit takes away removed."""
    w = field.weight.astype(np.float64)
    channel = channel_index(w.shape)
    out = np.zeros(w.shape)
    for c in range(4):
        chosen = channel == c
        basis = [w[chosen]]
        if field.kind == "scene" and field.clean is not None:
            basis.append(w[chosen] * field.clean[chosen])
        b = np.stack(basis, 1)
        t = template[chosen] * w[chosen]
        out[chosen] = t - np.einsum("nk,k->n", b, least_squares(b, t))
    return out


def linear_score(
    probe: str,
    pairs: list[tuple[Fields, np.ndarray]],
    trials: float,
    unit: str,
    name: str,
    where: dict,
    sides: int = 2,
    rms: float = 1.0,
    payload=None,
) -> Score:
    """One amplitude for known standardised templates in the static fields of several recordings."""
    u = sum(float(np.sum(f.static * t)) * np.sqrt(f.frames) for f, t in pairs if f.static is not None)
    i = sum(float(np.sum(t**2)) * f.frames for f, t in pairs)
    z = u / np.sqrt(max(i, 1e-30))
    amplitude, error = u / max(i, 1e-30) * rms, rms / np.sqrt(max(i, 1e-30))
    gain = 0.5 * z**2 if sides == 2 or z > 0 else 0.0
    return Score(
        probe,
        sidak(normal_log_p(z, sides), trials),
        gain,
        float(np.log(trials) + 0.5 * np.log(1e5)) / 2,
        abs(amplitude),
        error,
        error,
        1,
        {name: (amplitude, unit, error)},
        where,
        payload,
    )


def minus(field: Fields, standardised: np.ndarray) -> Fields:
    """The field with a standardised mean template taken out of its static part."""
    assert field.static is not None
    return field._replace(static=(field.static - np.sqrt(field.frames) * standardised).astype(np.float32))


def step_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """A step in offset between two regions: the boundary is looked for along rows and along columns."""
    dark = tuple(f for f in fields if f.kind in _DARK and f.static is not None)
    if not dark:
        return None
    best: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    axis_best = "column"
    trials = 0.0
    for axis in ("row", "column"):
        sums = static_sums(dark, axis, "additive")
        if sums is None:
            continue
        total = sums.information.sum()
        u, i = np.cumsum(sums.score[::-1])[::-1], np.cumsum(sums.information[::-1])[::-1]
        i = i * (1 - i / total)
        inside = np.arange(8, u.size - 8)
        inside = inside[i[inside] > 1e-6 * total]  # lines at the border may have no usable pixel
        if not inside.size:
            continue
        trials += u.size / 8
        z = u[inside] / np.sqrt(np.maximum(i[inside], 1e-30))
        k = int(np.argmax(np.abs(z)))
        if abs(z[k]) > abs(best[0]):
            best, axis_best = (
                (z[k], float(inside[k]), u[inside[k]] / i[inside[k]], 1 / np.sqrt(i[inside[k]])),
                axis,
            )
    z, at, step, error = best
    if not error:
        return None
    where = {"axis": axis_best, "index": [int(at)]}
    return Score(
        probe,
        sidak(normal_log_p(z), trials),
        0.5 * z**2,
        float(np.log(trials)),
        abs(step),
        error,
        error,
        1,
        {"step": (step, "DN", error), "boundary": (at, "px", 1.0)},
        where,
        (axis_best, at, step),
    )


def step_absorb(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Subtracts the step from every static field."""
    axis, at, step = score.payload
    rows, columns = np.indices(fields[0].mean.shape)
    template = ((rows if axis == "row" else columns) >= at) * step
    return tuple(f if f.static is None else minus(f, project(f, template)) for f in fields)


@lru_cache(maxsize=4)
def glow_templates(size: tuple[int, int]) -> tuple[tuple[str, ...], np.ndarray]:
    """Exponential falls from every corner and edge, of four lengths, each of rms 1: names, [32, H W]."""
    h, w = size
    y, x = np.indices(size)
    names, out = [], []
    places = {
        "top left": np.hypot(y, x),
        "top right": np.hypot(y, w - 1 - x),
        "bottom left": np.hypot(h - 1 - y, x),
        "bottom right": np.hypot(h - 1 - y, w - 1 - x),
        "top": y,
        "bottom": h - 1 - y,
        "left": x,
        "right": w - 1 - x,
    }
    for place, distance in places.items():
        for length in (0.05, 0.1, 0.2, 0.4):
            g = np.exp(-distance / (length * max(h, w)))
            names.append(f"{place}, {length * max(h, w):.0f} px")
            out.append((g / np.sqrt(np.mean(g**2))).ravel().astype(np.float32))
    return tuple(names), np.array(out)


def glow_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """Light from a corner or edge in the darks, growing with the exposure where several are known."""
    dark = [f for f in fields if f.kind in _DARK and f.static is not None]
    if not dark:
        return None
    known = [f.exposure_s for f in dark if f.exposure_s]
    thermal = len(known) == len(dark)
    names, g = glow_templates(dark[0].mean.shape)
    channel = channel_index(dark[0].mean.shape).ravel()
    u, i = np.zeros(len(g)), np.zeros(len(g))
    for f in dark:
        assert f.static is not None
        scale = (f.exposure_s or 1.0) / max(known) if thermal else 1.0
        w, static = f.weight.ravel().astype(np.float32), f.static.ravel()
        u += np.sqrt(f.frames) * scale * (g @ (w * static)).astype(np.float64)
        i += f.frames * scale**2 * ((g**2) @ w**2).astype(np.float64)
        for c in range(4):  # the level of every channel is fitted too
            square = w[channel == c] ** 2
            total = max(float(np.sum(square, dtype=np.float64)), 1e-30)
            along = (g[:, channel == c] @ square).astype(np.float64)
            level = float(np.sum(w[channel == c] * static[channel == c], dtype=np.float64))
            u -= np.sqrt(f.frames) * scale * along * level / total
            i -= f.frames * scale**2 * along**2 / total
    z = u / np.sqrt(np.maximum(i, 1e-30))
    k = int(np.argmax(z))
    amplitude, error = float(u[k] / max(i[k], 1e-30)), float(1 / np.sqrt(max(i[k], 1e-30)))
    return Score(
        probe,
        sidak(normal_log_p(float(z[k]), 1), 24),
        0.5 * max(float(z[k]), 0.0) ** 2,
        float(np.log(24) + 0.5 * np.log(1e5)) / 2,
        abs(amplitude),
        error,
        error,
        1,
        {"glow": (amplitude, "DN", error)},
        {"axis": "edge", "edge": names[k]},
        (g[k].reshape(dark[0].mean.shape), abs(amplitude), max(known) if thermal else None),
    )


def glow_absorb(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Subtracts the glow from the darks, in proportion to the exposure."""
    g, amplitude, longest = score.payload
    out = []
    for f in fields:
        if f.static is None or f.lit:
            out.append(f)
            continue
        scale = (f.exposure_s or 1.0) / longest if longest else 1.0
        level = np.float32(np.mean(g) * amplitude * scale)
        out.append(minus(f, project(f, g * amplitude * scale))._replace(mean=f.mean - level))
    return tuple(out)


def probes() -> tuple[Probe, ...]:
    """The probes of this signature."""
    frozen = {"time": "frozen"}
    return (
        Probe(
            "step",
            "amplifier_mismatch",
            {**frozen, "enters": "readout", "varies_over": "amplifier", "scales": "additive", "law": "step"},
            partial(step_score, probe="step"),
            step_absorb,
        ),
        Probe(
            "glow",
            "amp_glow",
            {
                **frozen,
                "enters": "pixel",
                "varies_over": "block",
                "scales": "exposure",
                "law": "exponential fall",
            },
            partial(glow_score, probe="glow"),
            glow_absorb,
        ),
    )
