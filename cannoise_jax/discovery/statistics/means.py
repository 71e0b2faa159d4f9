"""Known shapes in the mean: steps, glow, channel contrasts, curvature, errors of the reference or
description."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.fields import Fields, channel_index, least_squares
from cannoise_jax.discovery.statistics.lines import static_sums
from cannoise_jax.discovery.statistics.score import Probe, Score, chi2_log_sf, normal_log_p, sidak

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
        trials += u.size / 8
        z = u[inside] / np.sqrt(np.maximum(i[inside], 1e-30))
        k = int(np.argmax(np.abs(z)))
        if abs(z[k]) > abs(best[0]):
            best, axis_best = (
                (z[k], float(inside[k]), u[inside[k]] / i[inside[k]], 1 / np.sqrt(i[inside[k]])),
                axis,
            )
    z, at, step, error = best
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
    return tuple(f if f.static is None else _minus(f, project(f, template)) for f in fields)


def _minus(field: Fields, standardised: np.ndarray) -> Fields:
    assert field.static is not None
    return field._replace(static=(field.static - np.sqrt(field.frames) * standardised).astype(np.float32))


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
        out.append(_minus(f, project(f, g * amplitude * scale))._replace(mean=f.mean - level))
    return tuple(out)


def green_score(fields: tuple[Fields, ...], *, probe: str, described: Described) -> Score | None:
    """Relative difference of the two green channels."""
    if described.greens is None:
        return None
    a, b = described.greens
    u = i = 0.0
    for f in fields:
        if f.static is None or not f.lit:
            continue
        channel = channel_index(f.mean.shape)
        level, variance = [], []
        for c in (a, b):
            chosen = (channel == c) & f.usable
            weight = f.weight[chosen].astype(np.float64) ** 2
            if f.kind == "scene":
                assert f.clean is not None
                x = f.clean[chosen] - np.average(f.clean[chosen], weights=weight)
                slope = np.sum(weight * x * f.mean[chosen]) / np.sum(weight * x**2)
                level.append(slope)
                variance.append(1 / np.sum(weight * x**2) / f.frames / slope**2)
            else:
                # Both greens at the sites of the second: a gradient of the light must not look like a
                # contrast.
                level_map = (_diagonal(f.mean) if c == a else f.mean)[1:-1, 1:-1]
                signal = float(np.mean(level_map[(channel == b)[1:-1, 1:-1]]) - f.black[c])
                dark = np.mean([np.median(g.sigma) ** 2 for g in fields if not g.lit] or [0.0])
                count = sum(g.frames for g in fields if not g.lit) * chosen.sum() or np.inf
                level.append(signal)
                variance.append(
                    (float(np.mean(f.sigma[chosen] ** 2)) / chosen.sum() / f.frames + dark / count)
                    / max(signal, 1e-6) ** 2
                )
        if min(level) <= 0:
            continue
        v = sum(variance)
        u += np.log(level[0] / level[1]) / v
        i += 1 / v
    if i == 0:
        return None
    z = u / np.sqrt(i)
    amplitude, error = abs(u / i) / 2, 0.5 / np.sqrt(i)
    return Score(
        probe,
        normal_log_p(z),
        0.5 * z**2,
        5.0,
        amplitude,
        error,
        error,
        1,
        {"relative_difference": (u / i, "1", 2 * error)},
        {"axis": "channel", "channel": "Gr-Gb"},
        u / i,
    )


def _diagonal(image: np.ndarray) -> np.ndarray:
    """Mean of the four diagonal neighbours, which are of the other green; wrong at the border."""
    p = np.pad(image.astype(np.float64), 1, mode="edge")
    return (p[:-2, :-2] + p[2:, 2:] + p[:-2, 2:] + p[2:, :-2]) / 4


def scale_score(fields: tuple[Fields, ...], *, probe: str, span: float, common: bool) -> Score | None:
    """Slope of every scene's mean against its reference: what all scenes share is an error of the description
    (white level, units), what they differ in one of the references."""
    values, errors, levels = [], [], []
    for f in fields:
        if f.kind != "scene" or f.static is None or f.clean is None:
            continue
        channel = channel_index(f.mean.shape)
        u = i = 0.0
        for c in range(4):
            chosen = (channel == c) & f.usable
            weight = f.weight[chosen].astype(np.float64) ** 2
            if weight.sum() == 0:
                continue
            x = f.clean[chosen] - np.average(f.clean[chosen], weights=weight)
            full = f.frames * np.sum(weight * x**2)
            if full > 0:
                slope = float(np.sum(weight * x * f.mean[chosen]) / np.sum(weight * x**2)) / span
                u, i = u + (slope - 1) * full * span**2, i + full * span**2
        if i > 0:
            values.append(u / i)
            errors.append(1 / np.sqrt(i))
            levels.append(float(np.sqrt(np.mean(f.signal**2))))
    if not values or (len(values) < 2 and not common):
        return None
    v, e = np.array(values), np.array(errors)
    mean = float(np.average(v, weights=1 / e**2))
    error = float(1 / np.sqrt(np.sum(1 / e**2)))
    level = float(np.mean(levels))
    if common:
        # The scatter between references bounds what is common to them.
        chi2 = float(np.sum(((v - mean) / e) ** 2))
        error *= max(np.sqrt(chi2 / max(len(v) - 1, 1)), 1.0)
        z = mean / error
        return Score(
            probe,
            normal_log_p(z),
            0.5 * z**2,
            5.0,
            abs(mean) * level,
            error * level,
            error * level,
            1,
            {"scale": (mean, "1", error)},
            {"axis": "signal", "range": [0.0, 1.0]},
        )
    chi2 = float(np.sum(((v - mean) / e) ** 2))
    k = int(np.argmax(np.abs(v - mean) / e))
    worst = float(np.std(v - mean)) * level
    return Score(
        probe,
        chi2_log_sf(chi2, len(v) - 1),
        chi2 / 2,
        2.5 * (len(v) - 1),
        worst,
        float(e[k]) * level,
        float(e[k]) * level,
        1,
        {"scale": (float(v[k]), "1", float(e[k]))},
        {"axis": "signal", "range": [0.0, 1.0]},
    )


def shading_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """Fall-off towards the corners of flats whose light is known."""
    u = i = 0.0
    for f in fields:
        if f.kind != "flat" or f.clean is None or f.static is None:
            continue
        h, w = f.mean.shape
        y, x = np.indices((h, w))
        fall = ((y - (h - 1) / 2) ** 2 + (x - (w - 1) / 2) ** 2) / (((h - 1) / 2) ** 2 + ((w - 1) / 2) ** 2)
        channel = channel_index((h, w))
        for c in range(4):
            chosen = (channel == c) & f.usable
            weight = f.weight[chosen].astype(np.float64) ** 2
            light = f.clean[chosen].astype(np.float64)
            mean = f.mean[chosen] - f.black[c]
            if weight.sum() == 0 or light.mean() <= 0:
                continue
            scale = np.sum(weight * light * mean) / np.sum(weight * light**2)
            t = -light * scale * (fall[chosen] - np.average(fall[chosen], weights=weight * light**2))
            full = f.frames * np.sum(weight * t**2)
            u += f.frames * np.sum(weight * t * (mean - scale * light))
            i += full
    if i == 0:
        return None
    z, amplitude, error = u / np.sqrt(i), u / i, float(1 / np.sqrt(i))
    return Score(
        probe,
        normal_log_p(z),
        0.5 * z**2,
        5.0,
        abs(amplitude),
        error,
        error,
        1,
        {"corner_loss": (float(amplitude), "1", error)},
        {"axis": "block", "bbox": None},
    )


def curvature_score(fields: tuple[Fields, ...], *, probe: str, span: float) -> Score | None:
    """Mean of the scenes against the square of their reference."""
    chosen = [f for f in fields if f.kind == "scene" and f.static is not None and f.clean is not None]
    if not chosen:
        return None
    pairs = [(f, project(f, -(f.clean**2) * span)) for f in chosen if f.clean is not None]
    high = float(max(np.max(f.clean) for f in chosen if f.clean is not None))
    return linear_score(
        probe, pairs, 1, "1", "curvature", {"axis": "signal", "range": [0.0, high]}, payload=span
    )


def curvature_absorb(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Subtracts the fitted curvature from the scenes."""
    value, span = score.parameters["curvature"][0], score.payload
    return tuple(
        _minus(f, project(f, -(f.clean**2) * span * value))
        if f.kind == "scene" and f.static is not None and f.clean is not None
        else f
        for f in fields
    )


def reference_templates(clean: np.ndarray, span: float, kind: str) -> list[np.ndarray]:
    """Change of the mean, DN, per unit: a shift of one pixel (down, right), or blur within the colour
    plane."""
    p = np.pad(clean.astype(np.float64), 2, mode="reflect")
    h, w = clean.shape
    up, down, left, right = p[:h, 2 : 2 + w], p[4:, 2 : 2 + w], p[2 : 2 + h, :w], p[2 : 2 + h, 4:]
    if kind == "shift":
        return [(down - up) / 4 * span, (right - left) / 4 * span]
    if kind == "blur":
        return [(up + down + left + right - 4 * clean) / 4 * span]
    p = np.pad(clean.astype(np.float64), 1, mode="reflect")
    return [
        (p[:h, 1 : 1 + w] + p[2:, 1 : 1 + w] + p[1 : 1 + h, :w] + p[1 : 1 + h, 2:] - 4 * clean) / 4 * span
    ]


def reference_score(fields: tuple[Fields, ...], *, probe: str, kind: str, span: float) -> Score | None:
    """Scenes against the derivatives of their references: a shift or blur per scene, crosstalk common
    to all."""
    chosen = [f for f in fields if f.kind == "scene" and f.static is not None and f.clean is not None]
    if not chosen:
        return None
    chi2, dof, values, errors = 0.0, 0, [], []
    shared_u = shared_i = 0.0
    for f in chosen:
        assert f.clean is not None and f.static is not None
        t = np.array([project(f, g).ravel() for g in reference_templates(f.clean, span, kind)]) * np.sqrt(
            f.frames
        )
        normal = np.einsum("kn,ln->kl", t, t)
        u = np.einsum("kn,n->k", t, f.static.ravel().astype(np.float64))
        if kind == "crosstalk":
            shared_u, shared_i = shared_u + float(u[0]), shared_i + float(normal[0, 0])
            continue
        beta = np.linalg.lstsq(normal, u, rcond=None)[0]
        chi2 += float(u @ beta)
        dof += len(beta)
        values.append(float(np.hypot(*beta)) if len(beta) == 2 else float(abs(beta[0])))
        errors.append(float(np.sqrt(np.trace(np.linalg.pinv(normal)) / len(beta))))
    unit = "px" if kind == "shift" else "1"
    where = {"axis": "edge", "edge": kind, "recordings": [f.name for f in chosen]}
    if kind == "crosstalk":
        z = shared_u / np.sqrt(shared_i)
        error = float(1 / np.sqrt(shared_i))
        return Score(
            probe,
            normal_log_p(z),
            0.5 * z**2,
            5.0,
            abs(shared_u / shared_i),
            error,
            error,
            1,
            {"fraction": (shared_u / shared_i, "1", error)},
            where,
        )
    k = int(np.argmax(values))
    return Score(
        probe,
        chi2_log_sf(chi2, dof),
        chi2 / 2,
        2.5 * dof,
        values[k],
        errors[k],
        errors[k],
        1,
        {kind: (values[k], unit, errors[k])},
        where,
    )


def drop_scenes(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """A scene whose reference is wrong says nothing static."""
    return tuple(f._replace(static=None) if f.kind == "scene" else f for f in fields)


_SCENE = (
    "reference_shift",
    "reference_blur",
    "reference_spread",
    "scene_static",
    "curvature",
    "reference_scale",
    "description_scale",
)


def drop_blurred(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Drops the scenes' static fields and whitens the correlation that a blur inside the camera leaves."""
    from cannoise_jax.discovery.statistics import covariance

    template, law = (
        ("crosstalk", "shot") if score.probe == "reference_spread" else ("in_camera_denoising", "white")
    )
    return covariance.absorb(
        drop_scenes(fields, score), score._replace(payload=(template, law, score.amplitude))
    )


def probes(described: Described, span: float) -> tuple[Probe, ...]:
    """The probes of this signature, for what the files of one capture set say."""
    from cannoise_jax.discovery.statistics.shape import unchanged

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
        Probe(
            "greens",
            "green_imbalance",
            {**frozen, "enters": "photons", "varies_over": "channel", "scales": "signal", "law": "contrast"},
            partial(green_score, probe="greens", described=described),
            unchanged,
            ("greens",),
        ),
        Probe(
            "reference_scale",
            "reference_error",
            {**frozen, "enters": "reference", "varies_over": "frame", "scales": "signal", "law": "scale"},
            partial(scale_score, probe="reference_scale", span=span, common=False),
            unchanged,
            ("reference_scale", "description_scale"),
        ),
        Probe(
            "description_scale",
            "bookkeeping",
            {**frozen, "enters": "reference", "varies_over": "channel", "scales": "signal", "law": "scale"},
            partial(scale_score, probe="description_scale", span=span, common=True),
            unchanged,
            ("reference_scale", "description_scale"),
        ),
        Probe(
            "shading",
            "lens_shading",
            {**frozen, "enters": "photons", "varies_over": "block", "scales": "signal", "law": "fall-off"},
            partial(shading_score, probe="shading"),
            unchanged,
            ("shading", "reference_scale", "description_scale"),
        ),
        Probe(
            "curvature",
            "nonlinearity",
            {
                **frozen,
                "enters": "converter",
                "varies_over": "signal",
                "scales": "signal squared",
                "law": "curve",
            },
            partial(curvature_score, probe="curvature", span=span),
            curvature_absorb,
            ("reference_scale", "description_scale"),
        ),
        Probe(
            "reference_shift",
            "misregistration",
            {**frozen, "enters": "reference", "varies_over": "edge", "scales": "signal", "law": "shift"},
            partial(reference_score, probe="reference_shift", kind="shift", span=span),
            drop_scenes,
            _SCENE,
        ),
        Probe(
            "reference_blur",
            "reference_error",
            {**frozen, "enters": "reference", "varies_over": "edge", "scales": "signal", "law": "blur"},
            partial(reference_score, probe="reference_blur", kind="blur", span=span),
            drop_blurred,
            (*_SCENE, "lags_in_camera_denoising", "lags_in_camera_denoising_8"),
        ),
        Probe(
            "reference_spread",
            "crosstalk",
            {**frozen, "enters": "pixel", "varies_over": "edge", "scales": "signal", "law": "spread"},
            partial(reference_score, probe="reference_spread", kind="crosstalk", span=span),
            drop_blurred,
            (*_SCENE, "lags_crosstalk"),
        ),
    )
