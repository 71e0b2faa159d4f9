"""How long a diagnosis will take: said once it can be known, and near what it takes."""

from __future__ import annotations

import re

import pytest

from cannoise_jax.commands.stages import SEARCH, STAGES, Stages


def run(findings: int, second: float, given_up: int = 0):
    """Lines of a run and when each is said; a unit of cost takes `second`, and searching for what is given up
    as well as for what is not."""
    steps = findings + given_up
    search = second * (SEARCH.alone + SEARCH.finding * steps)
    lines = [(0.0, "calibrate: black level"), (search / 9, "locate: 93 signatures on 54 frames")]
    lines += [(search * (2 + n) / (3 + steps), f"step {n + 1}: prnu (x)") for n in range(steps)]
    lines += [(0.99 * search, f"given up: {n} (x)") for n in range(given_up)]
    now = search
    for stage in STAGES[1:]:
        cost = second * (stage.alone + stage.finding * findings)
        begins = stage.begins[-1]
        if stage.counted:
            lines += [(now + cost * n / findings, f"{begins} x, {n} of {findings}") for n in range(findings)]
        else:
            lines.append((now, begins))
        now += cost
    return lines, now


@pytest.mark.parametrize(("findings", "given_up"), [(1, 0), (5, 0), (20, 0), (3, 11)])
@pytest.mark.parametrize("second", [0.1, 3.0])
def test_the_estimate_is_near_the_truth_once_there_is_one(findings, given_up, second, capsys):
    lines, end = run(findings, second, given_up)
    now = [0.0]
    tell = Stages(0.0, lambda: now[0])
    first = None
    for at, text in lines:
        now[0] = at
        tell(text)
        left = tell.left()
        if left is None:
            assert "left" not in tell.words() and text.startswith(("calibrate", "locate", "step", "given"))
        else:
            first = at if first is None else first
            assert 0.5 < left / (end - at) < 2, (text, left, end - at)
    assert first is not None and first < 0.6 * end
    said = capsys.readouterr().err.splitlines()
    assert not any("left" in line for line in said[: 2 + findings + 2 * given_up])
    assert sum(bool(re.search(r"some \d+ (s|min) left$", line)) for line in said) == len(STAGES) - 1


def test_a_stage_that_takes_longer_does_not_end_at_once():
    lines, end = run(4, 1.0)
    now = [0.0]
    tell = Stages(0.0, lambda: now[0])
    for now[0], text in lines:
        tell(text)
    now[0] = end + 100.0
    assert 0.2 * 100 < tell.left() < 100


def test_what_is_counted_is_said_once_and_kept_for_who_waits(capsys):
    tell = Stages(0.0, lambda: 1.0)
    for text in (
        "prove: on the frames held back",
        *(f"prove: strength of findings, {n} of 3" for n in range(3)),
    ):
        tell(text)
    tell("given up: prnu (x), not in the frames held back")
    said = [line.split("] ")[1].split(";")[0] for line in capsys.readouterr().err.splitlines()]
    assert said == [
        "prove: on the frames held back",
        "prove: strength of findings, 0 of 3",
        "given up: prnu (x), not in the frames held back",
    ]
    tell("compare: a.h5, 2 of 7")
    assert tell.words().startswith("still compare: a.h5, 2 of 7; some ")
    tell("remainder: said while something later is done")  # does not lead back
    assert tell.left() is not None
