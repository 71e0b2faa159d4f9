"""How one error rate is shared by all tests of a run."""

from __future__ import annotations

from typing import NamedTuple


class Multiplicity(NamedTuple):
    """Sidak's bound with weights: Genovese, Roeder & Wasserman, False discovery control with p-value
    weighting, Biometrika 93, 509 (2006).

    rare: weight of a test whose p is 1 unless something is far off, against 1 of the others: it takes that
      much less of the common error rate, and rejects with so little when it does.
    effective: independent tests for each one of the battery, for several look at the same frames through like
      templates: the upper end of the 90 % interval, 0.66 to 0.81, of the r that makes 1 - (1 - p)^r uniform
      over 240 sets without an effect (capture sets of the blind proof).
    names, layer, network: shares of the error rate of a run of the search for mechanisms, of the comparison
      that knows no names, and of the two-sample test.
    looking, together: shares of the first of these for the frames that look, and for all frames.
      They add up to one, so that the rate of the whole is kept whatever the two looks have in common.
    suspect: family-wise p of the frames that look from which on a second look is worth its time.
    candidate: p of a single signature, of those frames, from which on it takes part.
      These two save time and cost no error.
    """

    rare: float = 0.3
    effective: float = 0.8
    names: float = 0.8
    layer: float = 0.15
    network: float = 0.05
    looking: float = 0.6
    together: float = 0.4
    suspect: float = 0.3
    candidate: float = 0.05


SHARED = Multiplicity()
