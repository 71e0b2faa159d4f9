"""bin/fleet: many sets, here and through dask, go on where they stopped, and failures are rows."""

from __future__ import annotations

import contextlib
import csv
import io
import json

import pytest

from cannoise_jax.commands import fleet
from cannoise_jax.discovery.report.fleet import failed, lines, ranked
from cannoise_jax.recordings.native import write_recording
from tests.discovery.capture import capture_set, row_offsets


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """A camera that the simulator fits, one with row noise, and a folder without recordings."""
    folder = tmp_path_factory.mktemp("sets")
    for name, alter in (("fine", None), ("rows", row_offsets(2.0)), ("void", None)):
        (folder / name).mkdir()
        for recording in capture_set(2, alter, kinds="d", size=(32, 48)).recordings if name != "void" else ():
            write_recording(folder / name / recording.path, recording)
    return folder


def call(recordings, out, *more):
    return fleet.main(["--recordings", str(recordings), "--out", str(out), *more])


def rows(out):
    return json.loads((out / "fleet.json").read_text())["rows"]


@pytest.fixture(scope="module")
def here(sets, tmp_path_factory):
    """The fleet diagnosed by processes of this machine."""
    out = tmp_path_factory.mktemp("fleet") / "here"
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        assert call(sets, out, "--processes", "2", "--key", "5") == 1
    first, second, third = said.getvalue().splitlines()[:3]
    assert first.endswith(" left)") and second.endswith(" left)") and not third.endswith(" left)")
    return out


def test_cameras_are_ranked_by_what_their_simulator_lacks(here):
    first, second, last = rows(here)
    assert [r["set"] for r in (first, second, last)] == ["rows", "fine", "void"]
    assert [f["mechanism"] for f in first["findings"]] == ["row_noise"] and first["verdict"] == "explained"
    assert first["nats_per_pixel"] > 10 * second["nats_per_pixel"] >= 0 and first["left"] < 0.5
    assert "void" in last["error"] and "\n" not in last["error"] and not last["verdict"]
    with (here / "fleet.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [(r["set"], r["error"]) for r in table] == [("rows", ""), ("fine", ""), ("void", last["error"])]
    assert float(table[0]["nats_per_pixel"]) == first["nats_per_pixel"]
    page = (here / "fleet.html").read_text()
    assert 'href="rows/report.html"' in page and 'href="void/' not in page
    assert '<td data-of="camera">' in page  # what stands before the value on narrow screens
    assert (here / "rows" / "report.html").is_file()


def test_what_has_its_report_is_passed_over_and_what_failed_is_tried_again(sets, here, monkeypatch, capsys):
    before, tried = rows(here), []
    monkeypatch.setattr(fleet, "diagnose_set", lambda *job: tried.append(job[0]) or "still nothing")
    assert call(sets, here, "--key", "5") == 1
    assert tried == [str(sets / "void")]
    assert rows(here)[:2] == before[:2] and rows(here)[2]["error"] == "still nothing"
    assert "2 of 3 have their report already" in capsys.readouterr().out
    assert call(sets, here) == 2
    assert "was made with other flags (--key 5)" in capsys.readouterr().err
    listed = here.parent / "list.txt"
    listed.write_text(f"# two of them\n{sets / 'rows'}\n\n{sets / 'fine'}\n")
    assert call(listed, here, "--key", "5") == 0
    assert rows(here) == before[:2]


def test_a_cluster_gives_the_same_table(sets, here, tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs cannoise-jax[fleet]")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
    ) as cluster:
        assert call(sets, tmp_path / "out", "--scheduler", cluster.scheduler_address, "--key", "5") == 1
    assert rows(tmp_path / "out")[:2] == rows(here)[:2]
    assert rows(tmp_path / "out")[2]["set"] == "void"


def test_a_process_that_dies_is_a_row_of_its_own(sets, tmp_path, monkeypatch):
    monkeypatch.setattr(fleet.sys, "executable", "/bin/false")
    assert call(sets, tmp_path / "out") == 1
    assert {r["error"] for r in rows(tmp_path / "out")} == {"ended with status 1: nothing said"}


def test_what_was_not_measured_ranks_below_what_was_and_failures_last():
    known = {**failed("b", ""), "error": None, "verdict": "match", "nats_per_pixel": 0.0, "left": 1.0}
    unknown = {**known, "set": "a", "nats_per_pixel": None, "left": None}
    table = ranked([failed("0", "no such folder"), unknown, known])
    assert [r["set"] for r in table] == ["b", "a", "0"]
    assert "no such folder" in lines(table)[-1]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--alpha", "2"], "bin/fleet: --alpha: must lie between 0 and 1"),
        (["--scheduler", "tcp://localhost:1"], "bin/fleet: --scheduler: "),
        (["--recordings", "nowhere"], "bin/fleet: nowhere: no such folder or list"),
    ],
)
def test_refusals_are_one_line(sets, tmp_path, monkeypatch, capsys, more, said):
    monkeypatch.setattr(fleet, "_PATIENCE_S", 0.2)
    assert call(sets, tmp_path / "out", *more) == 2
    error = capsys.readouterr().err
    assert error.startswith(said) and error.count("\n") == 1, error


def test_names_are_the_places_below_what_holds_all(tmp_path):
    for place in ("one/night", "two/night"):
        (tmp_path / place).mkdir(parents=True)
    listed = tmp_path / "list"
    listed.write_text("\n".join(str(tmp_path / p) for p in ("one/night", "two/night", "one/night")))
    assert list(fleet._sets(listed)) == ["one/night", "two/night"]
    assert list(fleet._sets(tmp_path)) == ["one", "two"]
