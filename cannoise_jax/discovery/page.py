"""The page of a report: one self-contained HTML file."""

from __future__ import annotations

import base64
import io
from typing import Any

import jinja2
import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from cannoise_jax.discovery.diagnose import Diagnosis
from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.lines import line_sums

_PAGE = jinja2.Template(
    """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{{ camera }}:
diagnosis</title><style>
body{font:16px/1.5 system-ui,sans-serif;color:#1c2430;max-width:60rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem}h2{margin-top:2.2rem;border-bottom:1px solid
#d8dee8}table{border-collapse:collapse;width:100%}
td,th{text-align:left;padding:.25rem .6rem;border-bottom:1px solid
#e6eaf0;vertical-align:top;font-size:.92rem}
.verdict{font-size:1.15rem;padding:.8rem 1rem;background:#eef3fb;border-left:4px solid #2f6fd0}
.finding{border:1px solid #d8dee8;border-radius:6px;padding:.6rem 1rem;margin:1rem 0}
.finding h3{margin:.2rem 0}img{max-width:100%}.soft{color:#5b6675;font-size:.9rem}code{font-size:.9em}
</style></head><body><h1>{{ camera }} against <code>{{ r.simulator }}</code></h1>
<p class="verdict">{{ verdict }}</p>
{% for f in r.findings %}<div class="finding"><h3>{{ f.mechanism.replace("_", " ") }}
<span class="soft">{{ f.class }}, {{ f.outcome }}, p = {{ "%.2g"|format(f.p_value) }}</span></h3>
<p>{{ f.sentence }}</p><table>
<tr><th>Candidates</th><td>{% for c in f.candidates %}{{ c.mechanism }}
{{ "%.3f"|format(c.probability) }}{{ ", " if not loop.last }}{% endfor %}</td></tr>
<tr><th>Where</th><td><code>{{ f.where }}</code></td></tr>
{% for n, p in f.parameters.items() %}<tr><th>{{ n.replace("_", " ") }}</th><td>{{ number(p.value) }} {{
p.unit if
p.unit != "1" }} (90 %: {{ number(p.ci90[0]) }} to {{ number(p.ci90[1]) }})</td></tr>{% endfor %}
{% if f.card %}<tr><th>Card</th><td><code>{{ f.card }}</code></td></tr>{% endif %}</table>
{% if pictures.get(loop.index0) %}<img alt="where" src="data:image/png;base64,{{ pictures[loop.index0]
}}">{% endif %}
</div>{% endfor %}
<h2>The simulator before and after</h2><table><tr><th></th><th>before</th><th>after</th></tr>
{% for n in ["nll_nats_per_pixel", "two_sample_auc", "two_sample_auc_ci90", "kl", "kl_floor"] %}<tr><th>{{
n.replace("_", " ") }}</th><td>{{ number(r.before[n]) }}</td><td>{{ number(r.after[n]) }}</td></tr>{%
endfor %}</table>
<p class="soft">The area under the curve is that of a small network that tells recordings from draws of
the simulator:
0.5 means that it cannot. Claims hold for this camera and new frames of it: frozen patterns were learned
on one half
of the frames.</p>{% if spectra %}<img alt="row spectra" src="data:image/png;base64,{{ spectra }}">{% endif %}
<h2>Looked for and not found</h2><table><tr><th>mechanism</th><th>smallest effect that this run would
have found in
half of all cases</th></tr>{% for n in r.not_found %}<tr><td>{{ n.mechanism }}</td><td>{% if
n.smallest_detectable %}{{
number(n.smallest_detectable.value) }} {{ n.smallest_detectable.unit if n.smallest_detectable.unit !=
"1" }}{% else
%}no scale of strength{% endif %}</td></tr>{% endfor %}</table>
<h2>Not testable with these recordings</h2><table><tr><th>mechanism</th><th>what to record</th></tr>
{% for n in r.not_testable %}<tr><td>{{ n.mechanism }}</td><td>{{ n.needs }}</td></tr>{% endfor %}</table>
<h2>Recordings</h2><table><tr><th>file</th><th>kind</th><th>frames</th><th>settings</th></tr>
{% for i in r.inputs %}<tr><td>{{ i.file }}</td><td>{{ i.kind }}</td><td>{{ i.frames }}</td><td>{{
i.settings }}</td>
</tr>{% endfor %}</table><p class="soft">Schema {{ r.schema }}, version {{ r.version }}, key {{ r.key
}}, family-wise
alpha {{ r.alpha }}.</p></body></html>""",
    autoescape=True,
)


def number(value: Any) -> str:
    """A number, or a pair of them, as the page prints it."""
    if value is None:
        return "not measured"
    if isinstance(value, (list, tuple)):
        return " to ".join(number(v) for v in value)
    return f"{value:.4g}"


def page(diagnosis: Diagnosis, report: dict[str, Any]) -> str:
    """The report as HTML with its pictures inside."""
    found = [f["mechanism"].replace("_", " ") for f in report["findings"]]
    verdict = {
        "match": "No mismatch: nothing that was tested differs from the simulator.",
        "not_testable": "Nothing could be tested with these recordings: see below what to record.",
        "mismatch": f"The recordings differ from the simulator by {', '.join(found)}.",
    }[report["verdict"]]
    order = {id(s): n for n, s in enumerate(diagnosis.fitted.steps)}
    pairs = list(zip(diagnosis.fitted.steps, diagnosis.proofs, strict=True))
    pairs.sort(key=lambda p: -(p[1].gain if p[1].gain is not None else -np.inf))
    pictures = {}
    for n, (step, _) in enumerate(pairs):
        after = (
            diagnosis.fitted.steps[order[id(step)] + 1].before
            if order[id(step)] + 1 < len(order)
            else (diagnosis.fitted.fields)
        )
        pictures[n] = _picture(step.before, after, step.named.score.where.get("axis", "pixel"))
    return _PAGE.render(
        camera=diagnosis.capture.camera,
        r=report,
        verdict=verdict,
        pictures=pictures,
        number=number,
        spectra=_spectra(diagnosis),
    )


def _png(figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90, bbox_inches="tight")
    plt.close(figure)
    return base64.b64encode(buffer.getvalue()).decode()


def _pooled(fields: tuple[Fields, ...]) -> np.ndarray:
    """Blocks of the static field of the darks (of everything where there are none), in standard errors."""
    chosen = [f for f in fields if f.static is not None and not f.lit] or [
        f for f in fields if f.static is not None
    ]
    if not chosen:
        chosen = list(fields)
    maps = [f.static if f.static is not None else f.contrasts.mean(0) for f in chosen]
    mean = np.mean(maps, axis=0) * np.sqrt(len(maps))
    b = max(min(mean.shape) // 48, 1)
    h, w = mean.shape[0] // b * b, mean.shape[1] // b * b
    return mean[:h, :w].reshape(h // b, b, w // b, b).mean((1, 3)) * b


def _picture(before: tuple[Fields, ...], after: tuple[Fields, ...], axis: str) -> str:
    """Where: the static map and the line profiles, before and after the mechanism is in the model."""
    figure, axes = plt.subplots(1, 3, figsize=(11, 2.8))
    for place, fields, title in ((axes[0], before, "static map before"), (axes[1], after, "after")):
        image = place.imshow(
            _pooled(fields), cmap="RdBu_r", vmin=-5, vmax=5, aspect="auto", interpolation="nearest"
        )
        place.set_title(title, fontsize=9)
        place.set_xticks([])
        place.set_yticks([])
    figure.colorbar(image, ax=axes[1], label="standard errors")
    line = "column" if axis == "column" else "row"
    for fields, label in ((before, "before"), (after, "after")):
        values = _profile(fields, line)
        if values.size:
            axes[2].plot(values, lw=0.9, label=label)
    axes[2].axhline(1, color="0.5", lw=0.7)
    axes[2].set_title(f"power of the {line} offsets over that of white noise", fontsize=9)
    axes[2].set_xlabel(line)
    axes[2].legend(fontsize=8, frameon=False)
    return _png(figure)


def _profile(fields: tuple[Fields, ...], line: str) -> np.ndarray:
    powers, number = 0.0, 0
    for f in fields:
        if len(f.contrasts):
            s = line_sums(f, f.contrasts, line, "additive")
            powers = powers + (s.score**2 / np.maximum(s.information, 1e-30)).sum(0)
            number += len(f.contrasts)
    if not number:
        return np.zeros(0)
    values = np.asarray(powers) / number
    width = max(values.size // 64, 1)
    return values[: values.size // width * width].reshape(-1, width).mean(1)


def _spectra(diagnosis: Diagnosis) -> str | None:
    """Spectrum of the row and column offsets before and after, and the curve of variance against signal."""
    figure, axes = plt.subplots(1, 3, figsize=(11, 2.8))
    for place, line in zip(axes, ("row", "column"), strict=False):
        for fields, label in ((diagnosis.first.fields, "before"), (diagnosis.fitted.fields, "after")):
            total, number = 0.0, 0
            for f in fields:
                if len(f.contrasts):
                    s = line_sums(f, f.contrasts, line, "additive")
                    x = s.score / np.sqrt(np.maximum(s.information, 1e-30))
                    total = total + (np.abs(np.fft.rfft(x, axis=1)) ** 2).sum(0) / x.shape[1]
                    number += len(x)
            if number:
                place.semilogy(np.asarray(total)[1:] / number, lw=0.9, label=label)
        place.set_title(f"spectrum of the {line} offsets", fontsize=9)
        place.set_xlabel("cycles per frame")
        place.legend(fontsize=8, frameon=False)
    for b in diagnosis.first.baselines:
        for c in range(4):
            points = [p for p in b.levels if p.channel == c]
            axes[2].loglog(
                [max(p.signal, 1e-1) for p in points],
                [max(p.variance, 1e-3) for p in points],
                ".",
                ms=4,
                color=f"C{c}",
            )
            if points:
                x = np.geomspace(0.1, max(max(p.signal for p in points), 1.0), 50)
                axes[2].plot(
                    x, b.read_dn[c] ** 2 + diagnosis.first.step**2 / 12 + b.gain[c] * x, lw=0.7, color=f"C{c}"
                )
    axes[2].set_title("temporal variance against signal (DN)", fontsize=9)
    return _png(figure)
