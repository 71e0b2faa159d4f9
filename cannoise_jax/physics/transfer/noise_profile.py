"""Noise profiles: shot and read noise of every ISO in normalised units, as denoisers take them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer, channels_of, of_all_pixels
from cannoise_jax.recordings.recording import iso_numbers


def profile_rows(transfers: Sequence[PhotonTransfer]) -> list[dict[str, Any]]:
    """One row for each ISO that has a baseline and each channel (one of a sensor without colours):
    shot and read of the variance shot * x + read, x = (DN - black) / (white - black), and the same in DN and
    electrons. gain_db: what the ISO of a camera that counts in dB was made of, 100 x 10^(dB / 20)."""
    rows = []
    for transfer in map(of_all_pixels, transfers):
        base = transfer.baseline
        if not isinstance(base, Baseline):
            continue
        for c, name in enumerate(channels_of(transfer)):
            span = base.white_level - base.black_level[c]
            rows.append(
                {
                    "iso": transfer.iso,
                    "channel": name,
                    "shot": base.gain[c] / span,
                    "read": (base.read_noise[c] / span) ** 2,
                    "gain_dn_per_e": base.gain[c],
                    "read_noise_dn": base.read_noise[c],
                    "read_noise_e": base.read_noise_e[c],
                    "black_level_dn": base.black_level[c],
                    "white_level_dn": base.white_level,
                    "gain_db": transfer.statistics[0].recording.gain_db,
                }
            )
    return rows


def profile_csv(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as CSV with a head line; an ISO that is not stated is empty."""
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]) if rows else ["iso", "channel", "shot", "read"])
    writer.writeheader()
    writer.writerows({k: ("" if v is None else v) for k, v in row.items()} for row in rows)
    return out.getvalue()


def darktable_profiles(camera: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The layout of darktable's noiseprofiles.json: a and b of the variance a x + b for red, green and
    blue of each ISO, greens averaged. darktable needs a number for the ISO: where none is stated, that by
    which the camera model knows the setting stands for it, and the name says so. Of raw values before
    demosaicing.
    """
    maker, _, model = camera.partition(" ")
    profiles, numbers = [], iso_numbers(row["iso"] for row in rows)
    for iso in dict.fromkeys(row["iso"] for row in rows):
        own = [row for row in rows if row["iso"] == iso]
        decibels = own[0]["gain_db"]
        made_of = "" if decibels is None else f" (gain {decibels:g} dB)"

        def mean(name: str, colour: str, own: list[dict[str, Any]] = own) -> float:
            fits = [r[name] for r in own if str(r["channel"]).startswith(colour)]
            return float(np.mean(fits or [r[name] for r in own]))

        profiles.append(
            {
                "name": f"{camera} iso {round(numbers[iso])}{made_of if iso else ' (not stated)'}",
                "iso": round(numbers[iso]),
                "a": [mean("shot", colour) for colour in "RGB"],
                "b": [mean("read", colour) for colour in "RGB"],
            }
        )
    return {
        "version": 0,
        "noiseprofiles": [
            {"maker": maker, "models": [{"model": model or maker, "profiles": profiles}]},
        ],
    }
