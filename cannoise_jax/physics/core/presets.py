"""Cameras from published calibrations: numbers only, each with its source in `tables/*.json`.

- `sony_a7s2`: 28 ISOs from 50 to 25600 with the switch of its dual gain between 1600 and 2000, Tukey-lambda
  read noise, row noise and frame-to-frame drift of the black level; `imx686` the same at two ISOs (PMN).
- `eld_*`: five cameras by the log-linear laws of ELD, read noise, row noise, tails and colour bias.
- `sidd_*`: the five phones of SIDD by their published noise level functions; these are known to be off, see
  `physics.synthetic.virtual`.

The tables give the noise of stored frames: PMN and ELD fit darks as they come out of the camera (the shape of
imx686 at ISO 100 is that of rounding, nothing else), and a noise level function is the variance of raw
values. The rounding is therefore in them once; since a model rounds by itself, a twelfth of a squared code
step is taken out of the read noise (8 % of it where it is smallest, 0.69 DN).
"""

from __future__ import annotations

import functools
import json
from importlib import resources
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from cannoise_jax.physics.core.settings import IsoTable
from cannoise_jax.recordings.recording import BadInput

PHONES = {
    "sidd_iphone7": ("IP", "RGGB"),
    "sidd_pixel": ("GP", "BGGR"),
    "sidd_galaxy_s6": ("S6", "GRBG"),
    "sidd_nexus6": ("N6", "BGGR"),
    "sidd_g4": ("G4", "BGGR"),
}
"""Preset name to SIDD's short name and colour pattern."""

_PHONE_LEVELS = (64.0, 1023.0)
"""Nominal 10-bit levels: the published functions are in normalised units and come without levels."""


def preset_names() -> tuple[str, ...]:
    """All presets."""
    return (*read_table("cameras")["cameras"], *PHONES)


class Preset(NamedTuple):
    """Numbers of a camera: per ISO gain, DN/e-, and read noise, e-; levels in DN; mechanisms with the one
    parameter that the table gives."""

    iso: tuple[float, ...]
    gain_dn_per_e: np.ndarray
    read_noise_e: np.ndarray
    black_level: float
    white_level: float
    code_step: float
    cfa: str
    mechanisms: tuple[tuple[str, dict[str, IsoTable | float]], ...]


def preset(name: str, iso: float | None = None) -> Preset:
    """A camera from published tables, at all its ISOs, or at `iso` alone: what `SensorModel.preset` makes a
    model of.

    Raises BadInput for an unknown name, or an ISO that is not in the camera's table.
    """
    if name not in preset_names():
        raise BadInput(f"{name}: no such preset, use one of {', '.join(preset_names())}")
    table = _phone(name) if name in PHONES else _camera(read_table("cameras")["cameras"][name])
    table = {**table, "read": np.sqrt(np.square(table["read"]) - _CODE_STEP**2 / 12).tolist()}
    isos = np.asarray(table["iso"], np.float32)
    if iso is not None:
        if isinstance(iso, bool) or not isinstance(iso, int | float | np.number):
            raise TypeError(f"iso is {iso!r}: give an ISO of the camera's table, or None for all")
        if iso not in isos:
            listed = ", ".join(f"{i:g}" for i in isos)
            raise BadInput(f"{name}: no values for ISO {iso:g}, use one of {listed}")
        table = {**table, **{k: [table[k][list(isos).index(iso)]] for k in _ROWS if k in table}}
    elif name in _SWITCHES:
        table = _stepped(table, _SWITCHES[name])
    return _numbers(table)


@functools.cache
def read_table(name: str) -> dict[str, Any]:
    """One of the packaged tables, "cameras" or "phones", as stored."""
    text = (resources.files("cannoise_jax.physics.core") / "tables" / f"{name}.json").read_text()
    return json.loads(text)


_CODE_STEP = 1.0
"""DN: the tables are of stored codes."""
_ROWS = ("iso", "gain", "read", "row", "lambda", "drift", "channel_offset")

_SWITCHES = {"sony_a7s2": 2000.0}
"""First ISO of the high conversion gain, where the published read noise in e- falls by a factor of three."""


def _stepped(table: dict[str, Any], switch: float) -> dict[str, Any]:
    """The table with one more ISO just below the switch, of the last row before it at a gain proportional to
    ISO: a camera has one conversion gain or the other, nothing in between."""
    at = table["iso"].index(switch)
    iso = float(np.nextafter(np.float32(switch), np.float32(0)))
    grown = {
        k: iso / table["iso"][at - 1] if k in ("iso", "gain", "read", "row", "drift") else 1.0 for k in _ROWS
    }
    return {
        **table,
        **{k: [*table[k][:at], table[k][at - 1] * grown[k], *table[k][at:]] for k in _ROWS if k in table},
    }


# Which mechanism and parameter a column of the table sets.
_MECHANISMS = {
    "row": ("row_noise", "sigma_dn"),
    "lambda": ("heavy_tails", "tukey_lambda"),
    "drift": ("offset_drift", "sigma_dn"),
    "channel_offset": ("channel_offset", "sigma_dn"),
}


def _numbers(table: dict[str, Any]) -> Preset:
    gain, read = np.asarray(table["gain"]), np.asarray(table["read"])
    return Preset(
        tuple(float(i) for i in table["iso"]),
        gain[:, None],
        (read / gain)[:, None],
        table["black_level"],
        table["white_level"],
        _CODE_STEP,
        table["cfa"],
        tuple(
            (id, {parameter: by_iso(table["iso"], table[column])})
            for column, (id, parameter) in _MECHANISMS.items()
            if column in table
        ),
    )


def by_iso(isos, values) -> IsoTable | float:
    """A parameter by ISO: a table, or the number where there is but one ISO."""
    if len(isos) == 1:
        return float(values[0])
    return IsoTable(jnp.asarray(isos, jnp.float32), jnp.asarray(values, jnp.float32))


def _camera(stored: dict[str, Any]) -> dict[str, Any]:
    """A stored table with its laws written out: gain, read and row noise per ISO, DN."""
    if "gain" in stored:
        return stored
    gain = np.asarray(stored["iso"]) * (stored["gain_at_iso_100"] / 100)

    def law(line):
        slope, bias = line
        return np.exp(slope * np.log(gain) + bias).tolist()

    return {
        **stored,
        "gain": gain.tolist(),
        "read": law(stored["read_line"]),
        "row": law(stored["row_line"]),
        "lambda": stored["lambda_by_stop"],
        "channel_offset": stored["channel_offset_by_stop"],
    }


def _phone(name: str) -> dict[str, Any]:
    short, cfa = PHONES[name]
    black, white = _PHONE_LEVELS
    nlf = read_table("phones")["published"][short]
    return {
        "iso": [int(iso) for iso in nlf],
        "gain": [shot * (white - black) for shot, _ in nlf.values()],
        "read": [read**0.5 * (white - black) for _, read in nlf.values()],
        "black_level": black,
        "white_level": white,
        "cfa": cfa,
    }
