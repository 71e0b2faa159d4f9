"""Codes that are farther apart the brighter they are: lossy compression.

How often a code should have occurred is known from the means of the pixels and their noise. Codes that are
missing evenly are another mechanism."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy import ndimage, stats

from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.recorded import Occurred, Recorded
from cannoise_jax.signatures.score import OF_A_CURVE, Score
from cannoise_jax.signatures.signature import FILES, Axes, Signature, unchanged

_LEAST = 20.0
"""Expected occurrences of a code from which its absence tells."""


def occurrences(stacks, fields: tuple[Fields, ...], chosen, step: float) -> Occurred:
    """Occurrences of every code in all recordings, and the codes that should have occurred: the means of the
    pixels, spread by the least noise of each sixteenth of the signals."""
    size = int(65536 // step) + 1
    values, expected = np.zeros(65536), np.zeros(size)
    for s, f in zip(stacks, fields, strict=True):
        used = f.usable & (f.sigma > 1.0 * step)
        if used.mean() < 0.02:
            continue
        means, sigma = f.mean[used], f.sigma[used]
        if f.static is not None:
            means = means + f.static[used] * sigma / np.sqrt(f.frames)
        frames = chosen[s.number][: f.frames]
        edges = np.unique(np.quantile(means, np.linspace(0, 1, 17)))
        for low, high in (
            zip(edges, edges[1:], strict=False) if edges.size > 1 else [(means.min(), means.max())]
        ):
            part = (means >= low) & (means <= high)
            if not part.any():
                continue
            code = np.clip(means[part] / step, 0, size - 1).astype(np.int64)
            width = max(float(np.quantile(sigma[part], 0.05)) / step, 0.3)
            reach = int(6 * width) + 1
            window = slice(max(code.min() - reach, 0), min(code.max() + reach + 1, size))
            each = np.bincount(code - window.start, minlength=window.stop - window.start)
            expected[window] += len(frames) * ndimage.gaussian_filter1d(
                each.astype(float), width, mode="constant", truncate=4
            )
        for t in frames:
            frame = np.asarray(s.recording.frames[t : t + 1])[0]
            found = np.bincount(frame.astype(np.int64).ravel())
            values[: found.size] += found
    stored = np.flatnonzero(values)  # few: to divide every pixel takes long
    counts = np.bincount((stored // step).astype(np.int64), weights=values[stored], minlength=size)
    index = np.flatnonzero(expected > _LEAST)
    return Occurred(index, expected[index], counts[index] == 0, step)


def _wider(code: np.ndarray, missing: np.ndarray) -> float:
    """log p that the gaps between codes that occur are no wider the brighter (Kendall's tau): of few codes
    far apart most are missing everywhere."""
    order = np.argsort(code)
    code, number = code[order], np.arange(code.size)
    there = np.flatnonzero(~missing[order])
    # Across codes that were not to be expected a gap says nothing.
    known = np.diff(code[there]) == np.diff(number[there])
    gaps = np.diff(code[there])[known]
    if gaps.size < 8 or np.ptp(gaps) == 0:
        return 0.0
    return float(np.log(max(stats.kendalltau(np.arange(gaps.size), gaps, alternative="greater")[1], 1e-300)))


def compression_score(fields, *, codes: Occurred, black: float, span: float) -> Score | None:
    """Codes that never occur, the more of them the brighter. Amplitude: spacing at the white level, DN."""
    if codes.code.size < 100:
        return None
    signal = codes.code * codes.step - black
    lit = signal > 0.002 * span
    if lit.sum() < 100:
        return None
    signal, missing, expected = signal[lit], codes.missing[lit], codes.expected[lit]
    order = np.argsort(signal)
    signal, missing = signal[order], missing[order]
    log_p = -float(np.sum(np.minimum(expected[order], 60.0)[missing]))
    parts = np.array_split(np.arange(signal.size), 4)
    spacing = np.array([len(k) / max(int((~missing[k]).sum()), 1) for k in parts])
    level = np.array([float(np.mean(signal[k])) for k in parts])
    low, high = np.concatenate(parts[:2]), np.concatenate(parts[2:])
    table = [[missing[high].sum(), (~missing[high]).sum()], [missing[low].sum(), (~missing[low]).sum()]]
    rarer = float(np.log(max(stats.fisher_exact(table, alternative="greater")[1], 1e-300)))
    grows = min(rarer, _wider(codes.code[lit], codes.missing[lit])) + np.log(2)
    sure = spacing > 1.02
    if sure.sum() >= 2 and spacing[sure].max() > 1.15 * spacing.min():
        exponent = float(np.polyfit(np.log(level[sure]), np.log(spacing[sure]), 1)[0])
    else:
        exponent, grows = 0.0, 0.0
    exponent = float(np.clip(exponent, 0.0, 0.95))
    at_white = float(spacing[-1] * (span / level[-1]) ** exponent * codes.step)
    error = 0.05 * at_white
    both = max(log_p, grows)
    return Score(
        log_p=float(np.clip(both, -700, 0)),
        gain=-log_p if grows < -5 else 0.0,
        penalty=OF_A_CURVE,
        amplitude=at_white,
        error=error,
        shift=codes.step / 5,
        power=1,
        parameters={"step": (at_white, "DN", error), "exponent": (exponent, "1", 0.1)},
        where={"axis": "signal", "range": [float(level[0]), float(level[-1])]},
    )


def spacing(
    recorded: Recorded, *, name: str, covers: tuple[str, ...], lifted_by: tuple[str, ...]
) -> Signature:
    """Codes that are farther apart the brighter they are."""
    black = float(recorded.black.mean())
    return plain(
        name=name,
        axes=Axes("converter", "signal", "frozen", "signal", "spacing of codes"),
        reads=FILES,
        score=partial(compression_score, codes=recorded.occurred, black=black, span=recorded.span),
        absorb=unchanged,
        simulate=carried(lambda s: {"step_dn": s.amplitude, "exponent": s.parameters["exponent"][0]}),
        covers=covers,
        lifted_by=lifted_by,
        rare=True,
    )
