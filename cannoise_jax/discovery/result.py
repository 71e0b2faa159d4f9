"""What a run of the verbs found, as one record: reports are written from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from cannoise_jax.discovery.frames.battery import Prepared
from cannoise_jax.discovery.proof.check import Checked
from cannoise_jax.discovery.proof.excess import Excess
from cannoise_jax.discovery.proof.gate import Gated
from cannoise_jax.discovery.proof.prove import Proof, Proofs
from cannoise_jax.discovery.proof.quality import Quality
from cannoise_jax.discovery.proof.twosample import differs as told_apart
from cannoise_jax.discovery.proof.verdict import Verdict, verdict_of
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.steps import Fitted, part_of
from cannoise_jax.mechanisms import VOCABULARY
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.transfer.faults import Faults
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.vocabulary import Term


@dataclass(frozen=True, eq=False)
class Result:
    """What a run found. `report.document` turns it into the report, `model` is the extended simulator.

    entries: mechanisms that may be named. splits: frames of every recording that looked for effects, and that
    proved them. steps of `fitted` and `proofs` go together; proven: also the likelihood of the frames held
    back; quality: draws of the simulator before and after against those, None where not measured. faults: of
    the recordings, by ISO. excess: what the simulator has more of than the recordings. key: the seed that
    repeats the run. seconds: that it took, in the report alone."""

    capture: CaptureSet
    simulator: str
    alpha: float
    entries: tuple[Entry, ...]
    testable: tuple[str, ...]
    not_testable: tuple[tuple[str, str], ...]
    splits: list[tuple[list[int], list[int]]]
    first: Prepared
    second: Prepared | None
    fitted: Fitted
    proven: Proofs
    quality: Quality | None
    model: SensorModel
    gated: Gated | None = None
    remains: Checked | None = None
    entered: bool = True
    faults: Mapping[float | None, Faults] = field(default_factory=dict)
    excess: tuple[Excess, ...] = ()
    key: int = 0
    seconds: float | None = None

    @property
    def verdict(self) -> Verdict:
        """What all of it says together: findings, the layer that knows no names, and the two-sample test."""
        handed_back = self.gated.steps if self.gated else self.fitted.steps if self.entered else ()
        aside = part_of(self.fitted.steps)
        each = [
            (s.named.mechanism, s in handed_back, p.confirmed)
            for n, (s, p) in enumerate(zip(self.fitted.steps, self.proofs, strict=True))
            if n not in aside
        ]
        sure = [mechanism for mechanism, _, confirmed in each if confirmed]
        # What is not confirmed explains only where nothing is, and the simulator with it is better.
        kept = sure or [mechanism for mechanism, there, _ in each if there and self.gained]
        before, after = (self.differs(which) for which in (0, 1))
        return verdict_of(
            # Where nothing may be named, what is left of the battery still looks for structures.
            tested=bool(self.testable or self.fitted.first.scores),
            named=bool(self.excess) or any(m != UNKNOWN for m in kept),
            unnamed=UNKNOWN in self.findings,
            differs_before=bool(before) or bool(self.findings),
            differs_after=after,
            remainder=self.gated is not None and self.gated.remainder,
        )

    @property
    def gained(self) -> bool:
        """Whether the findings make the simulator better: by the draws, or in that what differed does so no
        more. Where draws were not compared they may."""
        if self.gated is None or any(t.entered and t.better for t in self.gated.tried if t.steps):
            return True
        return bool(self.differs(0)) and self.differs(1) is False

    def differs(self, which: int) -> bool | None:
        """Whether the simulator before (0) or after (1) is told from the recordings; None: unknown."""
        seen: list[bool] = []
        if self.remains is not None:
            seen.append(bool((self.remains.before, self.remains.after)[which].differences))
        if self.quality is not None and self.quality.two_sample is not None:
            areas = (self.quality.two_sample.before, self.quality.two_sample.after)
            seen.append(told_apart(areas[which], float(np.log(self.alpha * SHARED.network))))
        return any(seen) if seen else None

    @property
    def ids(self) -> tuple[str, ...]:
        """Names that may be given."""
        return tuple(entry.id for entry in self.entries)

    @property
    def terms(self) -> dict[str, Term]:
        """What names mean."""
        return {**VOCABULARY, **{entry.id: entry.term for entry in self.entries}}

    @property
    def proofs(self) -> tuple[Proof, ...]:
        """One for each step."""
        return self.proven.each

    @property
    def findings(self) -> list[str]:
        """Mechanisms found, in the order of acceptance; without what is part of another."""
        aside = part_of(self.fitted.steps)
        return [s.named.mechanism for n, s in enumerate(self.fitted.steps) if n not in aside]
