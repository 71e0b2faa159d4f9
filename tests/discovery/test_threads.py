"""Pieces of work on two threads."""

from __future__ import annotations

import threading

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames import threads
from tests.discovery.capture import capture_set


def test_two_pieces_are_worked_on_at_once_and_come_back_in_order(monkeypatch):
    monkeypatch.setattr(threads, "WORKERS", 2)
    both, said = threading.Barrier(2, timeout=60), []

    def square(number):
        both.wait()
        return number**2

    assert threads.each(square, range(6), said.append, "squares") == [0, 1, 4, 9, 16, 25]
    assert sorted(said) == [f"squares, {n} of 6" for n in range(1, 6)]


def test_a_search_on_two_threads_finds_what_it_finds_on_one(monkeypatch):
    """The other tests search on one: on two, statistics that are kept for later are asked for at once."""

    def rows(rng):
        return lambda dn, *_: dn + 2.0 * rng.standard_normal((dn.shape[0], 1))

    found = []
    for workers in (1, 2):
        monkeypatch.setattr(threads, "WORKERS", workers)
        found.append(diagnose(capture_set(5, rows, kinds="d", size=(64, 96)), compare=False))
    told = [[(s.named.mechanism, s.named.score.amplitude) for s in f.fitted.steps] for f in found]
    assert told[0] == told[1] and told[0][0][0] == "row_noise"
