"""Which of two simulators is nearer, in one line."""

from types import SimpleNamespace

from cannoise_jax.discovery.compare.report import Comparison, better_line
from cannoise_jax.discovery.compare.score import Better


def compared(label, *nats):
    return Comparison(SimpleNamespace(label=label), tuple(SimpleNamespace(nats=n) for n in nats))


def said(gain, low, high, first, second):
    return better_line(
        compared("one.json", *first), compared("two.json", *second), Better(gain, low, high, 40, True, None)
    )


def test_a_log_score_that_tells_is_said_first():
    line = said(0.3, 0.1, 0.5, (900.0, 20.0), (30.0,))
    assert line.startswith("two.json is nearer to the recordings than one.json: log score of B less A +0.3")
    assert line.endswith("left are of one.json 2 differences (920 nats) and two.json 1 difference (30 nats)")


def test_where_it_does_not_tell_what_is_left_is_said():
    line = said(-0.3, -0.8, 0.2, (40.0, 20.0), (900.0,))
    assert line.startswith(
        "the log score of these frames does not tell which is nearer, but one.json differs"
    )


def test_where_both_differ_alike_neither_is_named():
    line = said(-0.3, -0.8, 0.2, (700.0,), (900.0,))
    assert line.startswith("the log score of these frames does not tell which is nearer: log score of B")
    assert "but" not in said(0.0, -0.1, 0.1, (), ())
