"""Folders of single FITS files as users have them."""

from __future__ import annotations

import numpy as np
from astropy.io import fits

LEVEL = {"bias": 1000.0, "dark": 1000.0, "flat": 9000.0, "light": 1500.0}


def shot(path, kind, *, seed=None, size=(24, 32), electrons=None, dtype=np.uint16, colours=1.0, **keywords):
    """One frame: black 1000 DN, 2 DN/e-, 4 DN of read noise. colours: of the green sites over the others."""
    rng = np.random.default_rng(sum(map(ord, str(path))) if seed is None else seed)
    signal = (LEVEL[kind] - 1000) / 2 if electrons is None else electrons
    light = np.full(size, signal)
    light[0::2, 1::2] *= colours
    light[1::2, 0::2] *= colours
    values = 1000 + 2 * rng.poisson(light) + rng.normal(0, 4, size)
    header = fits.Header({k.replace("_", "-"): v for k, v in keywords.items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    fits.PrimaryHDU(np.rint(values).astype(dtype), header).writeto(path)
    return path


def night(folder, names=None, **keywords):
    """Two biases, darks and flats with plain headers."""
    types = {"bias": ("Bias Frame", 0.0), "dark": ("Dark Frame", 60.0), "flat": ("Flat Field", 2.0)}
    for kind, (words, seconds) in types.items():
        for n in (1, 2):
            path = folder / (names or "{kind}_{n}.fits").format(kind=kind, n=n)
            shot(path, kind, **{"IMAGETYP": words, "EXPTIME": seconds, "INSTRUME": "Acme 100"} | keywords)
    return folder


def labels(plan, which=0):
    return {g.label: g.frames for g in plan.sets[which].groups}


def notes(plan):
    return "\n".join(plan.notes)
