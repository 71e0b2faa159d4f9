"""bin/fleet: many sets, here and through dask, go on where they stopped, and failures are rows."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from cannoise_jax.commands import fleet, fleet_process
from cannoise_jax.commands.fleet_progress import FleetProgress
from cannoise_jax.commands.fleet_sets import sets_of, source_of
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


def test_how_far_it_is_is_what_the_sets_say_and_took():
    now = [0.0]
    fleet_is = FleetProgress(4, 2, lambda: now[0])
    assert fleet_is.words() == "diagnosing: sets: 0 of 4" and fleet_is.left() is None
    fleet_is.heard("a", "")
    fleet_is.heard("b", "")
    fleet_is.heard("a", "[   2.6 s] locate: 98 signatures on 7 frames\n")
    assert fleet_is.words() == "diagnosing: sets: 0 of 4, now a: locate: 98 signatures on 7 frames; b"
    now[0] = 20.0
    fleet_is.heard("a", "[  20.0 s] still step 1: prnu; some 40 s left\n")
    assert fleet_is.left() == pytest.approx(
        (40 + 40 + 2 * 60) / 2
    )  # each takes a minute, by the first's word
    assert fleet_is.words().startswith("diagnosing: sets: 0 of 4, some 2 min left, now a: step 1: prnu; b")
    fleet_is.heard("a", "bin/diagnose: a line of another kind")
    now[0] = 50.0
    fleet_is.ended("a", failed=False)
    fleet_is.ended("c", failed=True)
    fleet_is.heard("d", "[   0.0 s] reading the recordings; some 1 min left")
    assert fleet_is.left() == pytest.approx(60)  # not half of it: one set cannot be parted
    fleet_is.ended("b", failed=False)
    fleet_is.ended("d", failed=False)
    assert fleet_is.words() == "diagnosing: sets: 4 of 4" and fleet_is.left() is None


def test_what_a_set_says_is_passed_on(tmp_path, monkeypatch):
    script = tmp_path / "says"
    script.write_text("#!/bin/sh\necho lost\necho one >&2\necho 'bin/diagnose: two' >&2\nexit 2\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    heard: list[str] = []
    said = fleet_process.diagnose_set("in", str(tmp_path / "out"), (), str(tmp_path), heard.append)
    assert said == "two" and heard == ["", "one\n", "bin/diagnose: two\n"]


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


@pytest.mark.parametrize("diagnosed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_cluster_gives_the_same_table(sets, here, tmp_path, monkeypatch, diagnosed):
    """By default its workers take the reports that there are; else they diagnose once more."""

    def taken(recordings, out, flags, folder):
        report = here / Path(recordings).name
        if not (report / "report.json").is_file():
            return "nothing to take"
        shutil.copytree(report, out)

    if not diagnosed:
        monkeypatch.setattr(fleet, "diagnose_set", taken)
    distributed = pytest.importorskip("distributed", reason="needs cannoise-jax[fleet]")
    listed = tmp_path / "list.txt"
    listed.write_text(f"{sets / 'rows'}\n{sets / 'void'}\n")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
    ) as cluster:
        assert call(listed, tmp_path / "out", "--scheduler", cluster.scheduler_address, "--key", "5") == 1
    found, failed_ = rows(tmp_path / "out")
    assert found == next(r for r in rows(here) if r["set"] == "rows")
    assert failed_["set"] == "void" and failed_["error"]


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
        (["--without", "nonsense"], "bin/fleet: nonsense: no such mechanism"),
        (["--mechanisms", "no_module:NAME"], "bin/fleet: no_module:NAME: cannot be imported"),
    ],
)
def test_refusals_are_one_line(sets, tmp_path, monkeypatch, capsys, more, said):
    monkeypatch.setattr(fleet, "_PATIENCE_S", 0.2)
    assert call(sets, tmp_path / "out", *more) == 2
    error = capsys.readouterr().err
    assert error.startswith(said) and error.count("\n") == 1, error
    assert not (tmp_path / "out").exists()


def test_names_are_the_places_below_what_holds_all(tmp_path):
    for place in ("one/night", "two/night"):
        (tmp_path / place).mkdir(parents=True)
    listed = tmp_path / "list"
    listed.write_text("\n".join(str(tmp_path / p) for p in ("one/night", "two/night", "one/night")))
    assert list(sets_of(listed)) == ["one/night", "two/night"]
    assert list(sets_of(tmp_path)) == ["one", "two"]
    listed.write_text(f"{tmp_path / 'one/night'}\n{tmp_path / 'two/night'}\n", encoding="utf-8-sig")
    assert list(sets_of(listed)) == ["one/night", "two/night"]  # as some editors begin a file


def listing(tmp_path, *places):
    path = tmp_path / "list"
    path.write_text("\n".join(map(str, places)))
    return path


@pytest.fixture
def own(here, tmp_path):
    """A copy of the fleet that a test may change."""
    shutil.copytree(here, tmp_path / "own")
    return tmp_path / "own"


def test_a_report_is_of_the_recordings_that_it_was_made_from(sets, own, tmp_path, monkeypatch, capsys):
    """Another folder of the same name gets no report of the first one."""
    other = tmp_path / "others" / "rows"
    shutil.copytree(sets / "fine", other)
    before = {p: p.read_bytes() for p in own.rglob("*") if p.is_file()}
    assert call(listing(tmp_path, other), own, "--key", "5") == 2
    error = capsys.readouterr().err
    assert f"holds the report of {sets / 'rows'}, not of {other}" in error and error.count("\n") == 1
    assert before == {p: p.read_bytes() for p in own.rglob("*") if p.is_file()}
    tried = []
    monkeypatch.setattr(fleet, "diagnose_set", lambda *job: tried.append(job))
    assert call(listing(tmp_path, other), own, "--key", "5", "--force") == 0
    assert [job[0] for job in tried] == [str(other)]
    assert call(listing(tmp_path, sets / "rows"), own, "--key", "5") == 2
    assert call(listing(tmp_path, sets / "fine"), own, "--key", "5") == 0 and len(tried) == 1  # still known


def changed_size(folder):
    (folder / "more.h5").write_bytes(b"")


def changed_time(folder):
    os.utime(min(folder.glob("*.h5")), ns=(1, 1))


def changed_name(folder):
    path = min(folder.glob("*.h5"))
    path.rename(path.with_name("other.h5"))


@pytest.mark.parametrize("change", [changed_size, changed_time, changed_name])
def test_recordings_that_changed_are_diagnosed_again(sets, own, tmp_path, monkeypatch, capsys, change):
    """In the same folder; what is hidden there is no recording."""
    moved, tried = tmp_path / "sets", []
    shutil.copytree(sets, moved)
    table = json.loads((own / "fleet.json").read_text())
    table["sets"] = {name: source_of(moved / name)._asdict() for name in table["sets"]}
    (own / "fleet.json").write_text(json.dumps(table))
    monkeypatch.setattr(fleet, "diagnose_set", lambda *job: tried.append(job[0]))
    listed = listing(tmp_path, moved / "rows", moved / "fine")
    (moved / "rows" / ".DS_Store").write_text("")
    assert call(listed, own, "--key", "5") == 0 and tried == []
    change(moved / "rows")
    capsys.readouterr()
    assert call(listed, own, "--key", "5") == 0 and tried == [str(moved / "rows")]
    said = capsys.readouterr().out.splitlines()
    assert "1 of 2 have their report already" in said
    assert "rows: its recordings have changed since its report: diagnosed again" in said
    assert call(listed, own, "--key", "5") == 0 and len(tried) == 1


@pytest.mark.parametrize("name", ["report.json", "report.html", "sensor.json"])
def test_damaged_and_missing_files_of_a_report_are_made_again(sets, own, tmp_path, monkeypatch, name):
    made, tried = (own / "rows" / name).read_bytes(), []
    if name == "report.json":
        old = made.decode().replace("cannoise/diagnosis/2", "cannoise/diagnosis/1")
        (own / "rows" / name).write_text(old)
    else:
        (own / "rows" / name).unlink()

    def again(recordings, out, flags, here, heard):
        tried.append((recordings, "--force" in flags))
        (own / "rows" / name).write_bytes(made)

    monkeypatch.setattr(fleet, "diagnose_set", again)
    assert call(listing(tmp_path, sets / "rows", sets / "fine"), own, "--key", "5") == 0
    assert tried == [(str(sets / "rows"), True)]


def test_reports_of_no_fleet_are_kept(sets, own, capsys):
    (own / "fleet.json").unlink()
    assert call(sets, own, "--key", "5") == 2
    assert "is of no fleet" in capsys.readouterr().err


def test_flags_may_change_while_no_set_has_its_report(sets, tmp_path, monkeypatch):
    monkeypatch.setattr(fleet, "diagnose_set", lambda *job: "a slip in a flag")
    assert call(sets, tmp_path / "out", "--key", "4") == 1
    assert call(sets, tmp_path / "out", "--key", "5") == 1


@pytest.mark.parametrize("place", ["", "out", "fine", "fine/out"])
def test_reports_do_not_lie_among_the_recordings(sets, tmp_path, capsys, place):
    shutil.copytree(sets, tmp_path / "sets")
    before = sorted((tmp_path / "sets").rglob("*"))
    assert call(tmp_path / "sets", tmp_path / "sets" / place) == 2
    if place != "out":  # beside the folders of a list is room for others
        listed = listing(tmp_path, tmp_path / "sets" / "fine", tmp_path / "sets" / "rows")
        assert call(listed, tmp_path / "sets" / place) == 2
    errors = capsys.readouterr().err.splitlines()
    assert all(" among the recordings of " in e or " in the folder of the recordings" in e for e in errors)
    assert sorted((tmp_path / "sets").rglob("*")) == before


@pytest.fixture
def waits(sets, tmp_path):
    """A fleet, and the process that it has begun, in which a program that waits stands for the diagnosis."""
    number, script = tmp_path / "number", tmp_path / "python"
    script.write_text(
        f"#!{sys.executable}\n"
        "import os, pathlib, runpy, sys, time\n"
        "from cannoise_jax.commands import start\n"
        "def wait(name):\n"
        f"    new = pathlib.Path({str(number)!r} + '.new')\n"
        "    new.write_text(str(os.getpid()))\n"
        f"    new.rename({str(number)!r})\n"
        "    time.sleep(60)\n"
        "start.run, sys.argv = wait, sys.argv[2:]\n"
        "runpy.run_module(sys.argv[0], run_name='__main__')\n"
    )
    script.chmod(0o755)
    code = (
        f"import sys; from cannoise_jax.commands import fleet; sys.executable = {str(script)!r}; "
        f"sys.exit(fleet.main(['--recordings', {str(sets)!r}, '--out', {str(tmp_path / 'out')!r}, "
        "'--processes', '1']))"
    )
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True) as process:
        until(number.exists)
        yield process, Path("/proc") / number.read_text()
        process.kill()


def test_sigterm_ends_the_processes_too(waits):
    process, begun = waits
    process.terminate()
    _, error = process.communicate(timeout=20)
    assert process.returncode == 128 + signal.SIGTERM
    assert error.endswith("bin/fleet: stopped: the same command goes on with the sets that are left\n")
    assert not begun.exists()


def test_the_processes_of_a_fleet_that_is_killed_end(waits):
    process, begun = waits
    process.kill()
    until(lambda: not begun.exists() or begun.joinpath("stat").read_text().split()[2] == "Z", 10)


def test_a_process_ends_that_is_begun_after_the_others_were_ended(tmp_path, monkeypatch):
    """By a thread that had taken its set up before."""
    taken, running = threading.Event(), fleet_process._running
    script = tmp_path / "sleeps"
    script.write_text("#!/bin/sh\nexec sleep 60\n")
    script.chmod(0o755)

    @contextlib.contextmanager
    def late(words, here):
        taken.set()
        time.sleep(0.3)
        with running(words, here) as process:
            yield process

    monkeypatch.setattr(fleet_process, "_running", late)
    monkeypatch.setattr(sys, "executable", str(script))
    threads = ThreadPoolExecutor(1)
    job = threads.submit(fleet_process.diagnose_set, "in", str(tmp_path / "out"), (), str(tmp_path))
    assert taken.wait(10)
    fleet_process.end_all(threads)
    assert job.result(timeout=0) == f"ended with status {-signal.SIGTERM}: nothing said"


def until(true, patience_s=30.0):
    end = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)
