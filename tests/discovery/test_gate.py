"""What enters the simulator that is handed back, what is said of what still differs, and the verdict."""

from __future__ import annotations

from itertools import combinations
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.compare.sources import open_source
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.splits import split_recordings
from cannoise_jax.discovery.proof import gate as gate_module
from cannoise_jax.discovery.proof.check import Checked, check, compared_on, frames_for, spoils
from cannoise_jax.discovery.proof.gate import lesser
from cannoise_jax.discovery.proof.prove import Proof
from cannoise_jax.discovery.proof.tried import Gain, Tried
from cannoise_jax.discovery.proof.twosample import Area, differs
from cannoise_jax.discovery.proof.verdict import verdict_of
from cannoise_jax.discovery.result import Result
from cannoise_jax.discovery.search.name import UNKNOWN
from tests.discovery.capture import capture_set
from tests.discovery.test_compare_bank import camera, fixed, rows, tails

KEY = jax.random.key(4)


def tried(score=None, area=None):
    gain = None if score is None else Gain(score, score - 0.001, score + 0.001)
    change = None if area is None else Area(area, area - 0.02, area + 0.02)
    return Tried("findings", 1, gain, change, True)


def test_what_helps_one_measure_and_hurts_the_other_does_not_enter():
    assert tried(0.01, -0.1).better and tried(0.01, 0.0).better and tried(0.0, -0.1).better
    assert not tried(0.0, 0.0).better and not tried(0.0, 0.0).worse  # within what two draws differ by
    assert tried(0.01, 0.1).worse and tried(-0.01, -0.1).worse
    assert not tried(0.01, 0.1).better and not tried(-0.01, -0.1).better
    assert not tried().better and not tried().worse


@pytest.mark.parametrize(("before", "after"), [(True, False), (True, True), (False, False)])
def test_findings_beside_which_nothing_differs_any_more_have_gained(before, after):
    """A lamp that drifts in a few frames is too few numbers for a score."""
    run = SimpleNamespace(gated=SimpleNamespace(tried=(tried(0.0),)), differs=lambda n: (before, after)[n])
    assert Result.gained.fget(run) == (before and not after)
    run.gated.tried = (tried(0.01),)
    assert Result.gained.fget(run)


def _proof(confirmed, gain=1.0):
    return Proof(None, gain, 0.5 if confirmed else gain - 1.5, gain + 1.0, 64)


class Bench:
    """A panel that knows how far every model is from the recordings."""

    def __init__(self, areas, scores=None, unsure=()):
        field = SimpleNamespace(frames=4, number=0, kind="dark", mean=np.zeros((8, 8)))
        self.halves = (None, SimpleNamespace(fields=(field,)))
        self.area, self.score, self.unsure = areas, scores or {}, unsure

    def look(self, draw, number):
        model = draw.__closure__[0].cell_contents if draw.__closure__ else draw
        level = self.score.get(model, 0.0) + 1e-4 * np.arange(4)
        return SimpleNamespace(side=SimpleNamespace(composite=level), model=model)

    def change(self, before, after):
        value = self.area[after.model] - self.area[before.model]
        wide = 0.2 if {before.model, after.model} & set(self.unsure) else 0.01
        return Area(value, value - wide, value + wide)

    def areas(self, looked):
        return [Area(0.5 + self.area[one.model], 0.49 + self.area[one.model], 0.6) for one in looked]


@pytest.mark.parametrize(
    "areas, handed_back, steps, rest",
    [
        ({"given": 0.4, "ab": 0.1, "ab+": 0.1, "a+": 0.1, "given+": 0.1}, "ab", "ab", False),
        ({"given": 0.4, "ab": 0.2, "ab+": 0.1, "a+": 0.1, "given+": 0.1}, "ab+", "ab", True),
        ({"given": 0.4, "ab": 0.3, "ab+": 0.3, "a+": 0.3, "given+": 0.05}, "given+", "", True),
        ({"given": 0.4, "ab": 0.3, "ab+": 0.2, "a+": 0.1, "given+": 0.1}, "a+", "a", True),
        ({"given": 0.2, "ab": 0.3, "a": 0.1, "a+": 0.2, "given+": 0.2}, "a", "a", False),
        ({"given": 0.2, "ab": 0.3, "a": 0.3, "given+": 0.3, "a+": 0.3}, "given", "", False),
    ],
)
def test_what_is_handed_back_is_never_worse_than_what_was_given(areas, handed_back, steps, rest):
    """Findings a and b, of which a is confirmed and well described; a plus sign: with the remainder."""
    proofs = SimpleNamespace(each=(_proof(True), _proof(False)))

    draws = gate_module.of_model("given")
    named = {(): "given", ("a",): "a", ("a", "b"): "ab"}
    sides = SimpleNamespace(plain=draws, model="given", bare="given", of=named.get, level=str)
    found = gate_module.gate(Bench(areas), sides, ("a", "b"), proofs)
    found = gate_module.remaining(
        found, Bench(areas), sides, described=("a",), sure=("a",), with_rest=lambda model: model + "+"
    )
    assert (found.model, "".join(found.steps), found.remainder) == (handed_back, steps, rest)
    assert areas[found.model] <= areas["given"]


@pytest.mark.parametrize("without, handed_back", [(0.1, "a"), (0.2, "ab")])
def test_what_the_frames_held_back_lose_by_goes_unless_draws_are_farther_without(without, handed_back):
    """Finding b."""
    proofs = SimpleNamespace(each=(_proof(True), _proof(False, gain=-2.0)))
    named = {(): "given", ("a",): "a", ("a", "b"): "ab"}
    sides = SimpleNamespace(
        plain=gate_module.of_model("given"), model="given", bare="given", of=named.get, level=str
    )
    found = gate_module.gate(Bench({"given": 0.4, "ab": 0.1, "a": without}), sides, ("a", "b"), proofs)
    assert (found.model, "".join(found.steps)) == (handed_back, handed_back)
    assert [t.steps for t in found.tried if t.entered] == [len(handed_back)]


@pytest.mark.parametrize("order", ["abc", "cab"])
def test_one_wrong_finding_does_not_take_the_others_along(order):
    """Three confirmed findings, of which c makes the draws worse whatever is beside it."""
    areas = {"".join(s): 0.4 - 0.1 * ("a" in s) - 0.1 * ("b" in s) + 0.5 * ("c" in s) for s in _parts(order)}
    sides = SimpleNamespace(plain=gate_module.of_model(""), model="", bare="", of="".join, level=str)
    proofs = SimpleNamespace(each=tuple(_proof(True, gain=3.0 if s == "c" else 1.0) for s in order))
    found = gate_module.gate(Bench(areas), sides, tuple(order), proofs)
    assert (found.model, found.steps) == ("ab", ("a", "b"))
    assert [(t.what, t.entered) for t in found.tried] == [("findings", False), ("findings one by one", True)]


def _parts(letters):
    return [s for n in range(len(letters) + 1) for s in combinations(letters, n)]


def gated(bench, confirmed=True):
    """What the gate lets in of two findings a and b, and the sides that it chose from."""
    proofs = SimpleNamespace(each=(_proof(confirmed),) * 2)
    sides = SimpleNamespace(
        plain=gate_module.of_model("given"), model="given", bare="given",
        of={(): "given", ("a",): "a", ("a", "b"): "ab"}.get, level=str, lowered=False,
    )  # fmt: skip
    return gate_module.gate(bench, sides, ("a", "b"), proofs), sides


@pytest.mark.parametrize("without, stays", [(0.3, True), (0.22, False)])
def test_findings_that_lose_stay_where_draws_are_much_farther_without(without, stays):
    """However unsure that is."""
    bench = Bench({"given": 0.5, "ab": 0.2, "a": without}, unsure=("a",))
    proofs = SimpleNamespace(each=(_proof(True), _proof(False, -1.0)))
    assert proofs.each[1].loses
    sides = SimpleNamespace(
        plain=gate_module.of_model("given"), model="given", bare="given",
        of={(): "given", ("a",): "a", ("a", "b"): "ab"}.get, level=str, lowered=False,
    )  # fmt: skip
    assert gate_module.gate(bench, sides, ("a", "b"), proofs).model == ("ab" if stays else "a")


def test_findings_with_a_name_stay_where_one_without_keeps_the_remainder_from_helping():
    """All are well described, b has no name."""
    areas = {"given": 0.4, "ab": 0.2, "ab+": 0.3, "a+": 0.05, "given+": 0.03}
    bench = Bench(areas)
    found, sides = gated(bench)
    found = gate_module.remaining(
        found, bench, sides, described=("a", "b"), sure=("a",), with_rest=lambda model: model + "+"
    )
    assert (found.model, found.steps, found.remainder) == ("a+", ("a",), True)


@pytest.mark.parametrize("beside", [0.0, 0.1])
def test_findings_stay_beside_a_remainder_that_does_little_better_alone(beside):
    """The remainder alone is nearer than the findings, and so is the remainder beside them, less surely."""
    areas = {"given": 0.4, "ab": 0.17, "ab+": beside, "a+": 0.15, "given+": 0.05}
    for unsure in (("ab+",), ()):
        bench = Bench(areas, unsure=unsure)
        found, sides = gated(bench)
        found = gate_module.remaining(
            found, bench, sides, described=("a",), sure=("a",), with_rest=lambda model: model + "+"
        )
        assert (found.model, found.steps, found.remainder) == ("ab+", ("a", "b"), True)
        entered = {t.what for t in found.tried if t.entered}
        assert entered == {"findings", "remainder"}


@pytest.mark.parametrize("error, enters", [(0.024, False), (0.015, True)])
def test_an_area_above_a_half_by_chance_lets_no_remainder_in(error, enters):
    """Of recordings that the area tells from the draws by 1.7 standard errors one in twenty is a null."""
    bench = Bench({"given": 0.4, "ab": 0.0416, "ab+": 0.0, "a+": 0.0, "given+": 0.0})
    found, sides = gated(bench)
    area = Area(-0.0416, -0.08, -0.005, error, 20)
    bench.change = lambda before, after: area
    found = gate_module.remaining(
        found, bench, sides, described=("a", "b"), sure=("a", "b"), with_rest=lambda model: model + "+"
    )
    assert found.remainder == enters


@pytest.mark.parametrize("nearer, handed_back", [(0.1, ["ab", "a"]), (0.4, ["ab", "a", "given"])])
def test_what_may_be_handed_back_where_more_differs_than_before(nearer, handed_back):
    """Without the remainder, without what has no name, and as it was given where none of it helps."""
    areas = {"given": 0.4, "ab": nearer, "ab+": nearer, "a": nearer}
    bench, draws = Bench(areas), gate_module.of_model("given")
    steps = tuple(SimpleNamespace(named=SimpleNamespace(mechanism=m)) for m in ("dsnu", UNKNOWN))
    sides = SimpleNamespace(
        plain=draws, model="given", bare="given", of=lambda some: "ab"[: len(some)] or "given", level=str
    )
    given = bench.look(draws, 0)
    after = bench.look(gate_module.of_model("ab"), 0)
    entered = (gate_module._tried("findings", steps, bench, given, after),)
    spare = gate_module.Gated("ab", given, given, steps, entered, False)
    late = (*entered, entered[0]._replace(what="remainder"))
    whole = gate_module.Gated("ab+", given, given, steps, late, True, spare)
    found = list(lesser(whole, bench, sides, (None, None), steps))
    assert [one.model for one in found] == handed_back
    assert [len(one.steps) for one in found] == [2, 1, 0][: len(found)]
    assert not any(one.remainder for one in found)


def test_a_change_of_few_frames_is_worse_only_where_student_s_law_says_so():
    change = Area(0.06, 0.03, 0.09, 0.025, 2)
    assert (
        not tried()._replace(area=change).worse and tried()._replace(area=change._replace(freedom=30)).worse
    )


def test_an_area_counts_by_its_own_scatter_and_never_when_it_is_small():
    sure = Area(0.7, 0.68, 0.72, 0.012, 20)
    assert differs(sure, np.log(1e-3)) and not differs(sure._replace(error=0.08), np.log(1e-3))
    assert not differs(sure._replace(freedom=1), np.log(1e-4))  # two frames tell little of their scatter
    assert not differs(Area(0.52, 0.519, 0.521, 1e-4, 100), np.log(1e-3))


def test_the_verdict_counts_everything():
    def said(**more):
        plain = {"tested": True, "named": False, "unnamed": False, "differs_before": False}
        return verdict_of(**{**plain, "differs_after": False, "remainder": False, **more})

    assert said() == "match" and said(tested=False) == "not_testable"
    assert (
        said(differs_before=True) == said(unnamed=True) == said(remainder=True) == "differs, no cause found"
    )
    assert said(named=True, differs_before=True) == "explained"
    for left in ({"differs_after": True}, {"differs_after": None}, {"remainder": True}, {"unnamed": True}):
        assert said(named=True, differs_before=True, **left) == "partly explained"


def test_few_frames_held_back_are_seen_against_some_of_the_others():
    assert frames_for([([0, 1, 2, 4], [3]), (list(range(12)), [12, 13, 14, 15]), ([0], [])]) == [
        ([1, 2, 4], [3]), ([], [12, 13, 14, 15]), ([], [])
    ]  # fmt: skip


@pytest.mark.parametrize("alter, what", [(rows(1.0), "rows"), (fixed(1.5), "fixed pattern of single pixels"),
                                         (tails(2.0), "heavy tails")])  # fmt: skip
def test_a_simulator_with_too_much_is_seen_on_frames_held_back(alter, what):
    capture = capture_set(61, kinds="d")
    found = compared_on(capture, split_recordings(capture), open_source(camera(alter), capture, KEY), 0.0015)
    assert {d.sign for d in found.differences if d.what == what} == {-1}


def test_the_right_simulator_leaves_nothing_and_is_nearer():
    capture = capture_set(62, rows(1.5), kinds="d")
    splits = split_recordings(capture)
    before, after = (open_source(camera(a), capture, KEY) for a in (None, rows(1.5)))
    found = check(*(compared_on(capture, splits, source, 0.0015) for source in (before, after)))
    assert found.before.differences and not found.after.differences and found.left == 0
    assert found.nearer is not None and found.nearer.verdict == "B" and found.held_back


@pytest.mark.slow
def test_what_has_no_name_is_in_the_simulator_that_is_handed_back():
    """Half rows that jump are no entry of the catalogue; without names they are still drawn."""

    def halves(rng):
        return lambda dn, *_: dn + 2.5 * np.repeat(rng.standard_normal((96, 2)), 64, 1)

    found = diagnose(capture_set(63, halves, kinds="d"), key=KEY, mechanisms=("gain_error",))
    assert found.gated is not None and found.quality is not None and found.remains is not None
    assert found.verdict == "differs, no cause found"
    left = [sum(d.nats for d in c.differences) for c in (found.remains.before, found.remains.after)]
    assert left[1] < 0.5 * left[0]


@pytest.mark.parametrize(
    ("before", "after", "surely", "worse"),
    [
        ([], [9], False, True),
        ([9], [4, 4], False, False),
        ([], [], False, False),
        ([100], [103], False, True),
        ([100], [103], True, False),  # score and area both came nearer
        ([100], [111], True, True),
        ([], [9], True, True),
    ],
)
def test_what_differs_where_nothing_did_is_worse(before, after, surely, worse):
    one, two = (
        SimpleNamespace(differences=[SimpleNamespace(nats=n) for n in each]) for each in (before, after)
    )
    assert Checked(one, two, None, True, surely).worse == worse  # type: ignore[arg-type]
    # What is far nearer by the area may leave a tenth more.
    far = sum(after) > 1.1 * sum(before) if surely else worse
    assert Checked(one, two, None, True, surely, True).worse == far  # type: ignore[arg-type]


@pytest.mark.parametrize("area, far", [(0.15, True), (0.3, False)])
def test_a_remainder_that_takes_much_off_the_area_is_far_nearer(area, far):
    bench = Bench({"given": 0.5, "ab": 0.4, "ab+": area, "a+": 0.4, "given+": 0.4})
    found, sides = gated(bench)
    found = gate_module.remaining(
        found, bench, sides, described=("a", "b"), sure=("a", "b"), with_rest=lambda model: model + "+"
    )
    assert found.remainder and found.far_nearer == far and not found.without_remainder.far_nearer


@pytest.mark.parametrize(
    ("without", "with_rest", "spoilt"),
    [
        ({"blocks": 500}, {"blocks": 2}, False),
        ({"blocks": 500}, {"blocks": 2, "lines": 40}, False),
        ({"blocks": 500}, {"blocks": 2, "lines": 60}, True),  # what was right is so no longer
        ({"blocks": 400, "lines": 30}, {"lines": 60}, False),
        ({"blocks": 400, "lines": 30}, {"blocks": 400, "lines": 85}, True),  # more differs in all
        ({"blocks": 5}, {"lines": 40}, False),
        ({}, {}, False),
    ],
)
def test_a_remainder_may_not_make_much_of_a_difference_that_was_small(without, with_rest, spoilt):
    one, two, first = (
        SimpleNamespace(differences=[SimpleNamespace(what=w, time="fixed", nats=n) for w, n in each.items()])
        for each in (with_rest, without, {"blocks": 1000})
    )
    assert spoils(one, two, first) == spoilt  # type: ignore[arg-type]


@pytest.mark.parametrize("alone, handed_back", [(0.1, ("a", ("a",))), (0.4, ("given", ()))])
def test_findings_whose_names_hold_enter_where_all_together_are_worse(alone, handed_back):
    areas = {"given": 0.4, "ab": 0.6, "a": alone, "a+": 0.5, "given+": 0.5}
    bench = Bench(areas)
    found, sides = gated(bench, confirmed=False)
    assert found.model == "given"
    found = gate_module.remaining(
        found, bench, sides, described=("a", "b"), sure=("a",), with_rest=lambda model: model + "+"
    )
    assert (found.model, found.steps) == handed_back
