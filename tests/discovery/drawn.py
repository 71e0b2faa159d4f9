"""Fields to hold signatures to: drawn without any effect, of white noise, or as a camera's recordings give
them. Each is drawn once, and none of its arrays can be written to."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache, lru_cache

import numpy as np

from cannoise_jax.discovery.frames.battery import Prepared, prepare
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.fields import Fields, helmert, refit
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import FILES, Signature
from tests.discovery.capture import scene as blobs
from tests.discovery.looks import SIGNATURES, white

SIZE = (32, 48)
LEVELS = (
    "black_level", "black_channels", "dark_level", "reference_scale", "description_scale", "greens",
    "greens_beside_patterns",
)  # fmt: skip
"""Signatures of means, which other fields state without noise."""
SHAPES = ("kurtosis", "light_tails", "skewness", "excess_skewness")
"""Signatures of what is beyond Poisson noise and rounding."""
TAILS = ("tail_column", "tail_row")
"""Signatures of what lies on one side of pixels that stand out."""
Many = tuple[Fields, ...]


def kept(fields: Many) -> Many:
    """The fields, read only."""
    for f in fields:
        for value in f:
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
    return fields


def scene(rng, field: Fields) -> Fields:
    """The field as one of a scene with a known reference."""
    clean = np.clip(rng.uniform(0.02, 0.3, SIZE) * np.linspace(0.3, 1, SIZE[1]), 0, 1).astype(np.float32)
    return field._replace(kind="scene", clean=clean, mean=100 + 1000 * clean, signal=1000 * clean)


@lru_cache(maxsize=64)
def drawn(seed: int, frames: int = 6) -> Many:
    """Darks of three exposures, a flat and two scenes, of white noise."""
    rng = np.random.default_rng(seed)
    fields = white(
        rng, kinds=("dark", "dark", "dark", "flat", "flat", "flat"), frames=frames, size=SIZE, signal=60.0
    )
    return kept((*fields[:4], *(scene(rng, f) for f in fields[4:])))


@lru_cache(maxsize=64)
def counted(seed: int) -> Many:
    """A dark and a flat of Poisson electrons and read noise, rounded to codes."""
    rng, gain, read, frames = np.random.default_rng(seed), 1.5, 2.0, 6
    out = []
    for f, level in zip(
        white(rng, kinds=("dark", "flat"), frames=frames, size=SIZE), (0.0, 60.0), strict=True
    ):
        sigma = np.float32(np.sqrt(gain * level + read**2 + 1 / 12))
        values = gain * rng.poisson(level / gain, (frames, *SIZE)) + read * rng.standard_normal(
            (frames, *SIZE)
        )
        rest = (np.round(values) - level) / sigma
        out.append(
            f._replace(
                signal=np.full(SIZE, level, np.float32),
                mean=np.full(SIZE, 100 + level, np.float32),
                sigma=np.full(SIZE, sigma, np.float32),
                shot=np.full(SIZE, gain * level / sigma**2, np.float32),
                contrasts=np.einsum("nt,tij->nij", helmert(frames), rest).astype(np.float32),
                static=(rest.mean(0) * np.sqrt(frames)).astype(np.float32),
            )
        )
    return kept(tuple(out))


def about_its_mean(static: np.ndarray) -> np.ndarray:
    """Every site of the mosaic less its own mean, which a measured mean has taken up."""
    out = static.copy()
    for at in SITES:
        out[at] -= out[at].mean()
    return out


@lru_cache(maxsize=64)
def measured(seed: int) -> Many:
    """Fields whose means are measured: with the noise that is left of the mean of their frames."""
    rng = np.random.default_rng([7, seed])

    def with_noise(f: Fields) -> Fields:
        noise = rng.standard_normal(f.mean.shape).astype(np.float32)
        mean = f.mean + f.sigma * noise / np.float32(np.sqrt(f.frames))
        return f._replace(mean=mean, static=None if f.static is None else about_its_mean(f.static))

    return kept(tuple(with_noise(f) for f in drawn(seed)))


@lru_cache(maxsize=64)
def standing_out(seed: int) -> Many:
    """Darks and flats with hot pixels, each with a few hits in every frame, that have nothing to one side."""
    rng, size = np.random.default_rng([8, seed]), (64, 96)
    hot = np.where(rng.random(size) < 0.01, rng.exponential(300.0, size), 0.0)
    out = []
    for f in white(rng, kinds=("dark", "dark", "flat"), frames=6, size=size, signal=60.0):
        hits = np.where(rng.random((6, *size)) < 5e-4, rng.exponential(300.0, (6, *size)), 0.0)
        values = (hot * f.exposure_s + hits) / f.sigma
        contrasts = f.contrasts + np.einsum("nt,tij->nij", helmert(6), values)
        static = f.static + np.sqrt(6) * values.mean(0)
        out.append(f._replace(contrasts=contrasts.astype(np.float32), static=static.astype(np.float32)))
    return kept(tuple(out))


DRAWS = dict.fromkeys(SHAPES, counted) | dict.fromkeys(LEVELS, measured) | dict.fromkeys(TAILS, standing_out)


@lru_cache(maxsize=32)
def wide(seed: int) -> Many:
    """Darks of several large tiles."""
    rng = np.random.default_rng([64, seed])
    return kept(white(rng, kinds=("dark", "dark"), frames=2, size=(128, 192)))


RECORDED_SIZE, BLACK, WHITE, READ_E = (64, 96), 600.0, 16383.0, 3.0
PLAN = (
    *(("dark", 0.0, seconds, 100, 8) for seconds in (0.01, 0.1)),
    *(("flat", level, level / 2, 100, 8) for level in (0.02, 0.1, 0.3, 0.6)),
    ("scene", 0.0, 0.01, 100, 8),
    *(
        (*shot, iso, 2)
        for iso in (200, 400, 800, 1600)
        for shot in (("dark", 0.0, 0.01), ("flat", 0.1, 0.01))
    ),
)
"""Kind, level of light, exposure, ISO and frames of every recording."""


@lru_cache(maxsize=32)
def capture(seed: int, black: float = BLACK) -> CaptureSet:
    """Recordings of a camera of Poisson and read noise at five ISO settings, rounded to codes."""
    rng, span, out = np.random.default_rng([14, seed]), WHITE - BLACK, []
    for n, (kind, level, seconds, iso, frames) in enumerate(PLAN):
        clean = blobs(rng, RECORDED_SIZE) if kind == "scene" else np.full(RECORDED_SIZE, level)
        gain, shape = 1.5 * iso / 100, (frames, *RECORDED_SIZE)
        electrons = rng.poisson(clean * span / gain, shape) + READ_E * rng.standard_normal(shape)
        out.append(
            Recording(
                frames=np.round(black + gain * electrons).astype(np.uint16),
                cfa="RGGB",
                black_level=(black,) * 4,
                white_level=WHITE - BLACK + black,
                kind=kind,
                clean=clean.astype(np.float32) if kind == "scene" else None,
                iso=float(iso),
                exposure_s=seconds,
                shot=(gain / span,) * 4,
                read=((gain * READ_E / span) ** 2,) * 4,
                reference="independent" if kind == "scene" else None,
                code_step=1.0,
                path=f"{n}_{kind}.h5",
            )
        )
    return CaptureSet("drawn", tuple(out))


def prepared(recordings: CaptureSet) -> Prepared:
    """Fields and signatures of all frames."""
    return prepare(recordings, [list(range(r.count)) for r in recordings.recordings], judge_stated=True)


@lru_cache(maxsize=32)
def recorded(seed: int) -> Prepared:
    """The same of recordings without any effect."""
    return prepared(capture(seed))


def of(split: Prepared, name: str) -> Signature:
    """The signature of this name that was built for these recordings."""
    return next(s for s in split.signatures if s.name == name)


@cache
def seen_in(name: str) -> str:
    """The fields that a signature sees something in: "drawn", "wide" or those of recordings."""
    signature = SIGNATURES[name]
    if signature.reads == FILES:
        return "recorded"
    for where, draw in (("drawn", DRAWS.get(name, drawn)), ("wide", wide)):
        if any(signature.score(_refitted(draw, seed)) is not None for seed in range(3)):
            return where
    return "recorded"


def sight(name: str, seed: int) -> tuple[Signature, Many]:
    """A signature, and fields without any effect as a baseline leaves them."""
    if seen_in(name) == "recorded":
        return of(recorded(seed), name), recorded(seed).fields
    return SIGNATURES[name], _refitted(wide if seen_in(name) == "wide" else DRAWS.get(name, drawn), seed)


@cache
def shown(name: str) -> tuple[Signature, Many]:
    """The same of the first draw that it sees something in."""
    looks = (sight(name, seed) for seed in range(10))
    return next((s, fields) for s, fields in looks if s.score(fields) is not None)


@lru_cache(maxsize=256)
def _refitted(draw: Callable[[int], Many], seed: int) -> Many:
    return kept(refit(draw(seed)))


@cache
def null_scores(name: str) -> list[Score]:
    """Scores of draws without any effect: 40 of fields, 20 of recordings, less where nothing is seen."""
    looks = (sight(name, seed) for seed in range(40 if seen_in(name) == "drawn" else 20))
    return [score for signature, fields in looks if (score := signature.score(fields)) is not None]


def turned(fields: Many) -> Many:
    """The fields with rows for columns."""
    parts = ("mean", "signal", "sigma", "shot", "usable", "contrasts", "static", "clean")
    return tuple(
        f._replace(
            **{
                p: np.ascontiguousarray(np.swapaxes(v, -1, -2))
                for p in parts
                if (v := getattr(f, p)) is not None
            }
        )
        for f in fields
    )


def turned_recordings(recordings: CaptureSet) -> CaptureSet:
    """Recordings with rows for columns; the two greens of a mosaic change places."""
    frames = (np.ascontiguousarray(np.swapaxes(np.asarray(r.frames), 1, 2)) for r in recordings.recordings)
    turned = tuple(
        dataclasses.replace(r, frames=f, clean=None if r.clean is None else np.ascontiguousarray(r.clean.T))
        for r, f in zip(recordings.recordings, frames, strict=True)
    )
    return dataclasses.replace(recordings, recordings=turned)
