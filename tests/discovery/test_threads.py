"""Pieces of work on two threads."""

from __future__ import annotations

import threading

from cannoise_jax.discovery.frames import threads


def test_two_pieces_are_worked_on_at_once_and_come_back_in_order(monkeypatch):
    monkeypatch.setattr(threads, "WORKERS", 2)
    both, said = threading.Barrier(2, timeout=60), []

    def square(number):
        both.wait()
        return number**2

    assert threads.each(square, range(6), said.append, "squares") == [0, 1, 4, 9, 16, 25]
    assert sorted(said) == [f"squares, {n} of 6" for n in range(1, 6)]
