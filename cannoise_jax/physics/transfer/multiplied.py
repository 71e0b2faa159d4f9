"""What photon transfer tells of charge that was multiplied before it was read (EMCCD)."""

from __future__ import annotations

from collections.abc import Iterable

from cannoise_jax.recordings.recording import Recording

_LEAST = 2.0
"""Electron multiplying gain from which on its excess noise is half of the shot noise and more: F^2 is 2 - 1/G
or nearly so (Robbins and Hadwen, IEEE Trans. Electron Devices 50, 1227, 2003)."""


def multiplied(recordings: Iterable[Recording]) -> str:
    """That files state an electron multiplying gain, and what gain and read noise then are; empty where none
    does."""
    stated = sorted({r.em_gain for r in recordings if r.em_gain is not None})
    if not stated or stated[-1] < _LEAST:
        return ""
    excess = 2 - 1 / stated[-1]
    return (
        f"the files state an electron multiplying gain of {stated[-1]:g}, whose excess noise makes the "
        f"variance of the light up to {excess:.3g} times that of its electrons: the gain is that many times "
        "the true one, and what is in electrons, read noise among it, as many times too small: record flats "
        "without multiplication too, or divide by it"
    )
