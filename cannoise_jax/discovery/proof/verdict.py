"""The verdict: what all of a run says together, and what a finding has to show to be confirmed."""

from __future__ import annotations

from typing import Final, Literal

MATCH: Final = "match"
EXPLAINED: Final = "explained"
PARTLY: Final = "partly explained"
NO_CAUSE: Final = "differs, no cause found"
NOT_TESTABLE: Final = "not_testable"

Verdict = Literal["match", "explained", "partly explained", "differs, no cause found", "not_testable"]


def verdict_of(
    *,
    tested: bool,
    named: bool,
    unnamed: bool,
    differs_before: bool,
    differs_after: bool | None,
    remainder: bool,
) -> Verdict:
    """What a run comes to.

    tested: whether anything could be tested.
    named, unnamed: whether findings with and without a name are in the simulator that is handed back.
    differs_before, differs_after: whether the layer or the two-sample test tells the recordings from draws of
      the simulator before and after; None: it was not looked at.
    remainder: whether what no name explains had to be added.
    """
    if not tested:
        return NOT_TESTABLE
    if named:
        everything = differs_after is False and not remainder and not unnamed
        return EXPLAINED if everything else PARTLY
    return NO_CAUSE if unnamed or differs_before or remainder else MATCH
