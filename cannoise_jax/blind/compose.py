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

from dataclasses import dataclass

import numpy as np

from cannoise_jax.blind.effects import UNLISTED
from cannoise_jax.vocabulary import VOCABULARY, contains

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
ADVERSARIES = ("misregistered", "short_burst", "nyquist", "lamp_drift", "wrong_black", "wrong_white")
SHARES = {"null": 0.25, "strong": 0.25, "curve": 0.25, "double": 0.075, "unknown": 0.1, "adversarial": 0.075}


@dataclass(frozen=True)
class Spec:
    """One set: its category, the effects as (id, multiple of the MDE), the design, what to forget."""

    name: str
    category: str
    effects: tuple[tuple[str, float], ...] = ()
    design: str = "full"
    reference: str | None = None
    adversary: str | None = None
    without: tuple[str, ...] = ()


def concealed_with(mechanism: str) -> tuple[str, ...]:
    """The mechanism and every one that contains it as a special case."""
    return tuple(name for name in VOCABULARY if contains(name, mechanism) and name != "unknown")


def compose(rng: np.random.Generator, sets: int, nulls: int) -> list[Spec]:
    """The specs of a challenge of `sets` sets and `nulls` further effect-free ones, in shuffled order."""
    count = {category: round(share * sets) for category, share in SHARES.items()}
    count["null"] += sets - sum(count.values())
    specs: list[Spec] = []

    def add(category: str, **fields) -> None:
        specs.append(Spec("", category, **fields))

    half = count["unknown"] // 2
    hidden = [str(m) for m in rng.permutation(np.resize(STRONG, count["unknown"] - half))]
    for i in range(count["null"]):
        design = str(rng.choice(("full", "full", "no_flats", "no_darks")))
        add("null", design=design, without=concealed_with(hidden[i]) if i < len(hidden) else ())
    for mechanism in np.resize(STRONG, count["strong"]):
        add("strong", effects=((str(mechanism), 4.0),))
    for mechanism in np.resize(CURVE, count["curve"]):
        multiple = float(np.exp(rng.uniform(np.log(0.3), np.log(10))))
        add("curve", effects=((str(mechanism), multiple),))
    for _ in range(count["double"]):
        first, second = (str(m) for m in rng.choice(STRONG, 2, replace=False))
        add("double", effects=((first, 4.0), (second, 4.0)))
    for family in np.resize(tuple(UNLISTED), half):
        add("unlisted", effects=((str(family), 4.0),))
    for mechanism in hidden:
        add("concealed", effects=((mechanism, 4.0),), without=concealed_with(mechanism))
    for adversary in np.resize(ADVERSARIES, count["adversarial"]):
        reference = "burst_mean" if adversary == "short_burst" else "independent"
        add("adversarial", adversary=str(adversary), reference=reference)
    for _ in range(nulls):
        add("locate")
    order = rng.permutation(len(specs))
    width = len(str(len(specs)))
    return [
        Spec(f"set_{i:0{width}d}", **{k: v for k, v in vars(specs[j]).items() if k != "name"})
        for i, j in enumerate(order)
    ]
