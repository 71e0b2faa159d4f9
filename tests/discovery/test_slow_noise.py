"""1/f noise that goes on from frame to frame: that the means of frames move with it is no drift beside it."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.report.document import document
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.spectra import below_frame
from tests.discovery.capture import SIZE, capture_set
from tests.discovery.test_groups import coloured

FRAMES = 40


def continued(sigma, drift=0.0):
    """Row offsets cut from one series of power 1/f through all frames, of this strength within a frame."""

    def alter(rng):
        series = coloured(rng, FRAMES * SIZE[0]).reshape(FRAMES, SIZE[0])
        series *= sigma / np.sqrt(np.mean(np.var(series, axis=1)))
        frames = iter(series)
        return lambda dn, signal, kind, t: dn + next(frames)[:, None] + drift * rng.standard_normal()

    return alter


@pytest.mark.slow
def test_means_of_frames_that_move_with_slow_noise_are_part_of_it():
    diagnosis = diagnose(capture_set(22, continued(0.6)), compare=False)
    report = document(diagnosis, key=0, version="0")
    (finding,) = report["findings"]
    assert finding["mechanism"] in ("row_pink_noise", "pink_noise")
    assert diagnosis.findings == [finding["mechanism"]]
    moved = finding["parameters"]["frame_offset"]
    assert moved["ci90"][0] <= moved["value"] <= moved["ci90"][1] and moved["value"] > 0.1
    assert "slower than a frame" in finding["sentence"]
    (aside,) = (e for e in report["not_found"] if e["mechanism"] == "offset_drift")
    assert aside["part_of"] == finding["mechanism"]
    # It stays in the model that draws such frames.
    assert {"offset_drift", finding["mechanism"]} <= {m.mechanism for m in diagnosis.model.mechanisms}


@pytest.mark.slow
def test_a_drift_beyond_the_slow_noise_is_a_finding_of_its_own():
    found = diagnose(capture_set(22, continued(1.0, drift=5.0)), compare=False).findings
    assert "offset_drift" in found and found[0] != found[-1]


@pytest.mark.parametrize("direction, size", [("row", SIZE), ("raster", (24, 32))])
def test_means_of_frames_of_one_long_series_stay_below_the_bound(direction, size):
    rng = np.random.default_rng(5)
    length = size[0] if direction == "row" else size[0] * size[1]
    ratios = []
    for _ in range(200):
        frames = coloured(rng, 25 * length).reshape(25, length)
        within = np.mean(np.var(frames, axis=1))
        where = {"axis": "frequency", "direction": direction}
        score = Score(
            log_p=0.0, gain=0.0, penalty=0.0, amplitude=1.0, error=0.1, shift=0.1, power=2,
            parameters={}, where=where, payload=(float(within), 1.0),
        )  # fmt: skip
        ratios.append(np.std(frames.mean(1), ddof=1) / below_frame(score, size))
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.1
