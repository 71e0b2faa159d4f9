"""Suites: their cells, what each experiment must show on noise whose truth is known, and the page."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest

from cannoise_jax.commands.evaluate import _plain, _stored, main
from cannoise_jax.discovery.proof.patch_area import two_sample_area
from cannoise_jax.evaluation.evaluators import Samples
from cannoise_jax.evaluation.model_suites import iso_suite
from cannoise_jax.evaluation.noise_models import (
    BASELINES,
    KNOWS,
    baselines,
    draw_key,
    make_bench,
    references_of,
)
from cannoise_jax.evaluation.results_page import number, results_page
from cannoise_jax.evaluation.suites import Request, kl_by_unit, pooled_kl
from cannoise_jax.evaluation.texture import lags, spectra
from cannoise_jax.recordings.recording import BadInput


@pytest.fixture(scope="module")
def bench():
    return make_bench(0, 6, 1, 10)


@pytest.fixture(scope="module")
def draws(bench):
    made = baselines(bench)
    assert tuple(made) == BASELINES
    return made


def noise_like(rng, shape=(24, 32, 32, 4), rows=0.0, columns=0.0, neighbours=0.0):
    z = rng.normal(size=shape)
    z = z + neighbours * np.roll(z, 1, 2)
    z = z + rows * np.repeat(rng.normal(size=(*shape[:2], 1, 2)), 2, -1)
    return z + columns * np.tile(rng.normal(size=(shape[0], 1, shape[2], 2)), (1, 1, 1, 2))


def samples(real, fake):
    return Samples(real, fake, np.zeros_like(real), np.ones_like(real))


def test_spectra_tell_rows_from_columns_and_lags_tell_neighbours():
    rng = np.random.default_rng(0)
    found = spectra(samples(noise_like(rng, rows=0.3), noise_like(rng, columns=0.3)))
    white = 1 + 0.3**2 * 64
    assert found["row_spectrum_real"] == pytest.approx(white, rel=0.15)
    assert found["column_spectrum"] == pytest.approx(white, rel=0.15)
    assert found["column_spectrum_real"] == pytest.approx(1, abs=0.25)
    assert found["row_spectrum"] == pytest.approx(1, abs=0.25)
    found = lags(samples(noise_like(rng), noise_like(rng, neighbours=0.5)))
    assert found["lag_0_1"] == pytest.approx(0.5 / 1.25, abs=0.02)
    assert abs(found["lag_0_1_real"]) < 0.02 and abs(found["lag_1_0"]) < 0.02


def test_the_network_tells_rows_and_nothing_else():
    rng = np.random.default_rng(1)
    group, scene = np.repeat([0, 1], 12), np.tile(np.repeat(np.arange(4), 3), 2)
    same = two_sample_area(samples(noise_like(rng), noise_like(rng)), group, scene)
    rows = two_sample_area(samples(noise_like(rng, rows=0.4), noise_like(rng)), group, scene)
    assert same is not None and rows is not None
    assert same == pytest.approx(0.5, abs=0.12) and rows > 0.75
    assert two_sample_area(samples(noise_like(rng), noise_like(rng)), group, np.zeros(24, int)) is None


def test_references_are_of_the_kind_that_was_asked_for(bench):
    scenes: dict = {}
    for place, which in zip(bench.test.scene, bench.group, strict=True):
        scenes.setdefault(int(which), set()).add(int(place))
    many = np.array([len(scenes[int(which)]) > 1 for which in bench.group])
    assert many.any()
    camera, iso, scene = (np.asarray(v) for v in (bench.test.camera, bench.test.iso, bench.test.scene))
    for kind, same_camera, same_iso in (("same", 1, 1), ("setting", 1, 0), ("camera", 0, None)):
        chosen = references_of(bench, 2, 0, kind)
        assert ((camera[chosen] == camera[:, None]) == same_camera).all()
        if same_iso is not None:
            assert ((iso[chosen] == iso[:, None]) == same_iso)[many].all()
        assert not (chosen == np.arange(bench.size)[:, None])[many].any()


def test_noise_models_come_in_their_known_order(bench, draws):
    """Re-calibrated levels beat published ones, those the Gaussian; the true camera beats them all."""
    references = references_of(bench, 2, 0)
    made = {n: draws[n](draw_key(0, n), references) for n in ("gaussian", "pg", "pg_recalibrated", "truth")}
    assert set(draws) <= set(KNOWS)
    found = {n: kl_by_unit(bench, [noise]).mean() for n, noise in made.items()}
    assert found["gaussian"] > 3 * found["pg"] > 3 * found["pg_recalibrated"] > found["truth"] * 2
    assert pooled_kl(bench, made["truth"]) < found["truth"] * 1.5
    again = draws["pg"](draw_key(0, "pg"), references)
    np.testing.assert_array_equal(again, made["pg"])


def test_floors_carry_what_darks_carry(bench, draws):
    """N6 has 1/f rows: real darks keep them, so does the spectrum at random phases; white noise does not."""
    own = np.asarray(bench.test.camera) == [c.name for c in bench.cameras].index("N6")
    dark = own & (bench.test.clean.mean((1, 2, 3)) < 0.2)
    found = {}
    for name in ("pg_recalibrated", "real_darks", "random_phase", "eld"):
        noise = draws[name](draw_key(0, name), references_of(bench, 1, 0))[dark]
        real = (bench.test.noisy - bench.test.clean)[dark]
        sigma = np.ones_like(real) * real.std()
        numbers = spectra(Samples(real, noise, bench.test.clean[dark], sigma))
        found[name] = numbers["row_spectrum"]
    assert min(found["real_darks"], found["random_phase"]) > 1.15 * found["pg_recalibrated"]


def test_levels_by_iso(bench, draws):
    outcome = iso_suite(Request(bench, draws, seeds=2))
    rows = outcome.tables[0]["rows"]
    fitted = [row["pg_recalibrated"].value for row in rows.values()]
    assert np.allclose(fitted, 1, atol=0.15)
    assert sum(row["pg"].patches for row in rows.values()) == bench.size
    assert "no trained model" in outcome.notes[0]


def test_the_command_writes_json_and_a_page(tmp_path, capsys):
    flags = ["--workdir", str(tmp_path), "--seeds", "2", "--scenes", "4", "--per-scene", "1"]
    more = ["--train-scenes", "6", "--flow-steps", "0", "--noise", "pg"]
    assert main(["--suite", "iso", *flags, *more]) == 0
    record = json.loads((tmp_path / "evaluation" / "iso.json").read_text())
    assert (
        record["seeds"] == 2
        and record["patches"] == 20
        and record["command"].startswith("bin/evaluate --suite")
    )
    assert record["title"].endswith("gains and read noises that no training saw")  # all of it
    page = (tmp_path / "evaluation" / "results.html").read_text()
    assert '<td data-of="pg_recalibrated"' in page  # narrow screens show no head of the table
    opened: list[str] = []

    class Check(HTMLParser):
        def handle_starttag(self, tag, attrs):
            assert not any(name in ("src", "href") for name, _ in attrs)  # it needs nothing else
            if tag in ("table", "tr", "svg", "div"):
                opened.append(tag)

        def handle_endtag(self, tag):
            if tag in ("table", "tr", "svg", "div"):
                assert opened.pop() == tag

    Check().feed(page)
    assert not opened and "ISO 100" in page and "width=device-width" in page
    used = set(re.findall(r"var\((--\w+)\)", page))  # colours of their own on dark pages
    assert used <= set(re.findall(r"(--\w+): light-dark\(", page))
    assert main(["--suite", "iso", *flags, *more[:-1], "nonsense"]) == 2
    assert "nonsense" in capsys.readouterr().err
    assert main(["--suite", "iso", *flags, *more]) == 2
    assert "--force" in capsys.readouterr().err


@pytest.mark.slow
def test_a_killed_run_is_made_again_and_a_finished_one_is_kept(tmp_path, capsys):
    flags = ["--suite", "encoder", "--workdir", str(tmp_path), "--seeds", "1", "--scenes", "2"]
    flags += ["--per-scene", "1", "--train-scenes", "6"]
    killed = f"""
import os, signal
from cannoise_jax.evaluation import results_page
results_page.results_page = lambda found: os.kill(os.getpid(), signal.SIGKILL)
from cannoise_jax.commands.evaluate import main
main({flags!r})
"""
    assert subprocess.run([sys.executable, "-c", killed], capture_output=True).returncode == -signal.SIGKILL
    assert (tmp_path / "evaluation" / "encoder.json").exists()
    assert main(flags) == 0, capsys.readouterr().err
    names = {p.name for p in (tmp_path / "evaluation").iterdir()}
    assert names == {"encoder.json", "results.html"}
    assert main(flags) == 2 and "--force" in capsys.readouterr().err


def test_suites_that_need_a_model_say_so(tmp_path, capsys):
    flags = ["--workdir", str(tmp_path), "--seeds", "1", "--scenes", "2", "--per-scene", "1"]
    assert main(["--suite", "encoder", *flags, "--train-scenes", "6"]) == 0
    assert "needs a trained model" in capsys.readouterr().out


def test_a_slip_in_the_name_of_the_run_is_refused_and_makes_no_folder(tmp_path, capsys):
    assert main(["--suite", "cameras", "--workdir", str(tmp_path / "slip")]) == 2
    error = capsys.readouterr().err
    assert "slip: no such folder" in error and error.count("\n") == 1 and not list(tmp_path.iterdir())


def test_the_head_of_a_column_of_text_stands_above_it():
    found = {"value": 1.0, "low": None, "high": None, "seeds": 1, "patches": 1}
    rows = {"r": {"x": found, "said": "3", "rarely": None}, "s": {"x": found, "said": "1", "rarely": "a"}}
    table = {"title": "t", "note": "", "columns": ["x", "said", "rarely"], "rows": rows}
    record = {
        "tables": [table], "figures": [], "notes": [], "command": "c", "version": "1", "seeds": 1,
        "patches": 1, "seconds": 1.0,
    }  # fmt: skip
    page = results_page({"noise": record})
    assert "<th>x</th><th class=text>said</th><th class=text>rarely</th>" in page
    assert "th.text" in page.partition("</style>")[0]


def test_numbers_and_what_json_cannot_hold():
    assert [number(v) for v in (0.012345, 12.3, 1234.0, 0, float("nan"))] == [
        "0.0123",
        "12.3",
        "1234",
        "0",
        "–",
    ]
    assert _plain({"a": (1.0, float("nan"))}) == {"a": [1.0, None]}
    record = {
        "tables": [{"title": "<b>", "note": "", "columns": ["x"], "rows": {"r": {"x": "a&b"}}}],
        "figures": [], "notes": [], "command": "c", "version": "1", "seeds": 1, "patches": 1, "seconds": 1.0,
    }  # fmt: skip
    page = results_page({"noise": record})
    assert "&lt;b&gt;" in page and "a&amp;b" in page


@pytest.mark.parametrize("text", ["", "[1]", "[" * 100_000, '{"a": 1, "a": 2}', '{"a": 1' + "0" * 400 + "}"])
def test_stored_suites_that_are_damaged_are_refused_in_one_line(text, tmp_path):
    path = tmp_path / "noise.json"
    path.write_text(text)
    with pytest.raises(BadInput, match="noise.json: .*run its suite again") as caught:
        _stored(path)
    assert "\n" not in str(caught.value)
