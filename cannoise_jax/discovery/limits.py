"""The minimum detectable effect (MDE) of a capture set: what all of its frames together can show.

The likelihood-ratio test that knows an effect's form, with black level, gain and read noise unknown, has its
mean shifted by five null standard deviations. Knowing the form is knowing the law from which the effect
comes, not the draw: a known pattern (the step between two halves, the two greens) is a template; a pattern
that every camera draws anew (the offsets of rows, the gains of pixels, which pixels are hot) is a random
term, its places unknown, as in the table of one frame of the noise catalogue. Interference has a known
frequency and a new phase in every frame. Of what smears neighbours only the correlation of the noise
counts: a smeared mean could as well be that of the reference.

What every probe of the battery needs to find an effect is another matter: it searches places and
frequencies, keeps frames back and trusts fewer of the files' statements, see `diagnose.detectable`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.discovery.battery import Prepared, prepare
from cannoise_jax.discovery.fields import Fields, channel_index, least_squares
from cannoise_jax.discovery.sparse import hot_amplitude, telegraph_amplitude
from cannoise_jax.discovery.stacks import surfaces
from cannoise_jax.discovery.statistics.light import fall_off
from cannoise_jax.discovery.statistics.reference import quoted
from cannoise_jax.discovery.statistics.shape import known_kurtosis
from cannoise_jax.recordings.recording import CaptureSet, Recording

NO_STRENGTH = ("saturation", "black_clipping", "quantization", "missing_codes")
"""Mechanisms whose amplitude says where, not how strongly, they act."""
_SURFACE = 4


class Seen(NamedTuple):
    """One recording with all of its frames.

    fresh: frames that what is redrawn shows in, less where the mean is the frames' own; known: whether what
    stays put shows in the mean; smooth: whether the light is only known to be smooth per channel. weight:
    1 / variance of a pixel in a frame where usable, else 0, DN^-2; signal: light above black, DN; shot, read:
    shares of the variance; tails: share of an excess kurtosis of the read noise that shows; exposure: share
    of the longest one; seconds: itself; gain: DN/e-.
    """

    frames: int
    fresh: float
    known: bool
    smooth: bool
    weight: Float[np.ndarray, "h w"]
    signal: Float[np.ndarray, "h w"]
    shot: Float[np.ndarray, "h w"]
    read: Float[np.ndarray, "h w"]
    tails: Float[np.ndarray, "h w"]
    exposure: float
    seconds: float
    gain: float


Load = Callable[[Seen], np.ndarray]
Law = Callable[[float], float]
"""Amplitude at which the mean is shifted by so many null standard deviations."""


def mde(mechanism: str, capture: CaptureSet, multiple: float = 1.0) -> float | None:
    """Minimum detectable effect of a capture set: the amplitude at which the likelihood-ratio test that knows
    the effect's form, with black level, gain and read noise unknown, has its mean shifted by five null
    standard deviations over all frames together, or by `multiple` times that.

    In closed form from the fitted baseline, of sparse effects by simulation. None where no recording shows
    the mechanism, where its amplitude is no strength (a period, a level) or where no law is known.
    """
    if mechanism in NO_STRENGTH:
        return None
    prepared = prepare(capture, [list(range(r.count)) for r in capture.recordings], False)
    law = _law(mechanism, seen_in(capture, prepared), prepared.span, capture.recordings[0].cfa)
    amplitude = law(5 * multiple) if law else _by_probes(mechanism, prepared, multiple)
    return float(amplitude) if np.isfinite(amplitude) else None


def seen_in(capture: CaptureSet, prepared: Prepared) -> tuple[Seen, ...]:
    """What the fitted baseline says of every recording, all of its frames counted."""
    recordings = [capture.recordings[f.number] for f in prepared.fields]
    longest = max((r.exposure_s or 0.0 for r in recordings), default=0.0) or 1.0
    return tuple(_seen(r, f, longest) for r, f in zip(recordings, prepared.fields, strict=True))


def _seen(r: Recording, f: Fields, longest: float) -> Seen:
    variance = f.sigma.astype(np.float64) ** 2
    averaged = f.kind == "scene" and (r.clean is None or r.reference == "burst_mean")
    # Frames against a mean of so many others, or of more among which they are.
    smooth = f.kind == "flat" and r.clean is None
    signal = f.signal.astype(np.float64) if f.lit else np.zeros(variance.shape)
    if smooth:  # what the fitted surface bends by is the light's or noise
        level = [float(np.mean(signal[channel_index(signal.shape) == c])) for c in range(4)]
        signal = np.array(level)[channel_index(signal.shape)]
    beside = max(0.0, 1 - r.count / r.reference_frames) if r.clean is not None and r.reference_frames else 0.0
    return Seen(
        r.count,
        r.count - 1 + beside if averaged else r.count,
        not averaged,
        smooth,
        f.usable / variance,
        signal,
        f.shot * f.usable if f.lit else np.zeros(variance.shape),
        np.clip(1 - f.shot - f.step**2 / 12 / variance, 0, 1) * f.usable,
        np.asarray(known_kurtosis(f)[1] * f.usable, np.float64),
        (r.exposure_s or longest) / longest,
        r.exposure_s or 0.0,
        float(np.mean(f.gain)),
    )


def _one(s: Seen) -> np.ndarray:
    return np.ones(s.weight.shape)


def _signal(s: Seen) -> np.ndarray:
    return s.signal


def _law(mechanism: str, sets: tuple[Seen, ...], span: float, cfa: str) -> Law | None:
    """How the shift of a mechanism grows in these recordings; None where only its probe knows."""
    size = sets[0].weight.shape
    y, x = np.mgrid[: size[0], : size[1]]
    match mechanism:
        case "row_noise" | "row_fpn":
            return _random(sets, _one, y, frozen=mechanism == "row_fpn")
        case "column_noise" | "column_fpn":
            return _random(sets, _one, x, frozen=mechanism == "column_fpn")
        case "column_gain":
            return _random(sets, _signal, x, frozen=True)
        case "dsnu" | "prnu":
            return _random(sets, _one if mechanism == "dsnu" else _signal, y * size[1] + x, frozen=True)
        case "offset_drift":
            return _frame_offsets(sets)
        case "row_pink_noise":
            return _pink(sets, lambda s: s.weight.sum(1))
        case "pink_noise":
            return _pink(sets, lambda s: s.weight.ravel())
        case "banding" | "flicker":
            return _sinusoid(sets, _one if mechanism == "banding" else _signal)
        case "channel_offset":
            return _template(sets, lambda s: 1.0 - 2 * (y % 2 != x % 2), common=True)
        case "amplifier_mismatch":
            return _template(sets, lambda s: (x >= size[1] // 2) - 0.5)
        case "green_imbalance" if cfa != "MONO":
            greens = [n for n, letter in enumerate(cfa) if letter == "G"]
            sign = np.array([(n == greens[0]) - 1.0 * (n == greens[-1]) for n in range(4)])
            return _template(sets, lambda s: s.signal * sign[channel_index(size)])
        case "nonlinearity":
            return _template(sets, lambda s: s.signal**2 / span)
        case "lens_shading":
            return _template(sets, lambda s: s.signal * fall_off(size))
        case "dark_current":
            return _template(sets, lambda s: s.gain * s.seconds * np.ones(size))
        case "amp_glow":  # from a corner, a fifth of the longer side deep
            glow = np.exp(-np.hypot(y, x) / (0.2 * max(size)))
            return _template(sets, lambda s: glow / np.sqrt(np.mean(glow**2)) * s.exposure)
        case "heavy_tails":
            return _pooled(s.frames * np.sum(s.tails**2) / 24 for s in sets)
        case "crosstalk":
            return _pooled(s.fresh * _shared_charge(s) for s in sets)
        case "in_camera_denoising":
            return _pooled(s.fresh * np.sum(s.weight > 0) / 2 for s in sets)
        case "pixel_read_noise_map":
            return _read_map(sets)
        case "hot_pixels":
            information = sum(s.frames * s.exposure**2 * s.weight for s in sets if s.known)
            return lambda shift: hot_amplitude(np.asarray(information), shift)
        case "rts":
            frames = [(float(np.sqrt(np.mean(s.weight**2))), round(s.fresh)) for s in sets]
            return lambda shift: telegraph_amplitude(frames, y.size, shift)
    return None


def _grows(information: float, power: int) -> Law:
    """Shift = sqrt(information) * amplitude ** power."""
    return lambda shift: (shift / np.sqrt(information)) ** (1 / power) if information > 0 else np.inf


def _pooled(informations) -> Law:
    """Pixels that each tell by themselves."""
    return _grows(float(sum(informations)), 1)


def _shared_charge(s: Seen) -> float:
    """Information of a frame about the share of charge given away: a quarter of it goes to each neighbour and
    takes its shot noise along, so that two of them have the covariance a (S_i + S_j) / 4."""
    charge = np.divide(s.shot, s.weight, out=np.zeros_like(s.weight), where=s.weight > 0)
    total = 0.0
    for v, w in ((charge, s.weight), (charge.T, s.weight.T)):
        total += float(np.sum((v[1:] + v[:-1]) ** 2 * w[1:] * w[:-1]))
    return total / 16


def _template(sets: tuple[Seen, ...], load: Load, common: bool = False) -> Law:
    """A known pattern in the mean: its norm once black level (per channel, or `common` to all) and one factor
    of the signal are fitted too, and of flats of unknown light a smooth surface per channel."""
    gram = np.zeros((6, 6))
    for s in sets:
        if not s.known:
            continue
        root = np.sqrt(s.frames * s.weight)
        channel = channel_index(root.shape)
        pattern = np.broadcast_to(load(s) * root, root.shape)
        if s.smooth:
            gram[0, 0] += sum(
                _beyond_surface(pattern[channel == c], root[channel == c], root.shape, c) for c in range(4)
            )
            continue
        levels = [(root if c == 0 else 0 * root) if common else root * (channel == c) for c in range(4)]
        basis = np.stack([pattern, *levels, s.signal * root]).reshape(6, -1)
        gram += np.einsum("kn,ln->kl", basis, basis)
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    scaled = gram * np.outer(scale, scale)
    rest = np.linalg.lstsq(scaled[1:, 1:], scaled[1:, 0], rcond=1e-10)[0]
    left = float(scaled[0, 0] - scaled[0, 1:] @ rest)
    return _grows(gram[0, 0] * left if left > 1e-7 else 0.0, 1)


def _beyond_surface(pattern: np.ndarray, root: np.ndarray, size: tuple[int, int], c: int) -> float:
    """Square of a weighted pattern of one channel that no smooth surface takes away."""
    basis = surfaces(size, _SURFACE, c) * root[:, None]
    left = float(np.sum((pattern - basis @ least_squares(basis, pattern)) ** 2))
    return left if left > 1e-6 * float(np.sum(pattern**2)) else 0.0


def _random(sets: tuple[Seen, ...], load: Load, group: np.ndarray, frozen: bool) -> Law:
    """Random offsets (or factors) of groups of pixels: d^2 = a^4 / 2 (sum of squares of the information of
    every draw, less that of the single pixels in it, whose variance alone gain and read noise take up)."""
    total, shared = 0.0, np.zeros(int(group.max()) + 1)
    for s in sets:
        own = s.weight * load(s) ** 2
        groups = np.bincount(group.ravel(), own.ravel())
        if not frozen:
            total += s.fresh * float(np.sum(groups**2) - np.sum(own**2))
        elif s.known:
            shared += s.frames * groups
            total -= s.frames * float(np.sum(own**2))
    return _grows((total + float(np.sum(shared**2))) / 2, 2)


def _frame_offsets(sets: tuple[Seen, ...]) -> Law:
    """An offset of every frame about a black level that is unknown."""
    i = np.array([s.weight.sum() for s in sets])
    n = np.array([s.fresh for s in sets])
    first, second, third = (float(np.sum(n * i**k)) for k in (1, 2, 3))
    single = float(np.sum([s.fresh * np.sum(s.weight**2) for s in sets]))
    return _grows((second - 2 * third / first + second**2 / first**2 - single) / 2, 2)


def _pink(sets: tuple[Seen, ...], series: Callable[[Seen], np.ndarray]) -> Law:
    """A series of power 1/f, new in every frame: d^2 = a^4 / 2 sum_ij w_i w_j R_ij^2 without i = j, R the
    series' correlation, a function of the lag."""
    total = 0.0
    for s in sets:
        w = series(s)
        f = np.fft.rfftfreq(w.size)
        power = np.divide(1, f, out=np.zeros_like(f), where=f > 0)
        lag = np.fft.irfft(power, w.size)
        pairs = np.fft.irfft(np.abs(np.fft.rfft(w)) ** 2, w.size)
        # A single pixel's own variance is taken up by the read noise; a row's stands against its pixels'.
        own = float(np.sum(s.weight**2))
        total += s.fresh * (float(np.sum(pairs * (lag / lag[0]) ** 2)) - own)
    return _grows(total / 2, 2)


def _sinusoid(sets: tuple[Seen, ...], load: Load) -> Law:
    """A wave of known frequency and a new phase in every frame: the power at its frequency is exponential,
    its mean one more by a^2 I / 4, I the frame's information about an offset of that load."""
    return _grows(sum(s.fresh * (np.sum(s.weight * load(s) ** 2) / 4) ** 2 for s in sets), 2)


def _read_map(sets: tuple[Seen, ...]) -> Law:
    """Spread a of the read noise over pixels, the same in all frames: its relative variance 2 g a, g normal,
    against the information of every pixel, and the heavy tails that it gives to every frame."""
    information = sum(s.frames * s.read**2 / 2 for s in sets)
    single = sum(s.frames * np.sum(s.read**4) for s in sets)
    return _grows(16 * (float(np.sum(np.square(information))) + float(single) / 2) / 2, 2)


def _by_probes(mechanism: str, prepared: Prepared, multiple: float) -> float:
    """The least amplitude by what one null standard deviation of the mechanism's own probes is."""
    best = np.inf
    for probe in prepared.probes:
        if probe.mechanism == mechanism:
            score = probe.score(prepared.fields)
            if score is not None and np.isfinite(score.shift):
                best = min(best, quoted(score, mechanism).shift * (5 * multiple) ** (1 / score.power))
    return best
