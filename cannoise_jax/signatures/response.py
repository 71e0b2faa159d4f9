"""A response that bends, as flats without a reference tell it.

Let the mean signal be y = x (1 - a (x / S)^p) of the linear signal x (DN, S from black to white), a parabola
as in `curvature` where p is one. Then the variance of pixels of one signal is

    v = r^2 + K x (1 - (p + 1) a (x / S)^p)^2,

so a photon-transfer curve tells a and p by itself: of a curve that a parabola misses, p is that which misses
it least. Charge that repels further charge bends that curve as well, and leaves the mean where it is. Under
one lamp the mean over the exposure t,

    log(y / t) = const + log(1 - a (x / S)^p),

falls with the signal in the first case only. p is chosen by it only among those between which the variance
does not choose, where it does not fall as a parabola; these share as much chance again. How far single
flats lie off that line says how steady lamp and shutter are, and with it how well the slope is known:
Student's t.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from cannoise_jax.physics.transfer.bent import signal_of_order
from cannoise_jax.signatures.added import strength
from cannoise_jax.signatures.black_charge import charge_in_black
from cannoise_jax.signatures.curvature import bent_light, order_of
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.plain import plain
from cannoise_jax.signatures.recorded import GroupBaseline, Level, Recorded
from cannoise_jax.signatures.score import ONE_PARAMETER, Score, normal_log_p
from cannoise_jax.signatures.signature import FILES, Axes, Signature, unchanged

_MOST = 0.8
"""Loss at white, at most, over that of a curve that has its top there: of a parabola 1/4."""
_ORDERS = (1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 3.5, 4.0)
"""Powers of the signal by which what is lost may grow."""
_EVEN = 2 * float(np.sqrt(12))
"""Standard deviations of an even law between the middles of three values, in what the outer two are apart."""
_MISSED = 9.0
"""Chi-square below that of a parabola, from which on another order is no chance: three standard errors."""
_FEWEST = 3
"""Exposures of flats from which on a line through them can be missed."""
_SURE = 0.95
"""Confidence that the means fall, one-sided, before their cause is named. The variance decides whether
anything bends."""
_APART = 3.0
"""Standard errors by which both losses may differ."""
_STEADY = 1e-3
"""Share of the light by which lamps and shutters scatter at least: three flats lie on a line by chance."""


class OfVariance(NamedTuple):
    """A loss at white, its standard error, the nats that it explains, and the order of the curve with its
    own error."""

    loss: float
    error: float
    gain: float
    order: float = 1.0
    order_error: float = 0.0


class OfMeans(NamedTuple):
    """A loss at white, its standard error, the degrees of freedom of that, and by which share of the light
    flats scatter about the line."""

    loss: float
    error: float
    freedom: int
    scatter: float


Curves = Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Signal, variance less the read noise's, and its standard error, of channels."""
Points = Sequence[tuple[int, int, float]]
"""Gain setting, recording and mean signal, DN, of flats."""


def by_variance(curves: Curves, span: float, order: float | None = None) -> OfVariance:
    """The loss and the order that photon-transfer curves have in common, each with a gain of its own: order 1
    where no other is better by more than chance. Of others the loss at white, which none of the flats has,
    is as unsure as the order. order: None where it is not known."""
    if order is not None:
        return _of_order(curves, span, order)[0]
    return allowed_by_variance(curves, span)[0]


def allowed_by_variance(curves: Curves, span: float) -> list[OfVariance]:
    """`by_variance`, and where that is of order 1 without need the others, which are as good but for
    chance."""
    told = {order: _of_order(curves, span, order) for order in _ORDERS}
    least = min(chi2 for _, chi2 in told.values())
    freedom = max(sum(len(y) for y, _, _ in curves) - len(curves) - 2, 1)
    scale = max(least / freedom, 1.0)
    if freedom < 2 or told[1.0][1] - least < _MISSED * scale:
        others = (found for found, chi2 in list(told.values())[1:] if chi2 - least < _MISSED * scale)
        return [told[1.0][0], *others]
    logs = np.array([least - told[order][1] for order in _ORDERS]) / 2 / scale
    return [_unsure([told[order][0] for order in _ORDERS], logs, int(np.argmax(logs)))]


def _unsure(found: Sequence[OfVariance], logs: np.ndarray, n: int) -> OfVariance:
    """The curve of number n, of some order, with what those of the others add to its errors. logs: of how
    likely each is."""
    weights = np.exp(logs - np.max(logs))
    losses, orders = np.array([f.loss for f in found]), np.array([f.order for f in found])
    # Between two of those that are tried neither is known better than by half of what they are apart.
    at = _ORDERS.index(found[n].order)
    apart = np.ptp(losses[max(n - 1, 0) : n + 2]), np.ptp(_ORDERS[max(at - 1, 0) : at + 2])
    unsure, order_error = (
        float(np.hypot(np.sqrt(np.average((v - v[n]) ** 2, weights=weights)), step / _EVEN))
        for v, step in zip((losses, orders), apart, strict=True)
    )
    error = float(np.hypot(found[n].error, unsure))
    return found[n]._replace(error=error, order_error=order_error)


def _of_order(curves: Curves, span: float, order: float) -> tuple[OfVariance, float]:
    """The loss of curves of one order, and the chi-square that it leaves."""

    def chi2(loss: float) -> float:
        total = 0.0
        for y, v, e in curves:
            x = signal_of_order(y, loss, span, order)
            model = x * (1 - (order + 1) * loss * (x / span) ** order) ** 2 / e
            gain = float(model @ (v / e)) / float(model @ model)
            total += float(np.sum((v / e - gain * model) ** 2))
        return total

    most = _MOST * (order / (order + 1)) ** order / (order + 1)
    best = optimize.minimize_scalar(chi2, bounds=(-most, most), method="bounded", options={"xatol": 1e-6})
    loss, least = float(best.x), float(best.fun)
    freedom = sum(len(y) for y, _, _ in curves) - len(curves) - 1
    step = 1e-3
    bend = (chi2(loss + step) - 2 * least + chi2(loss - step)) / step**2
    # What this curve leaves belongs to no loss, and makes it less sure.
    scale = max(least / max(freedom, 1), 1.0)
    error = float(np.sqrt(2 * scale / max(bend, 1e-12)))
    return OfVariance(loss, error, 0.5 * max(chi2(0.0) - least, 0.0) / scale, order), least


def by_mean(log_rate: np.ndarray, bend: np.ndarray, group: np.ndarray) -> OfMeans | None:
    """The loss of flats: log of signal over exposure, log(1 - a (x / S)^p) over a of each, and what they
    share the light and the gain with. None where that cannot be told from the lamp."""
    own = {g: group == g for g in set(group.tolist())}
    own = {g: which for g, which in own.items() if np.count_nonzero(which) >= _FEWEST}
    freedom = sum(map(np.count_nonzero, own.values())) - len(own) - 1
    if freedom < 1:
        return None
    y, x = (np.concatenate([v[w] - v[w].mean() for w in own.values()]) for v in (log_rate, bend))
    power = float(x @ x)
    if power <= 0:
        return None
    loss = float(x @ y) / power
    scatter = max(float(np.sqrt(np.sum((y - loss * x) ** 2) / freedom)), _STEADY)
    return OfMeans(loss, scatter / np.sqrt(power), freedom, scatter)


def response_score(
    fields: tuple[Fields, ...],
    found: Score | None = None,
    *,
    baselines: tuple[GroupBaseline, ...],
    step: float,
    span: float,
    darks: Sequence[Fields] = (),
) -> Score | None:
    """The photon-transfer curve of a response that bends, where the means of flats over their exposures say
    so as well. None without flats of three exposures. found: in other frames, which tell its order. darks: as
    they were recorded, which tell what of the light is dark charge in the black level."""
    seconds = {f.number: f.exposure_s for f in fields if f.kind == "flat" and f.clean is None}
    longest = max((float(s) for s in seconds.values() if s), default=0.0)
    charge = charge_in_black(darks, longest) if longest else {}
    curves, points = [], []
    for n, b in enumerate(baselines):
        for c in range(4):
            lit = [p for p in b.levels if p.channel == c and seconds.get(p.recording)]
            own = [p for p in lit if p.sure and not p.full and p.signal > 4 * step]
            if len({p.recording for p in own}) < _FEWEST:
                continue
            y, v, e = (np.array([getattr(p, k) for p in own]) for k in ("signal", "variance", "error"))
            curves.append((y, v - b.read_noise[c] ** 2 - step**2 / 12, e))
            points += [(n, r, s + charge.get(n, 0.0)) for r, s in _means(own)]
    exposures = {seconds[r] for _, r, _ in points}
    if len(exposures) < _FEWEST:
        return None
    if found is None:
        allowed = allowed_by_variance(curves, span)
    else:
        allowed = [by_variance(curves, span, order_of(found.parameters))]
    bent, straight = allowed[0], by_mean(*_rates(points, seconds, allowed[0], span))
    if straight is None:
        return None
    borne_out = _bears_out(straight, bent, 1 - _SURE)
    if not borne_out and (other := _other_order(allowed, points, seconds, span)) is not None:
        (bent, straight), borne_out = other, True
    gain = bent.gain if borne_out else 0.0
    loss, error = bent.loss, bent.error
    more = {"order": (bent.order, "1", bent.order_error)} if bent.order != 1 else {}
    if found is not None:  # as sure as those frames are
        more = {name: value for name, value in found.parameters.items() if name == "order"}
    if gain:
        weights = np.array([bent.error, straight.error]) ** -2.0
        loss, error = np.average((bent.loss, straight.loss), weights=weights), weights.sum() ** -0.5
    high = max(s for _, _, s in points) / span
    return Score(
        log_p=normal_log_p(np.sqrt(2 * gain)),
        gain=gain,
        penalty=ONE_PARAMETER * (1 + len(more)),
        amplitude=float(abs(loss)),
        error=float(error),
        shift=bent.error,
        power=1,
        parameters={"curvature": (float(loss), "1", float(error)), **more},
        where={"axis": "signal", "range": [0.0, float(high)]},
    )


def _bears_out(straight: OfMeans, bent: OfVariance, chance: float) -> bool:
    """Whether the means fall as the variance says, but for such a chance where they do not fall."""
    alike = abs(straight.loss - bent.loss) < _APART * np.hypot(straight.error, bent.error)
    t = straight.loss * np.sign(bent.loss) / straight.error
    return bool(alike and t > stats.t.isf(chance, straight.freedom))


def _other_order(
    allowed: Sequence[OfVariance], points: Points, seconds: Mapping[int, float | None], span: float
) -> tuple[OfVariance, OfMeans] | None:
    """Of curves between which the variance does not choose, beside the first of them, the one that the means
    bear out best; None where they bear out none: each has its share of the chance."""
    told = [(bent, by_mean(*_rates(points, seconds, bent, span))) for bent in allowed]
    known = [(bent, straight) for bent, straight in told if straight is not None]
    chance = (1 - _SURE) / max(len(known) - 1, 1)
    borne = np.array(
        [bent is not allowed[0] and _bears_out(straight, bent, chance) for bent, straight in known], bool
    )
    if not borne.any():
        return None
    # Without a loss curves of all orders are one, so that their gains compare them.
    logs = np.array([bent.gain - straight.freedom * np.log(straight.scatter) for bent, straight in known])
    n = int(np.argmax(np.where(borne, logs, -np.inf)))
    return _unsure([bent for bent, _ in known], logs, n), known[n][1]


def _means(levels: Sequence[Level]) -> list[tuple[int, float]]:
    """The mean signal of each recording of one channel, over its parts."""
    numbers = sorted({p.recording for p in levels})
    own = [[p for p in levels if p.recording == r] for r in numbers]
    return [
        (r, float(np.average([p.signal for p in part], weights=[p.pixels for p in part])))
        for r, part in zip(numbers, own, strict=True)
    ]


def _rates(
    points: Points, seconds: Mapping[int, float | None], bent: OfVariance, span: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every flat that shows as many channels as any, these averaged, for they share its lamp: the
    arguments of `by_mean`."""
    signals: dict[tuple[int, int], list[float]] = {}
    for n, r, s in points:
        signals.setdefault((n, r), []).append(s)
    flats = sorted(k for k, own in signals.items() if len(own) == max(map(len, signals.values())))
    rate, bend, loss = [], [], bent.loss
    for flat in flats:
        signal = np.array(signals[flat])
        rate.append(float(np.mean(np.log(signal / float(seconds[flat[1]] or 1.0)))))
        x = (signal_of_order(signal, loss, span, bent.order) / span) ** bent.order
        bend.append(float(np.mean(np.log1p(-loss * x) / loss if abs(loss) > 1e-9 else -x)))
    return np.array(rate), np.array(bend), np.array([n for n, _ in flats])


def of_flats(
    recorded: Recorded,
    *,
    name: str,
    parameter: str,
    order: str,
    covers: tuple[str, ...],
    lifted_by: tuple[str, ...],
) -> Signature:
    """A response that bends, in flats without a reference. parameter, order: of the mechanism."""
    score = partial(
        response_score,
        baselines=recorded.baselines,
        step=recorded.step,
        span=recorded.span,
        darks=recorded.unlit,
    )
    return plain(
        name=name,
        axes=Axes("converter", "signal", "frozen", "signal squared", "curve"),
        reads=FILES,
        score=score,
        again=score,
        absorb=unchanged,
        covers=covers,
        lifted_by=lifted_by,
        simulate=strength(
            parameter, signed="curvature", beside=lambda found: {order: order_of(found.score.parameters)}
        ),
        place=bent_light,
    )
