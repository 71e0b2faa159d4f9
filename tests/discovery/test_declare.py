"""What can be tested, and what is said of the rest."""

from cannoise_jax.discovery.battery import prepare_split, split_recordings
from cannoise_jax.discovery.declare import NEEDS, UNTESTED, needs
from cannoise_jax.mechanisms import VOCABULARY
from tests.discovery.capture import capture_set


def test_every_mechanism_is_looked_for_or_said_not_to_be():
    capture = capture_set(1)
    probes = prepare_split(capture, split_recordings(capture), judge_stated=True).signatures
    looked_for = {p.mechanism for p in probes} | {m for p in probes for m in p.reads_as}
    assert set(VOCABULARY) - {"unknown"} == set(NEEDS)
    assert set(NEEDS) - looked_for == set(UNTESTED)
    assert all(needs(id).startswith("nothing looks for it yet") == (id in UNTESTED) for id in NEEDS)
