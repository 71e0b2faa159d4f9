"""What can be tested, and what is said of the rest."""

from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.search.declare import needs
from cannoise_jax.mechanisms import ENTRIES
from tests.discovery.capture import capture_set


def test_every_mechanism_is_looked_for_or_said_not_to_be():
    signatures = splits_of(capture_set(1), judge_stated=True).looking.signatures
    seen = {s.mechanism for s in signatures} | {m for s in signatures for m in s.reads_as}
    for entry in ENTRIES:
        assert entry.looked_for == (entry.id in seen), entry.id
        assert needs(entry).startswith("nothing looks for it yet") == (not entry.looked_for)


def test_every_signature_names_others_that_exist():
    signatures = splits_of(capture_set(1), judge_stated=True).looking.signatures
    names = {s.name for s in signatures}
    assert len(names) == len(signatures)
    ids = {entry.id for entry in ENTRIES}
    for s in signatures:
        others = {*s.covers, *s.covered_by, *s.lifted_by, *s.found_in, *({s.after} - {""})}
        assert others <= names, s.name
        assert {s.mechanism, *s.reads_as} <= ids | {None}, s.name
