"""The documents of a diagnosis follow their schema, field by field, and the page says what they say."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
import tracemalloc
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from cannoise_jax.commands import diagnose as command
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.calls import seed_of
from cannoise_jax.discovery.frames.splits import split_recordings
from cannoise_jax.discovery.proof.prove import Proof
from cannoise_jax.discovery.report.document import digests, document
from cannoise_jax.discovery.report.page import advice, page
from cannoise_jax.discovery.report.wording import sentence
from cannoise_jax.mechanisms import VOCABULARY
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.native import write_recording
from cannoise_jax.recordings.recording import BadInput, CaptureSet
from tests.discovery.capture import capture_set, column_pattern, row_offsets
from tests.discovery.looks import SIGNATURES

IDS = set(VOCABULARY) - {"unknown"}
PLACES = {
    "row": {"index"},
    "column": {"index"},
    "pixel": {"index"},
    "channel": {"channel"},
    "block": {"bbox"},
    "frame": {"index"},
    "signal": {"range"},
    "frequency": {"period_px", "direction"},
    "code": {"period"},
    "edge": {"edge"},
}


def both(rng):
    """Row noise and a frozen pattern of columns."""
    first, second = row_offsets(2.0)(rng), column_pattern(1.5)(rng)
    return lambda dn, signal, kind, t: second(first(dn, signal, kind, t), signal, kind, t)


def darks():
    return capture_set(21, both, kinds="d", size=(64, 128))


@pytest.fixture(scope="module")
def found():
    return diagnose(darks(), key=jax.random.key(1))


@pytest.fixture(scope="module")
def report(found):
    full = document(found, key=1, version="0.0", seconds=2.0, peak_memory_mb=3.0)
    return json.loads(json.dumps(full, allow_nan=False))


def is_number(value) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def check_interval(value, around=None):
    assert len(value) == 2 and all(v is None or is_number(v) for v in value)
    if None not in value:
        assert value[0] <= value[1]
        assert around is None or value[0] <= around <= value[1]


def check_measured(entry, interval=True):
    assert is_number(entry["value"])
    if "unit" in entry:
        assert isinstance(entry["unit"], str)
    if interval:
        check_interval(entry["ci90"], entry["value"])


def check_finding(f):
    assert set(f) - {"card"} == {
        "mechanism", "class", "outcome", "candidates", "where", "amplitude", "parameters", "p_value",
        "log_e_value", "heldout_gain_nats", "heldout_basis", "heldout_pixels", "heldout_gain_nats_per_pixel",
        "sentence", "confirmed", "sign", "share", "in_simulator",
    }  # fmt: skip
    assert f["mechanism"] in VOCABULARY and f["class"] in ("sensor", "capture", "bookkeeping")
    assert f["outcome"] in ("FOUND", "AMBIGUOUS", "UNKNOWN_STRUCTURE")
    assert ("card" in f) == (f["outcome"] == "UNKNOWN_STRUCTURE") == (f["mechanism"] == "unknown")
    assert f["candidates"][0]["mechanism"] == f["mechanism"]
    p = [c["probability"] for c in f["candidates"]]
    assert p == sorted(p, reverse=True) and sum(p) == pytest.approx(1) and min(p) >= 0
    assert "unknown" in {c["mechanism"] for c in f["candidates"]}
    assert PLACES[f["where"]["axis"]] <= set(f["where"])
    check_measured(f["amplitude"])
    for parameter in f["parameters"].values():
        check_measured(parameter)
    assert 0 <= f["p_value"] <= 1
    for name in ("log_e_value", "heldout_gain_nats"):
        assert f[name] is None or is_number(f[name])
    assert f["heldout_basis"] in (None, "likelihood", "statistic", "composite")
    assert f["heldout_pixels"] is None or isinstance(f["heldout_pixels"], int)
    if f["heldout_gain_nats_per_pixel"] is not None:
        check_measured(f["heldout_gain_nats_per_pixel"])
    assert f["sentence"].endswith(".") and "nan" not in f["sentence"]


def check_report(r, ids=IDS):
    """Everything that the schema promises."""
    assert set(r) == {
        "schema", "version", "key", "alpha", "camera", "simulator", "inputs", "verdict", "testable",
        "not_testable", "findings", "not_found", "before", "after", "two_sample", "seconds", "peak_memory_mb",
        "baseline", "faults", "not_measured", "shadows", "too_much", "remainder_share", "gate", "remains",
    }  # fmt: skip
    assert r["schema"] == "cannoise/diagnosis/2" and isinstance(r["key"], int) and 0 < r["alpha"] < 1
    said = ("match", "explained", "partly explained", "differs, no cause found", "not_testable")
    assert r["verdict"] in said
    assert not (r["verdict"] == "match" and r["findings"])
    for entry in r["inputs"]:
        assert set(entry) == {"file", "kind", "frames", "frames_used", "settings", "sha256"}
        assert set(entry["settings"]) == {"iso", "exposure_s", "temperature_c", "reference"}
    untestable = {n["mechanism"] for n in r["not_testable"]}
    assert set(r["testable"]) | untestable == ids and not set(r["testable"]) & untestable
    assert all(n["needs"] for n in r["not_testable"])
    named = {f["mechanism"] for f in r["findings"]}
    missing = {n["mechanism"] for n in r["not_found"]}
    assert missing | named - {"unknown"} == set(r["testable"]) and not missing & named
    for f in r["findings"]:
        check_finding(f)
    gains = [f["heldout_gain_nats"] for f in r["findings"]]
    known = [g for g in gains if g is not None]
    assert known == sorted(known, reverse=True) and gains == known + [None] * (len(gains) - len(known))
    for n in r["not_found"]:
        assert set(n) - {"ambiguous", "absorbed_by", "still_differs"} == {"mechanism", "smallest_detectable"}
        if n["smallest_detectable"] is not None:
            check_measured(n["smallest_detectable"], interval=False)
            assert n["smallest_detectable"]["value"] > 0
    for side in ("before", "after"):
        assert set(r[side]) == {
            "kl", "kl_floor", "nll_nats_per_pixel", "score", "two_sample_auc", "two_sample_auc_ci90",
        }  # fmt: skip
        for name in ("kl", "kl_floor", "nll_nats_per_pixel", "two_sample_auc"):
            assert r[side][name] is None or is_number(r[side][name])
        if r[side]["two_sample_auc_ci90"] is not None:
            check_interval(r[side]["two_sample_auc_ci90"])
    assert r["before"]["score"] == r["after"]["score"]


def test_report_follows_its_schema(report):
    check_report(report)
    assert {f["mechanism"] for f in report["findings"]} == {"row_noise", "column_fpn"}
    assert all(f["heldout_basis"] == "likelihood" for f in report["findings"])


@pytest.mark.parametrize("folder", ["", " ", None, 3])
def test_a_report_goes_into_a_folder_that_is_named(found, folder):
    with pytest.raises(BadInput, match="name a folder for the report"):
        found.save(folder)
    assert len(repr(found)) < 300 and found.verdict in repr(found)


def test_a_saved_report_states_the_key_and_the_time_of_its_run(found, tmp_path):
    report = found.save(tmp_path / "report")
    assert report["key"] == 1 and 0 < report["seconds"] < 3600
    assert "key 1, family-wise" in (tmp_path / "report" / "report.html").read_text()


@pytest.mark.parametrize("seed", [0, 7, 2**31])
def test_a_key_is_stated_as_the_seed_that_makes_it(seed):
    assert seed_of(jax.random.key(seed)) == seed_of(jax.random.PRNGKey(seed)) == seed


def test_after_is_better_than_before_on_frames_held_back(report):
    before, after = report["before"], report["after"]
    assert after["nll_nats_per_pixel"] < before["nll_nats_per_pixel"]
    assert report["verdict"] in ("explained", "partly explained") and before["two_sample_auc"] > 0.65
    assert abs(after["two_sample_auc"] - 0.5) < before["two_sample_auc"] - 0.5
    assert report["two_sample"]["distance_change_ci90"][1] < 0
    pixels = report["findings"][0]["heldout_pixels"]
    saved = (before["nll_nats_per_pixel"] - after["nll_nats_per_pixel"]) * pixels
    gains = sum(f["heldout_gain_nats"] for f in report["findings"])
    assert saved == pytest.approx(gains, rel=0.3)  # each gain is beside the other finding


def test_page_says_it_all_and_loads_nothing(found, report):
    html = page(found, report)
    assert "row noise" in html
    assert "http://" not in html and "https://" not in html and "<script" not in html and 'src="data:' in html
    for f in report["findings"]:
        assert f["sentence"] in html
    for n in report["not_found"]:
        assert n["mechanism"].replace("_", " ") in html.lower()
    for needs, which in advice(report):
        assert needs in html and which in html
    listed = html[html.index('id="found"') : html.index('id="baseline"')].partition("<details")
    for n, f in enumerate(report["findings"]):
        assert f'"#finding-{n + 1}"' in listed[0 if f["confirmed"] else 2]
    shown = re.sub(r"base64,[^\"]*", "", html)
    assert not re.search(r"\b(None|nan|inf)\b", shown)


@pytest.mark.parametrize(
    "kinds, frames",
    [
        pytest.param("d", 1, marks=pytest.mark.slow),
        ("s", 1),
        pytest.param("f", 2, marks=pytest.mark.slow),
        pytest.param("d", 2, marks=pytest.mark.slow),
    ],
)
def test_parts_of_a_set_give_reports_without_what_they_cannot_say(kinds, frames):
    found = diagnose(capture_set(22, both, kinds=kinds, frames=frames))
    report = json.loads(json.dumps(document(found, key=0, version="0"), allow_nan=False))
    check_report(report)
    page(found, report)
    for f in report["findings"]:
        if f["heldout_gain_nats"] is None:
            assert "not confirmed" in f["sentence"] and f["log_e_value"] is None


@pytest.mark.slow
def test_what_may_not_be_named_is_listed_nowhere():
    hidden = ("row_noise", "row_pink_noise")
    found = diagnose(capture_set(23, both), without=hidden, compare=False)
    report = json.loads(json.dumps(document(found, key=0, version="0"), allow_nan=False))
    check_report(report, IDS - set(hidden))
    assert report["findings"][0]["outcome"] == "UNKNOWN_STRUCTURE"


def test_single_frames_are_split_by_scene():
    capture = capture_set(24, kinds="s", frames=1)
    assert split_recordings(capture) == [([0], []), ([], [0])]
    assert split_recordings(capture_set(24, kinds="d", frames=5))[0] == ([0, 1, 2, 4], [3])


class Counted:
    """Frames on disk, as it were: drawn when read, and counted while they are. Of however many, the sixteen
    that are looked at are alike but for one pixel, so that what is found in them is, too."""

    def __init__(self, seed, count, size):
        self.seed, self.shape, self.dtype, self.read = seed, (count, *size), np.dtype(np.uint16), []

    def __len__(self):
        return self.shape[0]

    def __getitem__(self, index):
        numbers = range(self.shape[0])[index]
        self.read.append(len(numbers))
        looked_at = np.linspace(0, self.shape[0] - 1, 16).round().astype(int).tolist()
        frames = np.empty((len(numbers), *self.shape[1:]), np.uint16)
        for frame, t in zip(frames, numbers, strict=True):  # one by one: a file has no float64 copies
            own = [looked_at.index(t)] if t in looked_at else [16, t]
            frame[...] = np.rint(np.random.default_rng([self.seed, *own]).normal(200, 5, frame.shape))
        frames[:, 0, 0] = 170 + np.array(numbers) % 60
        return frames


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_frames():
    peaks = []
    for count in (64, 200):  # in both, so many that the same is found
        recordings = tuple(
            dataclasses.replace(r, frames=Counted(n, count, (96, 128)))
            for n, r in enumerate(capture_set(26, kinds="d", frames=2).recordings)
        )
        tracemalloc.start()
        found = diagnose(CaptureSet("c", recordings), compare=False)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        # One look at every frame, piece by piece, tells which hold noise.
        assert all(sum(n for n in r.frames.read if n > 16) <= count for r in recordings)
        report = document(found, key=0, version="0")
        assert [(i["frames"], i["frames_used"]) for i in report["inputs"]] == [(count, 16)] * 2
        look, show = found.splits[0]
        assert max(look + show) == count - 1 and not set(look) & set(show)
    # Three times as many frames; how the two threads of the search meet moves the peak by some per cent.
    assert peaks[1] < 1.25 * peaks[0]


def test_command_writes_report_page_and_model(report, tmp_path, capsys):
    folder = tmp_path / "recordings"
    folder.mkdir()
    for r in darks().recordings:
        write_recording(folder / r.path, r)
    out = tmp_path / "out"
    assert command.main(["--recordings", str(folder), "--out", str(out), "--key", "1"]) == 0
    written = json.loads((out / "report.json").read_text())
    check_report(written)
    own = ("camera", "inputs", "version", "seconds", "peak_memory_mb")
    assert written["two_sample"]  # one key, one result, of the files as of the arrays
    assert {n: v for n, v in written.items() if n not in own} == {
        n: report[n] for n in written if n not in own
    }
    content = (folder / "0_dark.h5").read_bytes()
    assert written["inputs"][0]["sha256"] == hashlib.sha256(content).hexdigest()
    assert written["key"] == 1 and written["seconds"] > 0 and written["peak_memory_mb"] > 0
    page = (out / "report.html").read_text()
    assert len(page) > 10000
    # Narrow screens show no head of a table: each value says what it is.
    tables = re.findall(r'<table class="measures">(.*?)</table>', page, re.DOTALL)
    heads = [re.findall(r"<th>(.*?)</th>", table)[1:] for table in tables]
    assert ["size", "the simulator has", "share"] in heads and ["before", "after"] in heads
    for head, table in zip(heads, tables, strict=True):
        for line in re.findall(r"<tr><td.*?</tr>", table, re.DOTALL):
            assert re.findall(r'<td[^>]*? data-of="(.*?)"', line) == head
    assert "row_noise" in capsys.readouterr().out
    names = {f.mechanism for f in SensorModel.load(out / "sensor.json").mechanisms}
    assert {"row_noise", "column_fpn"} <= names
    before = (out / "report.json").read_bytes()
    assert command.main(["--recordings", str(tmp_path / "none"), "--out", str(out)]) == 2
    assert (out / "report.json").read_bytes() == before
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("bin/diagnose: ") and np.char.count(error, "\n") == 0


def test_digests_are_those_of_the_files_that_a_recording_was_made_from(tmp_path):
    names = [str(tmp_path / f"dark_{n}.fits") for n in (1, 2)]
    for n, name in enumerate(names):
        (tmp_path / name).write_bytes(b"ab"[n : n + 1])
    first = capture_set(1, kinds="d").recordings[0]
    sums = [hashlib.sha256(text).hexdigest() for text in (b"a", b"b", b"ab")]
    joined = dataclasses.replace(first, path=f"{names[0]} and 1 more", sources=tuple(names))
    files = [{"file": name, "sha256": s} for name, s in zip(names, sums, strict=False)]
    assert digests(joined) == {"sha256": sums[2], "files": files}
    assert digests(dataclasses.replace(first, path=names[0])) == {"sha256": sums[0]}
    assert digests(dataclasses.replace(first, path=None)) == {"sha256": None}


def said_of_a_map(scales, proof):
    entry = {
        "mechanism": "dsnu",
        "outcome": "FOUND",
        "amplitude": {"value": 2.0, "unit": "DN", "ci90": [1.9, 2.1]},
    }
    named = SimpleNamespace(signature=SIGNATURES[f"pixel_{scales}_static"])
    return sentence(entry, SimpleNamespace(named=named, late=False, before=()), proof, VOCABULARY["dsnu"])


def test_a_pattern_of_the_dark_current_is_told_from_one_of_offsets():
    proof = Proof(None, None, math.nan, math.nan, 0)
    assert "growing with the exposure" in said_of_a_map("thermal", proof)
    assert "growing" not in said_of_a_map("additive", proof)


def test_what_frames_that_differ_do_not_confirm_is_told_with_the_interval():
    proof = Proof(None, 42_500.0, -3000.0, 88_000.0, 10_000, "likelihood")
    assert said_of_a_map("additive", proof).endswith(
        "the fit gains 42,500 nats, 90 %: -3,000 to 88,000 nats: not confirmed, these frames differ too much."
    )
