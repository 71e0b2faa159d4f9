"""The EMVA 1288 sheet as a page: the table, photon transfer, SNR, linearity, dark current, spectrograms."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from typing import Any

import jinja2
import numpy as np

from cannoise_jax.evaluation.svg import Series, plot


def sheet_page(
    camera: str, settings: Sequence[dict[str, Any]], made_by: str = "", notes: Sequence[str] = ()
) -> str:
    """The sheet as one HTML file, from `sheet_data.sheet_data`; made_by: a line on how it came about. notes:
    lines on what its numbers are of."""
    template = resources.files("cannoise_jax.evaluation").joinpath("sheet.html.jinja").read_text("utf-8")
    shown = [{**s, "figures": _figures(s)} for s in settings]
    page = jinja2.Template(template, autoescape=True)
    return page.render(camera=camera, settings=shown, made_by=made_by, notes=notes)


def _figures(s: dict[str, Any]) -> list[dict[str, str]]:
    names = s["channels"]
    mono = len(names) == 1
    chosen = range(len(names))
    colour = [1, 2, 3, 4] if not mono else [0, 0, 0, 0]
    label = [""] * 4 if mono else names
    t, out = s["transfer"], []
    transfer, snr, ideal = [], [], []
    for c in chosen:
        mean, variance = np.array(t["mean"][c]), np.array(t["variance"][c])
        transfer.append(Series(label[c], mean, variance, colour[c]))
        snr.append(Series(label[c], mean, mean / np.sqrt(np.maximum(variance, 1e-30)), colour[c]))
        if s["gain"] and len(mean):
            x = np.linspace(0, mean.max() * 1.05, 60)
            model = s["gain"][c] * x + s["read_noise_dn"][c] ** 2
            transfer.append(Series("", x, model, colour[c], line=True))
            x = np.geomspace(max(mean.min() / 30, 0.5), mean.max() * 1.2, 80)
            model = s["gain"][c] * x + s["read_noise_dn"][c] ** 2
            snr.append(Series("", x, x / np.sqrt(model), colour[c], line=True))
            if c == chosen[0]:
                alone = np.sqrt(x / s["gain"][c])
                ideal.append(Series("shot noise alone", x, alone, 5, line=True, dashed=True))
    out.append(_figure("Photon transfer", plot(transfer, "signal above black, DN", "temporal variance, DN²"),
                       "Points: recordings. Line: K times signal plus the dark variance."))  # fmt: skip
    out.append(_figure("SNR", plot([*snr, *ideal], "signal above black, DN", "SNR", log_x=True, log_y=True),
                       "Temporal noise only. Line: of the fitted gain and dark noise."))  # fmt: skip
    line = s["linearity"]
    if line:
        signal = [Series(label[c], line["seconds"], line["signal"][c], colour[c]) for c in chosen]
        ends = np.array([0.0, max(line["seconds"])])
        signal += [
            Series("", ends, line["fit"][c][0] + line["fit"][c][1] * ends, colour[c], line=True)
            for c in chosen
            if line["fit"][c]
        ]
        out.append(_figure("Linearity", plot(signal, "exposure, s", "signal above black, DN"),
                           "Line: least relative deviations from 5 to 95 % of the range."))  # fmt: skip
        away = [
            Series(
                label[c],
                line["seconds"],
                [np.nan if v is None else v for v in line["deviation"][c]],
                colour[c],
            )
            for c in chosen
        ]
        out.append(_figure("Deviation from the line", plot(away, "exposure, s", "deviation, %"),
                           "From 5 to 95 % of the range."))  # fmt: skip
    dark = s["dark"]
    if len(dark["seconds"]) > 1:
        means = [Series(label[c], dark["seconds"], dark["mean"][c], colour[c]) for c in chosen]
        out.append(_figure("Dark signal", plot(means, "exposure, s", "mean of the darks, DN"),
                           "Where the chip clamps black, the variance tells the dark current."))  # fmt: skip
        spread = [Series(label[c], dark["seconds"], dark["variance"][c], colour[c]) for c in chosen]
        out.append(_figure("Dark variance", plot(spread, "exposure, s", "temporal variance, DN²"),
                           "Of exposures with two frames or more."))  # fmt: skip
    for kind, unit in (("dark", "DN"), ("flat", "%")):
        found = s["spectra"].get(kind)
        if not found:
            continue
        series = [
            Series("along rows", found["rows"]["frequency"], found["rows"]["amplitude"], 1, line=True),
            Series(
                "along columns", found["columns"]["frequency"], found["columns"]["amplitude"], 4, line=True
            ),
        ]
        edges = [found["rows"]["frequency"][0], found["rows"]["frequency"][-1]]
        series.append(Series("temporal noise left", edges, [found["noise"]] * 2, 5, line=True, dashed=True))
        name = {"dark": "Spectrogram of DSNU", "flat": "Spectrogram of PRNU"}[kind]
        drawn = plot(series, "cycles per pixel", f"amplitude, {unit}", log_x=True, log_y=True)
        out.append(_figure(name, drawn,
                           "Of the mean frame; peaks are patterns."))  # fmt: skip
    return [f for f in out if f["svg"]]


def _figure(title: str, svg: str, note: str) -> dict[str, str]:
    return {"title": title, "svg": svg, "note": note}
