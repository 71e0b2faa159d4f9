"""How long a diagnosis will take: said from the first pass over the frames on, and near what it takes."""

from __future__ import annotations

import re

import pytest

from cannoise_jax.commands.stages import STAGES, Stages


def run(findings: int, second: float, given_up: int = 0, held_back: bool = True):
    """Lines of a run and when each is said; a pass over the frames takes `second`, and searching for what is
    given up takes as long as for what is not."""
    steps = findings + given_up
    less = "" if held_back else ", none held back"
    lines = [(0.0, "calibrate: black level"), (0.9 * second, f"locate: 93 signatures on 54 frames{less}")]
    begins, search = 1.9 * second, second * (STAGES[0].alone + STAGES[0].finding * steps)
    lines += [(begins + search * n / (steps + 1), f"step {n + 1}: prnu (x)") for n in range(steps)]
    lines += [(begins + 0.99 * search, f"given up: {n} (x)") for n in range(given_up)]
    now = begins + search
    for stage in STAGES[1:] if held_back else STAGES[-1:]:
        cost = second * (stage.alone + stage.finding * findings)
        if stage.counted:
            said = f"{stage.begins[-1]} x,"
            lines += [(now + cost * n / findings, f"{said} {n + 1} of {findings}") for n in range(findings)]
        else:
            lines.append((now, stage.begins[-1]))
        now += cost
    return lines, now


@pytest.mark.parametrize(("findings", "given_up"), [(3, 0), (8, 0), (18, 0), (3, 9)])
@pytest.mark.parametrize("second", [0.5, 12.0])
@pytest.mark.parametrize("held_back", [True, False])
def test_the_estimate_is_near_the_truth_from_the_first_pass_on(findings, given_up, second, held_back, capsys):
    lines, end = run(findings, second, given_up, held_back)
    now = [0.0]
    tell = Stages(0.0, lambda: now[0])
    before = float("inf")
    for at, text in lines:
        now[0] = at
        tell(text)
        left = tell.left()
        if text.startswith(("calibrate", "locate")):
            assert left is None and "left" not in tell.words()
            continue
        assert 0.4 < left / (end - at) < 2.5, (text, left, end - at)
        assert left < before + 0.01 or text.startswith("step"), text
        before = left
    said = capsys.readouterr().err.splitlines()
    assert len([line for line in said if re.search(r"some \d+ (s|min) left$", line)]) >= 2
    assert not any("left" in line for line in said[:2])


def test_of_a_stage_that_goes_on_far_beyond_its_time_no_end_is_said():
    lines, end = run(4, 1.0)
    now = [0.0]
    tell = Stages(0.0, lambda: now[0])
    for now[0], text in lines:
        tell(text)
    now[0] = end + 0.5
    assert 0 < tell.left() < 2
    now[0] = end + 100.0
    assert tell.left() is None and tell.words() == f"still {lines[-1][1]}"


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
    tell("compare: a.h5, 2 of 7, some 5 s more")
    assert tell.words() == "still compare: a.h5, 2 of 7"  # without a pass that was timed


def test_what_is_said_of_an_earlier_stage_does_not_lead_back():
    now = [0.0]
    tell = Stages(0.0, lambda: now[0])
    for now[0], text in run(4, 1.0)[0]:
        tell(text)
    left = tell.left()
    tell("remainder: said while something later is done")
    assert tell.left() == left
