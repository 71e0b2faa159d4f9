"""The minimum detectable effect (MDE) of a capture set: what all of its frames together can show.

The likelihood-ratio test that knows an effect's form, with black level, gain and read noise unknown, has its
mean shifted by five null standard deviations. Knowing the form is knowing the law from which the effect
comes, not the draw: a known pattern (the step between two halves, the two greens) is a template; a pattern
that every camera draws anew (the offsets of rows, the gains of pixels, which pixels are hot) is a random
term, its places unknown, as in the table of one frame of the noise catalogue. Interference has a known
frequency and a new phase in every frame. Of what smears neighbours only the correlation of the noise
counts: a smeared mean could as well be that of the reference.

What every signature of the battery needs to find an effect is another matter: it searches places and
frequencies, keeps frames back and trusts fewer of the files' statements, see `not_found.detectable`.
"""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.frames.battery import Prepared, prepare
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.known_shape import known_kurtosis
from cannoise_jax.signatures.least import Seen
from cannoise_jax.signatures.signature import NO_STRENGTH, Signature


def mde(mechanism: str, capture: CaptureSet, multiple: float = 1.0) -> float | None:
    """Minimum detectable effect of a capture set: the amplitude at which the likelihood-ratio test that knows
    the effect's form, with black level, gain and read noise unknown, has its mean shifted by five null
    standard deviations over all frames together, or by `multiple` times that.

    In closed form from the fitted baseline, of sparse effects by simulation. None where no recording shows
    the mechanism, where its amplitude is no strength (a period, a level) or where no law is known.
    """
    prepared = prepare(capture, [list(range(r.count)) for r in capture.recordings], False)
    signatures = [s for s in prepared.signatures if s.mechanism == mechanism]
    if any(s.detectable is NO_STRENGTH for s in signatures):
        return None
    sets = seen_in(capture, prepared)
    law = next((law for s in signatures if (law := s.least(sets)) is not None), None)
    amplitude = law(5 * multiple) if law else _by_shift(signatures, prepared, multiple)
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
        frames=r.count,
        fresh=r.count - 1 + beside if averaged else r.count,
        known=not averaged,
        smooth=smooth,
        weight=f.usable / variance,
        signal=signal,
        shot=f.shot * f.usable if f.lit else np.zeros(variance.shape),
        read=np.clip(1 - f.shot - f.step**2 / 12 / variance, 0, 1) * f.usable,
        tails=np.asarray(known_kurtosis(f)[1] * f.usable, np.float64),
        exposure=(longest if r.exposure_s is None else r.exposure_s) / longest,
        seconds=r.exposure_s or 0.0,
        gain=float(np.mean(f.gain)),
    )


def _by_shift(signatures: list[Signature], prepared: Prepared, multiple: float) -> float:
    """The least amplitude by what one null standard deviation of the mechanism's own signatures is."""
    best = np.inf
    for signature in signatures:
        score = signature.score(prepared.fields)
        if score is not None and np.isfinite(score.shift):
            quoted = signature.quoted(score, str(signature.mechanism))
            best = min(best, quoted.shift * (5 * multiple) ** (1 / score.power))
    return best
