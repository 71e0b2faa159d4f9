"""Cameras of the plain generator: repeatable, of the noise they say, and judged as they should be."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cannoise_jax.blind.plain_camera import Camera, Effect, Shot, expose
from cannoise_jax.blind.plain_listed import LISTED
from cannoise_jax.blind.plain_names import ARGUABLE, BESIDE
from cannoise_jax.blind.plain_unlisted import FIRST, LATER, UNLISTED
from cannoise_jax.mechanisms import VOCABULARY
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.trials import plain
from cannoise_jax.trials.analysis import fingerprint
from cannoise_jax.trials.plain import families, flagged, named, plain_set, plain_trial, scored, unknown, wrong

SMALL = (32, 48)


@pytest.mark.parametrize(("kind", "name"), families())
def test_every_family_makes_a_capture_set_that_its_seed_repeats(kind, name):
    one, again, other = (plain_set(kind, name, seed, SMALL) for seed in (1, 1, 2))
    assert [r.kind for r in one.recordings].count("flat") == 4
    for a, b in zip(one.recordings, again.recordings, strict=True):
        np.testing.assert_array_equal(a.frames, b.frames)
    assert one.recordings[0].black_level != other.recordings[0].black_level


def test_without_an_effect_the_noise_is_poissons_and_normal():
    camera, rng = Camera("MONO", 2.0, 5.0, 800.0, 16383.0, (64, 64)), np.random.default_rng(3)
    level = np.full(camera.size, 0.3)
    frames = np.stack([expose(camera, Effect(), level, Shot("flat", 0.1, t, {}), rng) for t in range(40)])
    signal = 0.3 * camera.span
    assert frames.mean() == pytest.approx(800 + signal, rel=1e-3)
    expected = camera.gain * signal + camera.read_dn**2 + 1 / 12
    assert frames.var(0, ddof=1).mean() == pytest.approx(expected, rel=0.02)


def test_names_are_of_the_vocabulary_and_families_told_once():
    names = {n for _, true in LISTED.values() for n in true} | {
        n for v in (*ARGUABLE.values(), *BESIDE.values()) for n in v
    }
    assert names <= set(VOCABULARY)
    assert set(ARGUABLE) <= set(UNLISTED) and set(BESIDE) <= set(LISTED)
    assert len(UNLISTED) == len(FIRST) + len(LATER) and not {*UNLISTED} & {*LISTED}


def line(kind, family, *findings, verdict="explained"):
    return {
        "kind": kind,
        "family": family,
        "seed": 1,
        "verdict": verdict,
        "shadows": False,
        "findings": [list(f) for f in findings],
    }


def test_the_score_counts_wrong_names_and_not_true_ones():
    tear = line("unlisted", "tear", ("unknown", True), ("offset_drift", True), ("row_pink_noise", True))
    echo = line("unlisted", "echo", ("unknown", True), ("banding", False))
    rows = line("listed", "rows", ("row_noise", True), ("dsnu", False))
    missed = line("listed", "hot", ("unknown", True))
    assert wrong(tear, True) == ["row_pink_noise"] and wrong(echo, False) == ["banding"]
    assert named(rows) and not named(missed) and wrong(rows, False) == ["dsnu"]
    found = scored([tear, echo, rows, missed, line("null", "nothing", verdict="match")])
    assert found["values"] == {
        "wrong_names": "tear 1: row_pink_noise", "wrong_not_confirmed": "echo 1: banding; rows 1: dsnu",
        "not_named": "hot 1", "not_told": "none", "false_alarms": "none", "refused": "none",
    }  # fmt: skip
    assert [r[1] for r in found["rows"]] == [
        "2 of 2", "2 of 2", "1 of 2", "1 of 2",  # unlisted
        "1 of 1", "1 of 1", "0 of 1", "1 of 1",  # of them the later half, which echo is of
        "1 of 2", "0 of 2", "1 of 2", "0 of 1",
    ]  # fmt: skip
    assert found["rows"][0][2] == "2 of 2 (16–100 %)"


@pytest.mark.parametrize(
    ("verdict", "findings", "is_unknown"),
    [
        ("match", [], False),
        ("explained", [("banding", True)], False),
        ("explained", [("unknown", False)], True),
        ("partly explained", [("banding", True)], True),
        ("differs, no cause found", [], True),
    ],
)
def test_what_has_no_name_is_a_finding_without_one_or_a_verdict_that_says_so(verdict, findings, is_unknown):
    one = line("unlisted", "echo", *findings, verdict=verdict)
    assert unknown(one) == is_unknown and flagged(one) == (verdict != "match")


def test_seeds_stand_beside_each_other_and_a_wrong_name_is_arguable_only_where_it_is():
    sets = [{**line("unlisted", f, (n, True)), "seed": s} for s, f, n in (
        (1, "tear", "offset_drift"), (2, "echo", "offset_drift"), (2, "three_levels", "rts"),
    )]  # fmt: skip
    found = scored(sets)
    assert found["columns"] == ["sets", "seed 1", "seed 2", "all (95 %)"]
    assert found["rows"][2][1:3] == ["0 of 1", "2 of 2"]
    assert found["values"]["wrong_names"] == "echo 2: offset_drift; three_levels 2: rts"


def test_a_set_that_is_refused_is_a_line_of_its_own(monkeypatch):
    def refuse(*args, **kwargs):
        raise BadInput("4_flat.h5: a gain of 1.6 DN/e-; 5_flat.h5: 2.8")

    monkeypatch.setattr(plain, "diagnose", refuse)
    one = plain.said("null", "nothing", 1, (32, 32))
    assert one["findings"] == [] and one["why"].startswith("4_flat.h5")
    assert scored([one])["values"]["refused"] == "nothing 1"


def test_a_trial_goes_on_where_it_was_cut_off(tmp_path, monkeypatch):
    asked = []

    def said(kind, name, seed):
        asked.append(name)
        return {**line(kind, name, verdict="match"), "seed": seed}

    monkeypatch.setattr(plain, "said", said)
    out = tmp_path / "lines.jsonl"
    first = plain_trial(out, (5,), ("null",), lambda done, of: None)
    out.write_text(out.read_text()[:-10])  # a kill in the middle of the last line
    again = plain_trial(out, (5,), ("null",), lambda done, of: None)
    assert first == again and asked == ["nothing", "vignette", "vignette"]
    cameras = ("blind/plain_camera.py", "blind/plain_listed.py")  # not those without a name
    for other in ("other", fingerprint(), fingerprint(*cameras)):
        out.write_text(json.dumps({"code_sha256": other}) + "\n")
        with pytest.raises(BadInput, match="another analysis or other cameras"):
            plain_trial(out, (5,), ("null",), lambda done, of: None)


@pytest.mark.slow
def test_one_of_each_kind_at_small_size():
    rows, pairs, nothing = (
        plain.said(kind, name, 4, (64, 96), compare=False)
        for kind, name in (("listed", "rows"), ("unlisted", "shared_pairs"), ("null", "nothing"))
    )
    assert named(rows) and not wrong(rows, True)
    assert flagged(pairs) and unknown(pairs) and not wrong(pairs, True)
    assert not flagged(nothing) and not nothing["findings"]


@pytest.mark.slow
def test_a_listed_effect_is_named_and_an_unlisted_one_is_not():
    rows = plain.said("listed", "rows", 4, (64, 96))
    assert named(rows) and not wrong(rows, True)
    frames = plain.said("unlisted", "noisy_frames", 4, (64, 96))
    assert not wrong(frames, True)
