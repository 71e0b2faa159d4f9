"""Entries of one's own that cannot work: refused in one line that names them, before anything is measured."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.mechanisms.checked import check_draws, check_entry, measurable
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.foreign import called
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Mechanism, Parameter
from cannoise_jax.physics.transfer.estimate import NotMeasurable, normal_estimate
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.signatures import generic
from cannoise_jax.vocabulary import RMS, Term
from tests.discovery.looks import RECORDED, white

SIZE = (24, 31)


def offsets(key, x, values, maps, context):
    return x + values["sigma_dn"] * maps["offsets"]


def draw(key, values, context):
    return {"offsets": jax.random.normal(key, (1, 1, context.size[1]))}


OWN = Entry(
    Term("stripes", "Columns have offsets.", None, "sensor", "DN", RMS),
    Mechanism(
        id="stripes",
        point=Point("readout", "signal", "column", "frozen"),
        parameters=(Parameter("sigma_dn", "DN", 1.0, 0.0, 1e4, "rms"),),
        sample=offsets,
        draw_maps=draw,
        home="own:STRIPES",
    ),
    needs="darks",
)


def of(**changes):
    return dataclasses.replace(OWN, record=dataclasses.replace(OWN.record, **changes))


def named(id):
    record = dataclasses.replace(OWN.record, id=id)
    return dataclasses.replace(OWN, term=dataclasses.replace(OWN.term, id=id), record=record)


def numpy_alone(key, x, values, maps, context):
    return np.asarray(x) + 1.0


def test_one_that_works_passes():
    check_entry(OWN)
    check_draws([OWN], SIZE)
    off = OWN.record.parameters[0]._replace(default=0.0)
    kept = dataclasses.replace(
        of(parameters=(off,)), pattern=lambda recorded, values: {"offsets": recorded / values["sigma_dn"]}
    )
    check_draws([kept], SIZE)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        (named(""), "^'': is no name"),
        (named("my mech/../<b>x</b>"), "is no name of a mechanism"),
        (named("unknown_stripes"), "^unknown_stripes: findings without a name"),
        (of(home=" "), "no `home`"),
        (of(sample=3), "`sample` is of type int"),
        (of(amplitude=None), "`amplitude` is of type NoneType"),
        (of(point=Point("readout", "signal", "pixel", "redrawn", spectrum="power_law")), "runs over rows"),
        (of(point=SimpleNamespace(**dataclasses.asdict(OWN.record.point))), "give a grammar.Point"),
        (of(parameters=("sigma_dn",)), "give a tuple of Parameter"),
        (of(scaling=None), "its scaling is of type NoneType"),
        (dataclasses.replace(OWN, needs=None), "`needs` is None"),
        (dataclasses.replace(OWN, signatures=None), "`signatures` is of type NoneType"),
        (dataclasses.replace(OWN, estimator=lambda s, b: {}), "`estimator` is of type function"),
    ],
)
def test_what_shows_without_a_call(entry, said):
    with pytest.raises((ValueError, TypeError), match=said) as error:
        check_entry(entry)
    assert "\n" not in str(error.value) and str(entry.id) in str(error.value)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        (of(parameters=(Parameter("sigma_dn", "DN", float("nan"), 0.0, 1e4),)), "not a finite number"),
        (of(parameters=(Parameter("sigma_dn", "DN", 3.0, 0.0, 1.0),)), "sigma_dn = 3 is outside 0 to 1"),
        (of(sample=lambda key, x, values, maps, context: x * values["no"]), "`sample` fails .KeyError: 'no'"),
        (of(sample=lambda key, x: x), "`sample` fails .TypeError"),
        (of(sample=lambda *given: None), "its sampler returns a value of type NoneType"),
        (of(sample=lambda key, x, *more: x[0]), "its sampler returns .24, 31. for frames"),
        (of(sample=numpy_alone), "write it in jax.numpy"),
        (of(draw_maps=lambda *given: jnp.zeros(3)), "`draw_maps` returns a value of type"),
        (of(draw_maps=lambda *given: {"offsets": jnp.zeros(3)}), "gives offsets the shape .3,."),
        (of(draw_maps=lambda *given: 1 / 0), "`draw_maps` fails .ZeroDivisionError"),
        (of(effect=lambda *given: 3.0), "`effect` returns a value of type float"),
        (of(baseline=lambda *given: None), "`baseline` returns a value of type NoneType"),
        (of(amplitude=lambda values, context: values["no"]), "`amplitude` fails"),
        (of(amplitude=lambda values, context: float("nan")), "`amplitude` is nan"),
        (dataclasses.replace(OWN, pattern=lambda recorded, values: recorded), "`pattern` returns a value"),
        (dataclasses.replace(OWN, pattern=lambda recorded, values: {"no": recorded}), "it has offsets"),
    ],
)
def test_what_a_call_shows(entry, said):
    with pytest.raises(BadInput, match=f"^stripes: .*{said}") as error:
        check_draws([entry], SIZE)
    assert "\n" not in str(error.value)


def looking(**changes):
    def signatures(recorded):
        (found,) = generic.by_sampling(OWN.record, name="own", known={}, simulated=True)(recorded)
        return (dataclasses.replace(found, **changes),)

    return dataclasses.replace(OWN, signatures=signatures)


def test_signatures_fail_in_one_line_and_those_of_the_kit_are_left_as_they_are():
    for wrong in (lambda recorded: 3, lambda recorded: recorded.nothing, lambda recorded: (3,)):
        with pytest.raises(BadInput, match="^stripes: its `signatures`"):
            dataclasses.replace(OWN, signatures=wrong).looks(RECORDED)
    fields = white(np.random.default_rng(0))
    for score, said in (
        (lambda f: {}["no"], "fails .KeyError"),
        (lambda f: 3.0, "returns a value of type float"),
    ):
        (signature,) = looking(score=score).looks(RECORDED)
        with pytest.raises(BadInput, match=f"^stripes: its `score` of own {said}"):
            signature.score(fields)
    (plain,) = looking().looks(RECORDED)
    (other,) = looking().signatures(RECORDED)
    assert plain.predict is other.predict and plain.quoted is other.quoted


def estimating(measure):
    return dataclasses.replace(OWN, estimator=Estimator(measure=measure))


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda: 1 / 0, "estimator fails .ZeroDivisionError"),
        (lambda: 3.0, "returns a value of type float"),
        (dict, "returns a value of type dict"),
        (lambda: {"nope": normal_estimate(1.0, 0.1)}, "measures 'nope': it has sigma_dn"),
        (lambda: {"sigma_dn": 1.0}, "estimator .sigma_dn. returns a value of type float"),
        (lambda: {"sigma_dn": normal_estimate(float("nan"), 0.1)}, "sigma_dn = nan"),
    ],
)
def test_an_estimator_fails_in_one_line(answer, said):
    (entry,) = measurable([estimating(lambda statistics, baseline: answer())])
    with pytest.raises(BadInput, match=f"^stripes: its .*{said}"):
        entry.estimator([], None)


def test_an_estimator_that_works_is_left_as_it_is():
    for found in ({"sigma_dn": normal_estimate(1.0, 0.1)}, NotMeasurable("record darks")):
        (entry,) = measurable([estimating(lambda statistics, baseline, found=found: found)])
        assert entry.estimator([], None) is found
    with pytest.raises(ValueError, match="stripes: has no estimator"):
        measurable([OWN])
    with pytest.raises(ValueError, match="stripes: is given twice"):
        measurable([estimating(lambda *given: {})] * 2)


def test_interrupts_and_want_of_memory_are_not_the_users():
    def interrupted():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise RuntimeError("in __set_name__") from error

    def small():
        raise MemoryError

    for function, kind in ((interrupted, RuntimeError), (small, MemoryError)):
        with pytest.raises(kind) as error:
            called("stripes", "`sample`", function)
        assert not isinstance(error.value, BadInput)
