"""A harness over all signatures, on small fields: null law, what is read and taken out, invariances, and
whether everything that a report, a card and a camera model ask is there."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.discovery.proof.prove import Proof
from cannoise_jax.discovery.report.card import card, lines
from cannoise_jax.discovery.report.document import plain
from cannoise_jax.discovery.report.wording import sentence
from cannoise_jax.discovery.search.fit import Step
from cannoise_jax.discovery.search.model import with_addition
from cannoise_jax.discovery.search.name import UNKNOWN, Named
from cannoise_jax.mechanisms import VOCABULARY
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.signatures.fields import Fields, helmert, refit
from cannoise_jax.signatures.signature import (
    FILES,
    NO_LAW,
    NO_PATTERN,
    Found,
    Predicted,
    Signature,
    unchanged,
)
from tests.discovery.looks import SIGNATURES, white

SIZE = (32, 48)
FIXED = frozenset({"name", "kind", "frames", "number", "group", "exposure_s", "step", "gain", "black"}) | {
    "clean",
    "before",
}
"""What nothing that is taken out of a field can change."""
ALL = list(SIGNATURES.values())
OF_FIELDS = [s for s in ALL if s.reads != FILES]
OF_FILES = [s for s in ALL if s.reads == FILES]


def names(signatures):
    return [s.name for s in signatures]


def scene(rng, field):
    """The field as one of a scene with a known reference."""
    clean = np.clip(rng.uniform(0.02, 0.3, SIZE) * np.linspace(0.3, 1, SIZE[1]), 0, 1).astype(np.float32)
    return field._replace(kind="scene", clean=clean, mean=100 + 1000 * clean, signal=1000 * clean)


def drawn(seed, size=SIZE, frames=6):
    """Darks of three exposures, a flat and two scenes, of white noise."""
    rng = np.random.default_rng(seed)
    fields = white(
        rng, kinds=("dark", "dark", "dark", "flat", "flat", "flat"), frames=frames, size=size, signal=60.0
    )
    return (*fields[:4], *(scene(rng, f) for f in fields[4:]))


def counted(seed):
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
    return tuple(out)


@pytest.mark.parametrize("signature", ALL, ids=names(ALL))
def test_it_reads_no_more_than_it_says(signature):
    """A cached score is used again while nothing that it reads has changed."""
    fields, rng = drawn(0), np.random.default_rng(1)
    other = {
        "contrasts": lambda x: x[:, ::-1] * 1.5,
        "static": lambda x: x[::-1] * 1.5,
        "usable": lambda x: x & (rng.random(x.shape) < 0.8),
    }
    changed = tuple(
        f._replace(
            **{
                part: other.get(part, lambda x: x * np.float32(1.3))(getattr(f, part))
                for part in set(Fields._fields) - FIXED - signature.reads
            }
        )
        for f in fields
    )
    one, again = signature.score(fields), signature.score(changed)
    assert (one is None) == (again is None)
    if one is not None and again is not None:
        for part in ("log_p", "gain", "penalty", "amplitude", "error", "shift", "parameters"):
            assert getattr(one, part) == getattr(again, part), part


def test_what_would_be_wrong_silently_must_be_said():
    (rows,) = (s for s in ALL if s.control)
    said = {f.name: getattr(rows, f.name) for f in dataclasses.fields(rows)}
    for name in (
        "reads",
        "absorb",
        "covers",
        "predict",
        "pattern",
        "simulate",
        "place",
        "detectable",
        "least",
    ):
        with pytest.raises(TypeError, match=name):
            Signature(**{other: value for other, value in said.items() if other != name})
    with pytest.raises(ValueError, match="row_additive_temporal: .* say in `quoted` how strong"):
        dataclasses.replace(rows, reads_as=("row_noise", "banding"))


@pytest.mark.parametrize("signature", ALL, ids=names(ALL))
def test_a_score_of_nothing_can_be_used_as_any_other(signature):
    """A search that is repeated absorbs what it finds then, which may be nothing."""
    fields = drawn(6)
    score = signature.score(fields)
    if score is not None:
        assert len(signature.absorb(fields, score)) == len(fields)
        signature.predict(fields, score)
        with np.errstate(all="raise", under="ignore"):
            found = found_by(signature, fields, score, signature.mechanism or UNKNOWN)
            for added in (signature.simulate(found), signature.place(found)):
                held = (*added.values.values(), *added.maps.values()) if added is not None else ()
                assert all(np.isfinite(np.asarray(v)).all() for v in held)


LEVELS = ("black_level", "black_channels", "dark_level", "reference_scale", "description_scale", "greens")
"""Of means, which other fields state without noise."""
SHAPES = ("kurtosis", "light_tails", "skewness")
"""Of what is beyond Poisson noise and rounding."""
RARELY = [s for s in OF_FIELDS if s.rare]
OFTEN = [s for s in OF_FIELDS if not s.rare and s.score(drawn(0, frames=2)) is not None]


def measured(seed):
    """Fields whose means are measured: with the noise that is left of the mean of their frames."""
    rng = np.random.default_rng([7, seed])

    def with_noise(f):
        noise = rng.standard_normal(f.mean.shape).astype(np.float32)
        return f._replace(mean=f.mean + f.sigma * noise / np.float32(np.sqrt(f.frames)))

    return tuple(with_noise(f) for f in drawn(seed))


DRAWS = dict.fromkeys(SHAPES, counted) | dict.fromkeys(LEVELS, measured)


@pytest.mark.parametrize("signature", OFTEN, ids=names(OFTEN))
def test_p_is_not_too_small_without_an_effect(signature):
    draws = DRAWS.get(signature.name, drawn)
    fields = [refit(draws(seed)) for seed in range(40)]
    scores = [s for f in fields if (s := signature.score(f)) is not None]
    p = np.exp([s.log_p for s in scores])
    assert stats.kstest(p, "uniform", alternative="greater").pvalue > 1e-4
    assert all(s.log_p <= 0 and s.gain >= 0 and s.error > 0 and s.shift > 0 for s in scores)


@pytest.mark.parametrize("signature", RARELY, ids=names(RARELY))
def test_a_rare_test_rejects_rarely(signature):
    draws = DRAWS.get(signature.name, drawn)
    scores = [s for seed in range(30) if (s := signature.score(draws(seed))) is not None]
    if scores:
        assert np.mean([s.log_p < np.log(0.1) for s in scores]) < 0.1 + 3 * np.sqrt(0.09 / len(scores))


@pytest.mark.parametrize("signature", OF_FIELDS, ids=names(OF_FIELDS))
def test_the_order_of_recordings_does_not_matter(signature):
    fields = drawn(3)
    one, other = signature.score(fields), signature.score(fields[::-1])
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        assert one.log_p == pytest.approx(other.log_p, rel=1e-4, abs=1e-4)
        assert one.amplitude == pytest.approx(other.amplitude, rel=1e-3, abs=1e-3 * one.shift)


@pytest.mark.parametrize("signature", OF_FIELDS, ids=names(OF_FIELDS))
def test_an_offset_of_all_codes_does_not_matter(signature):
    fields = drawn(4)
    moved = tuple(f._replace(mean=f.mean + np.float32(32), black=f.black + 32) for f in fields)
    one, other = signature.score(fields), signature.score(moved)
    if one is None or signature.name in ("black_level", "black_channels"):  # these judge that offset
        return
    assert other is not None and one.log_p == pytest.approx(other.log_p, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("name", [s.name for s in ALL if s.name.startswith("row_") and s.kin == "row"])
def test_transposed_rows_are_columns(name):
    fields = drawn(5)
    turned = tuple(
        f._replace(
            **{
                part: np.ascontiguousarray(np.swapaxes(value, -1, -2))
                for part in ("mean", "signal", "sigma", "shot", "usable", "contrasts", "static", "clean")
                if (value := getattr(f, part)) is not None
            }
        )
        for f in fields
    )
    row, column = SIGNATURES[name].score(fields), SIGNATURES[name.replace("row", "column")].score(turned)
    assert row.log_p == pytest.approx(column.log_p, rel=1e-4, abs=1e-4)
    assert row.amplitude == pytest.approx(column.amplitude, rel=1e-3, abs=1e-6)


ROWS, COLUMNS = np.indices(SIZE)
PLANTED = {
    "row": lambda rng, f, t: rng.standard_normal((t, SIZE[0], 1)),
    "column": lambda rng, f, t: rng.standard_normal((t, 1, SIZE[1])),
    "frame": lambda rng, f, t: rng.standard_normal((t, 1, 1)),
    "pixel": lambda rng, f, t: rng.standard_normal((t, *SIZE)),
    "tile_8": lambda rng, f, t: np.kron(rng.standard_normal((t, 4, 6)), np.ones((8, 8))),
    "tile_16": lambda rng, f, t: np.kron(rng.standard_normal((t, 2, 3)), np.ones((16, 16))),
    "diagonal": lambda rng, f, t: rng.standard_normal((t, sum(SIZE)))[:, COLUMNS - ROWS + SIZE[0]],
    "antidiagonal": lambda rng, f, t: rng.standard_normal((t, sum(SIZE)))[:, COLUMNS + ROWS],
    "site": lambda rng, f, t: np.tile(rng.standard_normal((t, 2, 2)), (1, SIZE[0] // 2, SIZE[1] // 2)),
    "row_parity": lambda rng, f, t: np.tile(rng.standard_normal((t, 2, 1)), (1, SIZE[0] // 2, 1)),
    "column_parity": lambda rng, f, t: np.tile(rng.standard_normal((t, 1, 2)), (1, 1, SIZE[1] // 2)),
}
SHARED = [s for s in ALL if s.kin in PLANTED and s.axes.law == "white"]


def planted(signature: Signature, times: float, seed=6):
    """White fields with offsets, or factors of the light, of `times` what shifts the score by one."""
    fields, axes = drawn(seed), signature.axes
    rng = np.random.default_rng(seed)
    amplitude = math.sqrt(times) * signature.score(fields).shift
    longest = max(f.exposure_s for f in fields)
    frozen = PLANTED[signature.kin](rng, None, 1)[0]
    out = []
    for f in fields:
        unit = {"additive": 1.0, "signal": f.signal if f.lit else 0.0, "exposure": f.exposure_s / longest}[
            axes.scales
        ]
        load = (amplitude * unit * f.weight).astype(np.float32)
        if axes.time == "frozen":
            moved = f.static + np.float32(np.sqrt(f.frames)) * frozen * load
            out.append(f._replace(static=moved.astype(np.float32)))
        else:
            offsets = PLANTED[signature.kin](rng, f, len(f.contrasts))
            out.append(f._replace(contrasts=(f.contrasts + offsets * load).astype(np.float32)))
    return tuple(out), amplitude


@pytest.mark.parametrize("signature", SHARED, ids=names(SHARED))
def test_what_is_planted_is_found_with_its_strength_and_taken_out(signature):
    fields, amplitude = planted(signature, 100.0)
    score = signature.score(fields)
    assert score.log_p < -15
    assert abs(score.amplitude - amplitude) < 5 * score.error + 0.15 * amplitude
    left = signature.score(refit(signature.absorb(fields, score), fields))
    assert left is None or left.log_p > np.log(1e-3)
    law = signature.predict(fields, score)
    if signature.predict is NO_LAW:
        return
    assert isinstance(law, Predicted)
    shared = max(law.row, law.column, law.frame)
    if law.pattern is None:
        assert shared == score.amplitude
    else:
        unit = max(f.exposure_s for f in fields) if signature.axes.scales == "exposure" else 1.0
        power = np.mean(np.square(law.pattern) + law.doubt)
        assert math.sqrt(power) * unit == pytest.approx(score.amplitude, rel=0.35)


def laid_over(f, values):
    """A field with offsets, DN: new ones in every contrast `[n, H, W]`, or a map that stays `[H, W]`."""
    if np.ndim(values) == 3:
        return f._replace(contrasts=(f.contrasts + values * f.weight).astype(np.float32))
    return f._replace(static=(f.static + np.sqrt(f.frames) * values * f.weight).astype(np.float32))


def waves(rng, f, staying):
    phase = rng.uniform(0, 2 * np.pi, () if staying else (len(f.contrasts), 1, 1))
    return np.cos(2 * np.pi * (0.11 * ROWS + 0.23 * COLUMNS) + phase)


def pink(rng, shape):
    """1/f noise along the last axis, of unit rms."""
    frequency = np.maximum(np.fft.rfftfreq(shape[-1]), 1 / shape[-1])
    values = np.fft.irfft(np.fft.rfft(rng.standard_normal(shape)) / np.sqrt(frequency), shape[-1])
    return values / values.std()


def alike(rng, shape):
    """Noise that each pixel shares with the next of its row."""
    values = rng.standard_normal(shape)
    return values + np.roll(values, 1, -1)


def sparse(rng):
    return np.where(rng.random(SIZE) < 0.01, rng.exponential(60.0, SIZE), 0.0)


SPARSE = sparse(np.random.default_rng(9))
FIRST = (SIZE[1] // 2 > COLUMNS) - 0.5
OWN = {
    "wave_redrawn": lambda rng, f: 1.5 * waves(rng, f, False),
    "wave_frozen": lambda rng, f: 1.5 * waves(np.random.default_rng(9), f, True),
    "flicker": lambda rng, f: (
        0.05 * f.signal * np.cos(2 * np.pi * 0.1 * ROWS + rng.uniform(0, 6.3, (len(f.contrasts), 1, 1)))
    ),
    "row_slope": lambda rng, f: 3 * pink(rng, (len(f.contrasts), SIZE[0]))[:, :, None],
    "raster_slope": lambda rng, f: 3 * pink(rng, (len(f.contrasts), SIZE[0] * SIZE[1])).reshape(-1, *SIZE),
    "hot_additive": lambda rng, f: SPARSE,
    "hot_thermal": lambda rng, f: SPARSE * f.exposure_s,
    "step": lambda rng, f: 2 * FIRST,
    "dead": lambda rng, f: np.where(np.random.default_rng(8).random(SIZE) < 0.003, -f.signal, 0.0),
    "smear": lambda rng, f: 0.05 * (f.signal.mean(0) - f.signal.mean()) * (f.kind == "scene"),
    "curvature": lambda rng, f: 2e-4 * f.signal**2 * (f.kind == "scene"),
    "glow": lambda rng, f: 20 * f.exposure_s * np.exp(-np.hypot(ROWS, COLUMNS) / 10) * (f.kind == "dark"),
    "lags_any": lambda rng, f: 1.5 * alike(rng, f.contrasts.shape),
    "scene_static": lambda rng, f: 2 * rng.standard_normal(SIZE) * (f.kind == "scene"),
}
"""What laws of their own leave in a field, DN."""


@pytest.mark.parametrize("name", OWN)
def test_what_a_law_of_its_own_leaves_is_found_and_taken_out(name):
    signature, rng = SIGNATURES[name], np.random.default_rng(6)
    bare = drawn(6)
    fields = refit(tuple(laid_over(f, OWN[name](rng, f)) for f in bare), bare)  # as a baseline leaves them
    score = signature.score(fields)
    assert score.log_p < -15
    left = signature.score(refit(signature.absorb(fields, score), fields))
    assert left is None or left.log_p > np.log(1e-3)


UNPLANTED = {
    "reference_shift, reference_blur, reference_spread, moving": "edges of a scene: recordings with shapes",
    "shading": "what a smooth mean takes: recordings, not fields",
    "clocking, warm, hits": "single electrons and warm pixels: see the tests of recordings",
    "telegraph": "jumps from frame to frame: see the tests of outlying pixels",
    "lag_in_time": "frames in the order they were taken, which fields alone do not tell",
    "lags_brighter_fatter, lags_crosstalk, lags_demosaicing, lags_read": "as lags_any, by other weights",
    "lags_in_camera_denoising, lags_in_camera_denoising_8": "as lags_any, of all noise",
    "lattice, corrected": "pixels made of their neighbours: see the tests of recordings",
    "taps": "layouts of readouts: see its own tests",
    "row_turns_temporal": "every other row reversed: see its own tests",
    "tile_32_redrawn, tile_32_frozen, tile_64_redrawn, tile_64_frozen": "as tile_16, in frames of some tiles",
}
"""Signatures that take something out of fields and are not held to it here, and why."""


def test_every_signature_that_takes_something_out_is_held_to_it_or_named():
    planted = {*names(SHARED), *OWN}
    left_out = {name for together in UNPLANTED for name in together.split(", ")}
    taken = {s.name for s in ALL if s.absorb is not unchanged}
    assert not planted & left_out and taken == planted | left_out


UNSEEN = {
    "saturation, signal_step, iso_step, variance_curve": "levels of a curve",
    "code_spacing, pile_up, coarse, comb": "codes of files",
    "moving, peaks": "frames of scenes",
    "dark_noise, lag_in_time, excess_skewness": "more frames, or darks of more exposures",
    "tile_32_frozen, tile_64_redrawn, tile_64_frozen": "larger frames",
}
"""Signatures that see nothing in the fields of the null law, and what they need."""


def test_every_signature_is_held_to_its_null_law_or_named():
    left_out = {name for together in UNSEEN for name in together.split(", ")}
    assert {s.name for s in ALL} - {*names(OFTEN), *names(RARELY)} == left_out


def found_by(signature: Signature, fields, score, mechanism):
    rng = np.random.default_rng(0)
    return Found(
        mechanism=mechanism,
        score=score,
        fields=fields,
        pattern=signature.pattern(fields, score, rng),
        gain=1.5,
        read_dn=2.0,
        seconds=0.4,
        longest=0.4,
        span=1000.0,
        size=SIZE,
    )


@pytest.mark.parametrize("signature", SHARED, ids=names(SHARED))
def test_the_simulator_gets_the_strength_that_was_found(signature):
    fields, _ = planted(signature, 400.0)
    score = signature.score(fields)
    model = SensorModel.poisson_gaussian(1.5, 2.0, 100.0, 1100.0)
    for mechanism in (signature.mechanism, UNKNOWN):
        if mechanism is None:
            continue
        found = found_by(signature, fields, score, mechanism)
        added = signature.place(found) if mechanism == UNKNOWN else signature.simulate(found)
        assert added is not None
        step = SimpleNamespace(named=SimpleNamespace(mechanism=mechanism, signature=signature))
        grown = with_addition(model, step, added)
        (fitted,) = grown.mechanisms
        value = next(iter(fitted.parameters.values()))
        rms = 1.0
        if signature.pattern is not NO_PATTERN:
            rms = float(np.sqrt(np.mean(np.asarray(fitted.maps["field"]) ** 2)))
        assert float(value) * rms == pytest.approx(score.amplitude, rel=0.35)


@pytest.mark.parametrize("signature", ALL, ids=names(ALL))
def test_words_card_and_limits_are_complete(signature):
    fields = drawn(7)
    score = signature.score(fields)
    assert all(isinstance(axis, str) and axis for axis in dataclasses.astuple(signature.axes))
    assert signature.axes.scales != "relative" and signature.axes.scales != "thermal"
    if score is None:
        return
    assert math.isfinite(score.log_p) and math.isfinite(score.gain) and math.isfinite(score.amplitude)
    mechanism = signature.mechanism or UNKNOWN
    named = Named(score, signature, UNKNOWN, ((UNKNOWN, 1.0),), False)
    step = Step(named, fields, -20.0)
    told = card(step, tuple(ALL), frozenset(VOCABULARY))
    assert told["axes"]["scales"] == signature.axes.scales
    assert all(text for _, text in lines(plain(told)))
    for outcome, id in (("UNKNOWN_STRUCTURE", UNKNOWN), ("FOUND", mechanism)):
        entry = {
            "mechanism": id,
            "outcome": outcome,
            "amplitude": {"value": 2.0, "unit": VOCABULARY[id].unit, "ci90": [1.9, 2.1]},
            "parameters": {
                n: {"value": v, "unit": u, "ci90": [v - e, v + e]}
                for n, (v, u, e) in {"shortfall": (0.9, "1", 0.1), **score.parameters}.items()
            },
        }
        said = sentence(entry, step, Proof(score, 5.0, 1.0, 9.0, 100), VOCABULARY[id])
        assert "90 %" in said and "nan" not in said
        grows = "exposure" in said
        assert grows or signature.axes.scales != "exposure"
    assert signature.at(score, 2.0 * (score.amplitude or 1.0)) != score
    assert dataclasses.replace(signature, mechanism="x").mechanism == "x"


def test_one_signature_is_of_the_rows_that_the_control_adds():
    (rows,) = (s for s in ALL if s.control)
    _, amplitude = planted(rows, 100.0)
    assert rows in SHARED and rows.predict(drawn(7), rows.score(drawn(7)).replace(amplitude=amplitude)).row


def test_files_are_judged_whatever_is_taken_out():
    assert {s.axes.enters for s in OF_FILES} <= {"converter", "photons", "pixel", "readout"}
    fields = drawn(8)
    for signature in OF_FILES:
        assert signature.absorb(fields, None) is fields
