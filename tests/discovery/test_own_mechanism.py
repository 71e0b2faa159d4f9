"""A mechanism of one's own: found, named, fitted, proved and simulated by its sampler alone."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.proof.judged import searched
from cannoise_jax.discovery.report.document import document
from cannoise_jax.discovery.report.page import place
from cannoise_jax.discovery.search.declare import registered
from cannoise_jax.mechanisms import ENTRIES, signatures
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.core.mechanism import Mechanism, Parameter
from cannoise_jax.physics.core.places import SITES
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.signatures import generic
from cannoise_jax.signatures.sampled import learned
from cannoise_jax.vocabulary import RMS, Term
from tests.discovery.capture import SIZE, capture_set
from tests.discovery.looks import RECORDED, SIGNATURES, white


def entry(id, definition, sample, time="redrawn", over="row", **more):
    return Entry(
        Term(id, definition, None, "sensor", "DN", RMS),
        Mechanism(
            id=id,
            point=Point("readout", "signal", over, time),
            parameters=(Parameter("sigma_dn", "DN", 1.0, 0.0, 1e4, "of one offset"),),
            sample=sample,
            home=f"own:{id.upper()}",
            **more,
        ),
        needs="two frames or more",
    )


def every_third(key, x, values, maps, context):
    """An offset of every third row, new in every frame."""
    rows = jnp.arange(context.size[0])[:, None] % 3 == 0
    return x + values["sigma_dn"] * rows * jax.random.normal(key, (x.shape[0], context.size[0], 1))


def corner_blocks(key, x, values, maps, context):
    """One offset per frame and block of 16 pixels along the anti-diagonal."""
    y, x_at = np.indices(context.size) // 16
    numbers = jax.random.normal(key, (x.shape[0], int(y.max()) + 1))
    return x + values["sigma_dn"] * jnp.where(x_at == y.max() - y, numbers[:, y], 0.0)


THIRD = entry("third_rows", "Every third row has an offset of its own.", every_third)
BLOCKS = entry("corner_blocks", "Blocks along the anti-diagonal jump.", corner_blocks, over="pixel")


def sloping_blocks(key, x, values, maps, context):
    """A ramp of its own in every block of 16 pixels, always the same."""
    return x + values["sigma_dn"] * maps["slopes"]


def _ramp(size):
    return (np.arange(size[1]) % 16 - 7.5) / np.sqrt(21.25)


def _slopes(key, values, context):
    rows, columns = (-(-n // 16) for n in context.size)
    blocks = jnp.repeat(jnp.repeat(jax.random.normal(key, (rows, columns)), 16, 0), 16, 1)
    return {"slopes": (blocks[: context.size[0], : context.size[1]] * _ramp(context.size))[None]}


SLOPES = dataclasses.replace(
    entry(
        "block_slopes",
        "Every block of 16 pixels has a ramp.",
        sloping_blocks,
        "frozen",
        "pixel",
        draw_maps=_slopes,
    ),
    pattern=lambda recorded, values: {"slopes": recorded / values["sigma_dn"]},
)


@pytest.mark.parametrize("id", ["unknown", "row_noise"])
def test_names_that_mean_something_already_are_refused(id):
    with pytest.raises(ValueError, match="choose another"):
        registered(mechanisms=[entry(id, "Something else.", every_third)])


def test_one_that_is_off_by_default_is_looked_for():
    off = entry("third_rows", "Every third row has an offset of its own.", every_third)
    parameter = off.record.parameters[0]._replace(default=0.0)
    off = dataclasses.replace(off, record=dataclasses.replace(off.record, parameters=(parameter,)))
    assert learned(off.record, white(np.random.default_rng(5)), RECORDED) is not None


def sampled(own, sigma):
    """Recordings to which the mechanism's definition is added in NumPy."""

    def alter(rng):
        y, x = np.indices(SIZE)

        def change(dn, signal, kind, exposure):
            if own is THIRD:
                return dn + sigma * (y % 3 == 0) * rng.standard_normal((SIZE[0], 1))
            numbers, block = sigma * rng.standard_normal(SIZE[0] // 16), y // 16
            return dn + np.where(x // 16 == block.max() - block, numbers[block], 0.0)

        return change

    return alter


@pytest.mark.slow
@pytest.mark.parametrize(
    "own, sigma",
    [(THIRD, 1.5), (BLOCKS, 3.0)],
    ids=["third rows", "blocks"],
)
def test_it_is_found_named_fitted_proved_and_simulated(own, sigma):
    capture = capture_set(71, sampled(own, sigma), kinds="df")
    found = diagnose(capture, mechanisms=(own,), compare=False)
    assert found.findings[0] == own.id
    report = document(found, key=0, version="")
    first = next(f for f in report["findings"] if f["mechanism"] == own.id)
    # The frames held back hold few blocks: their own interval says so, which is of one draw in ten.
    low, high = first["amplitude"]["ci90"]
    assert 2 * low - high < sigma < 2 * high - low
    assert found.fitted.steps[0].named.score.amplitude == pytest.approx(sigma, rel=0.15)
    assert first["amplitude"]["unit"] == "DN" and first["class"] == "sensor"
    assert first["p_value"] < 1e-6
    assert first["heldout_gain_nats"] > 0 and first["heldout_gain_nats_per_pixel"]["ci90"][0] > 0
    assert first["sentence"].startswith(own.term.definition[:-1])
    fitted = {f.mechanism: f for f in found.model.mechanisms}[own.id]
    assert fitted.parameters["sigma_dn"] == pytest.approx(sigma, rel=0.15)
    drawn = found.model.sample(jax.random.key(0), np.zeros(SIZE, np.float32), Settings(frames=4))
    less = found.model.without(own.id).sample(
        jax.random.key(0), np.zeros(SIZE, np.float32), Settings(frames=4)
    )
    assert np.std(np.asarray(drawn, float) - np.asarray(less, float)) > 0


SMALL = (48, 64)


def quarter(key, x, values, maps, context):
    """A factor of the light on a quarter of the frame: one number a frame."""
    on = (jnp.indices(context.size) < jnp.array(context.size)[:, None, None] // 2).all(0)
    factor = 1 + values["sigma"] * jax.random.normal(key, (len(x), 1, 1))
    return context.black_level + (x - context.black_level) * jnp.where(on, factor, 1.0)


def response(key, x, values, maps, context):
    """Rows that answer to light by factors of their own."""
    return context.black_level + (x - context.black_level) * (1 + values["sigma"] * maps["rows"])


def leaks(key, x, values, maps, context):
    """Columns of more dark signal than others, DN a second."""
    return x + values["sigma"] * context.exposure_s * maps["columns"]


def crossed(key, x, values, maps, context):
    """Antidiagonals that share noise."""
    shared = jax.random.normal(key, (len(x), sum(context.size) - 1))
    return x + values["sigma"] * shared[:, jnp.indices(context.size).sum(0)]


def lines(key, values, context):
    drawn = jax.random.normal(key, (1, sum(context.size)))
    return {"rows": drawn[:, : context.size[0], None], "columns": drawn[:, None, context.size[0] :]}


def of(id, sample, point, unit, sigma):
    parameter = Parameter("sigma", unit, sigma, 0.0, 1e4, "rms")
    maps = lines if point.time == "frozen" else None
    record = Mechanism(id, point, (parameter,), sample=sample, draw_maps=maps, home="own:HERE")
    return Entry(Term(id, "Of the tests.", None, "sensor", unit, RMS), record, needs="flats and darks")


def planted(which, sigma):
    """The same in NumPy."""

    def alter(rng):
        rows, columns = rng.standard_normal((SMALL[0], 1)), rng.standard_normal(SMALL[1])
        y, x = np.indices(SMALL)

        def change(dn, signal, kind, exposure):
            if which is leaks:
                return dn + sigma * exposure * columns
            if which is crossed:
                return dn + sigma * rng.standard_normal(sum(SMALL))[y + x]
            on = (y < SMALL[0] // 2) & (x < SMALL[1] // 2)
            factor = rows if which is response else on * rng.standard_normal()
            return dn + sigma * factor * (dn - 200.0)

        return change

    return alter


@pytest.mark.parametrize(
    "sample, sigma, point, unit",
    [
        pytest.param(
            response,
            0.02,
            Point("readout", "signal", "row", "frozen", "multiply"),
            "1",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            leaks, 20.0, Point("readout", "signal", "column", "frozen"), "DN/s", marks=pytest.mark.slow
        ),
        (crossed, 2.0, Point("readout", "signal", "antidiagonal", "redrawn"), "DN"),
    ],
)
def test_it_has_its_name_where_the_package_looks_for_what_has_none(sample, sigma, point, unit):
    """By a statistic in closed form, which tells more than draws do."""
    own = of("of_tests", sample, point, unit, sigma / 2)
    capture = capture_set(83, planted(sample, sigma), kinds="df", size=SMALL)
    found = diagnose(capture, mechanisms=(own,), compare=False)
    assert found.findings[0] == "of_tests"
    assert found.fitted.steps[0].named.score.amplitude == pytest.approx(sigma, rel=0.25)


@pytest.mark.slow
def test_its_strength_does_not_hang_on_its_name():
    """With which its template is drawn: of one number a frame few draws tell the power."""
    capture = capture_set(84, planted(quarter, 0.02), kinds="f", frames=16, size=SMALL)
    names = ("of_tests", "quarter")
    at = Point("readout", "signal", "block", "redrawn", "multiply")
    own = registered((), [of(n, quarter, at, "1", 0.01) for n in names])
    prepared = splits_of(capture, entries=searched(own)).looking
    scores = [s.score(prepared.fields) for s in prepared.signatures if s.mechanism in names]
    assert len(scores) == len(names)
    strengths = [s.amplitude for s in scores]
    assert np.ptp(strengths) < 0.2 * np.mean(strengths)
    assert all(s.error > 0.02 * s.amplitude for s in scores)


@pytest.mark.slow
def test_a_frozen_pattern_from_outside_is_kept_as_it_was_recorded():
    slopes = np.random.default_rng(9).standard_normal((SIZE[0] // 16, SIZE[1] // 16))
    truth = 3.0 * np.repeat(np.repeat(slopes, 16, 0), 16, 1) * _ramp(SIZE)
    capture = capture_set(73, lambda rng: lambda dn, signal, kind, exposure: dn + truth, kinds="df")

    def seen(model):
        """The mean of frames less that of the same frames without it, DN."""
        drawn = [
            np.asarray(m.sample(jax.random.key(1), np.zeros(SIZE, np.float32), Settings(frames=32)), float)
            for m in (model, model.without(SLOPES.id))
        ]
        return (drawn[0] - drawn[1]).mean(0).ravel()

    found = diagnose(capture, mechanisms=(SLOPES,), compare=False)
    assert found.findings == [SLOPES.id] and found.proofs[0].confirmed
    shown, other = seen(found.model), seen(found.model.with_unit(jax.random.key(3)))
    assert np.corrcoef(shown, truth.ravel())[0, 1] > 0.9
    assert np.std(shown) == pytest.approx(np.std(truth), rel=0.1)
    assert abs(np.corrcoef(other, truth.ravel())[0, 1]) < 0.3


def test_one_of_the_capture_is_found_and_is_not_in_the_camera_model():
    lamp = dataclasses.replace(THIRD, term=dataclasses.replace(THIRD.term, kind="capture"))
    found = diagnose(capture_set(71, sampled(THIRD, 1.5), kinds="d"), mechanisms=(lamp,), compare=False)
    assert found.findings == [lamp.id] and found.proofs[0].confirmed
    (told,) = document(found, key=0, version="")["findings"]
    assert told["class"] == "capture"
    assert lamp.id not in {f.mechanism for f in found.model.mechanisms}


@pytest.mark.parametrize(
    "over",
    [pytest.param(s, marks=() if s == "row" else pytest.mark.slow) for s in SITES],
)
def test_it_is_reported_where_it_varies(over):
    record = mechanism_from_grammar(Point("readout", "signal", over, "redrawn"), id="own", default=1.0)
    (signature,) = generic.by_sampling(record, name="own", known={}, simulated=True)(RECORDED)
    where = signature.score(white(np.random.default_rng(6), size=(48, 64))).where
    assert where["axis"] == over == signature.axes.varies_over and place(where)


def test_where_it_is_not_it_is_not_found_and_told_what_would_be():
    found = diagnose(capture_set(72, kinds="d"), mechanisms=(THIRD, "row_noise"), compare=False)
    assert found.findings == []
    missing = {m["mechanism"]: m for m in document(found, key=0, version="")["not_found"]}
    assert 0 < missing["third_rows"]["smallest_detectable"]["value"] < 1.0


def test_the_name_of_one_of_the_package_is_refused():
    with pytest.raises(ValueError, match="row_noise: there is a mechanism of this name"):
        diagnose(capture_set(73, kinds="d"), mechanisms=(entry("row_noise", "Mine.", every_third),))


def test_a_signature_named_as_one_of_the_package_is_refused_in_one_line():
    """Scores are kept by name: the findings of one of them would be lost."""
    taken = next(iter(SIGNATURES))
    looks = generic.by_sampling(THIRD.record, name=taken, known={}, simulated=True)
    own = dataclasses.replace(THIRD, signatures=looks)
    with pytest.raises(ValueError, match=f"^{taken}: 2 signatures of this name, of .*third_rows") as error:
        diagnose(capture_set(73, kinds="d"), mechanisms=(own,), compare=False)
    assert "\n" not in str(error.value)


def test_one_from_outside_says_what_covers_it():
    taken = next(iter(SIGNATURES))
    before = {s.name: s.covers for s in signatures(RECORDED)}

    def looks(recorded):
        (own,) = generic.by_sampling(THIRD.record, name="own", known={}, simulated=True)(recorded)
        return (dataclasses.replace(own, covered_by=(taken,)),)

    own = dataclasses.replace(THIRD, signatures=looks)
    after = {s.name: s.covers for s in signatures(RECORDED, (*ENTRIES, own))}
    assert after.pop("own") == () and after == before | {taken: (*before[taken], "own")}


@pytest.mark.parametrize(
    "own", [pytest.param(THIRD, marks=pytest.mark.slow), BLOCKS], ids=["third rows", "blocks"]
)
def test_p_is_uniform_without_an_effect(own):
    (signature,) = generic.by_sampling(own.record, name=own.id, known={}, simulated=True)(RECORDED)
    p = np.exp([signature.score(white(np.random.default_rng(s), size=(48, 64))).log_p for s in range(200)])
    for level in (0.5, 0.1):
        assert np.mean(p < level) == pytest.approx(level, abs=3.5 * np.sqrt(level / 200))
    assert p.min() > 1e-5


@pytest.mark.parametrize(
    "acts_on, combine",
    [("signal", "add"), pytest.param("charge", "add", marks=pytest.mark.slow), ("charge", "multiply")],
)
def test_a_pattern_is_handed_over_in_the_unit_that_it_acts_on(acts_on, combine):
    """Planted in DN; of charge it is in electrons, of a factor in shares of the signal."""
    stage = "pixel" if acts_on == "charge" else "readout"
    record = mechanism_from_grammar(Point(stage, acts_on, "pixel", "frozen", combine), id="own", default=0.1)
    rng, size = np.random.default_rng(8), (48, 64)
    fields, truth = white(rng, kinds=("flat",), size=size, signal=200.0), rng.standard_normal(size)
    planted = tuple(f._replace(static=f.static + np.float32(30 * truth)) for f in fields)
    (field,) = planted
    (own,) = generic.by_sampling(
        record, name="own", known={}, simulated=True, maps_of=lambda recorded, values: {"field": recorded}
    )(RECORDED)
    pattern = own.pattern(planted, own.score(planted), rng)
    in_dn = 30 * truth / np.sqrt(field.frames) / field.weight
    unit = {"signal": 1.0, "charge": 1 / np.mean(field.gain)}[acts_on]
    unit = 1 / field.signal if combine == "multiply" else unit
    assert np.corrcoef(pattern.ravel(), (in_dn * unit).ravel())[0, 1] > 0.99
    assert np.std(pattern) == pytest.approx(np.std(in_dn * unit), rel=0.03)
