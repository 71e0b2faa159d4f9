"""Which sets a sealed challenge holds: how many of which category, with which effect at which strength.

    null         nothing injected
    strong       one core mechanism at 4 x MDE, as many sets for each
    curve        one mechanism, strength log-uniform from 0.3 to 10 x MDE
    double       two mechanisms, each at 4 x MDE
    unlisted     an effect from families that no list holds
    concealed    a core mechanism that the tool is told to forget (with every mechanism that contains it)
    adversarial  nothing wrong with the sensor, but with reference, scene, lamp or description
    locate       nothing injected; only declared, calibrated and located

A concealed set must tell the tool what to forget, so as many effect-free sets carry the same request.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cannoise_jax.blind import peer
from cannoise_jax.blind.effects import UNLISTED
from cannoise_jax.blind.listed import NAMES, contains

STRONG = (
    "prnu",
    "dsnu",
    "column_gain",
    "nonlinearity",
    "crosstalk",
    "amp_glow",
    "hot_pixels",
    "heavy_tails",
    "pixel_read_noise_map",
    "row_noise",
    "column_noise",
    "row_fpn",
    "column_fpn",
    "pink_noise",
    "row_pink_noise",
    "banding",
    "offset_drift",
    "amplifier_mismatch",
    "green_imbalance",
    "in_camera_denoising",
)
CURVE = (*STRONG, "rts", "dark_current", "channel_offset", "flicker", "illumination_drift", "lens_shading")
PARTIAL = ("no_flats", "no_darks", "single_frames")
SHOWS = {
    **dict.fromkeys(("prnu", "column_gain", "nonlinearity", "green_imbalance", "crosstalk"), "no_darks"),
    **dict.fromkeys(("flicker", "illumination_drift", "lens_shading"), "no_darks"),
}
"""The lesser design that still shows a mechanism, where it is not the one without flats."""
ADVERSARIES = ("misregistered", "short_burst", "nyquist", "lamp_drift", "wrong_black", "wrong_white")
PARTS = ("inject", "withhold", "permute")
"""What a trial does to real recordings."""
SHARES = {
    "null": 0.25,
    "strong": 0.25,
    "curve": 0.25,
    "double": 0.075,
    "unlisted": 0.05,
    "concealed": 0.05,
    "adversarial": 0.075,
}


@dataclass(frozen=True)
class Spec:
    """One set: its category, effects as (id, multiple of the MDE), design, what to forget, code."""

    name: str
    category: str
    effects: tuple[tuple[str, float], ...] = ()
    design: str = "full"
    reference: str | None = None
    adversary: str | None = None
    without: tuple[str, ...] = ()
    engine: str = "own"


def concealed_with(mechanism: str) -> tuple[str, ...]:
    """The mechanism and every one that contains it as a special case."""
    return tuple(name for name in NAMES if contains(name, mechanism))


def numbers(sets: int, kinds: tuple[str, ...] = ()) -> dict[str, int]:
    """Sets of each category, in the shares of a challenge of 400; every category has one where sets allow.

    kinds: categories to make, shares kept; empty for all. Raises ValueError for an unknown one.
    """
    for kind in kinds:
        if kind not in SHARES:
            raise ValueError(f"{kind}: no such kind of set; known: {', '.join(SHARES)}")
    shares = {k: v for k, v in SHARES.items() if not kinds or k in kinds}
    total = sum(shares.values())
    exact = {k: v / total * sets for k, v in shares.items()}
    count = {k: max(int(v), 1) if sets >= len(shares) else int(v) for k, v in exact.items()}
    while (left := sets - sum(count.values())) != 0:
        sign = 1 if left > 0 else -1
        able = [k for k in count if sign > 0 or count[k] > 1 or sets < len(shares)]
        count[max(able, key=lambda k: sign * (exact[k] - count[k]))] += sign
    return count


def compose(rng: np.random.Generator, sets: int, nulls: int, kinds: tuple[str, ...] = ()) -> list[Spec]:
    """The specs of a challenge of `sets` sets and `nulls` further effect-free ones, in shuffled order."""
    count = {**dict.fromkeys(SHARES, 0), **numbers(sets, kinds)}
    specs: list[Spec] = []

    def add(category: str, **fields) -> None:
        spec = Spec("", category, **fields)
        # The second engine makes every other set of the effects it has, and one effect-free set in four.
        share = 0.5 if spec.effects else 0.25
        drawn = rng.random() < share and spec.adversary is None
        second = drawn and peer.able(tuple(name for name, _ in spec.effects))
        specs.append(replace(spec, engine="getframes" if second else "own"))

    def deal(names, number: int) -> list[str]:
        """`number` names in random order, each as often as any other, give or take one."""
        cards = [rng.permutation(names) for _ in range(-(-number // len(names)))]
        return [str(n) for n in np.concatenate(cards)[:number]] if number else []

    hidden = deal(STRONG, count["concealed"])
    for i in range(count["null"]):
        design = str(rng.choice(("full", "full", *PARTIAL)))
        add("null", design=design, without=concealed_with(hidden[i]) if i < len(hidden) else ())
    for mechanism in deal(STRONG, count["strong"]):
        add("strong", effects=((mechanism, 4.0),))
    for mechanism in deal(CURVE, count["curve"]):
        multiple = float(np.exp(rng.uniform(np.log(0.3), np.log(10))))
        design = str(rng.choice(("full", "full", "full", SHOWS.get(mechanism, "no_flats"))))
        add("curve", effects=((mechanism, multiple),), design=design)
    for _ in range(count["double"]):
        first, second = (str(m) for m in rng.choice(STRONG, 2, replace=False))
        add("double", effects=((first, 4.0), (second, 4.0)))
    for family in deal(tuple(UNLISTED), count["unlisted"]):
        add("unlisted", effects=((family, 4.0),))
    for mechanism in hidden:
        add("concealed", effects=((mechanism, 4.0),), without=concealed_with(mechanism))
    for adversary in deal(ADVERSARIES, count["adversarial"]):
        reference = "burst_mean" if adversary == "short_burst" else "independent"
        add("adversarial", adversary=adversary, reference=reference)
    for _ in range(nulls):
        add("locate")
    order = rng.permutation(len(specs))
    width = len(str(len(specs)))
    return [
        Spec(f"set_{i:0{width}d}", **{k: v for k, v in vars(specs[j]).items() if k != "name"})
        for i, j in enumerate(order)
    ]
