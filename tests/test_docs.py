"""README and docs/: rendered from their results, no number typed, links and examples that work."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import json
import os
import re
import subprocess
import sys

import pytest

from cannoise_jax.commands import bench_docs
from cannoise_jax.commands.bench import main as bench
from cannoise_jax.commands.bench_take import take
from cannoise_jax.commands.published import (
    FOLDER,
    SCHEMA,
    is_older,
    read_result,
    read_results,
    source_sha256,
    write_result,
)
from cannoise_jax.recordings.recording import BadInput
from tests.conftest import ROOT

PAGES = bench_docs.pages(ROOT)
WORDS = [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
MARKED = re.compile(r"<!-- results: ([a-z]\w*)(?:\.(\w+))? -->.*?<!-- end -->", re.DOTALL)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
ALLOWED = {"90 %", "3.11"}
"""The level of all intervals, and the oldest Python."""


@pytest.fixture(scope="module")
def results():
    return read_results(ROOT)


def test_every_page_is_as_its_results_render_it():
    changed = bench_docs.run(ROOT, check=True)
    assert not changed, f"run bin/bench docs: {[str(p.relative_to(ROOT)) for p in changed]}"


def test_every_result_is_shown_and_says_where_it_comes_from(results):
    shown = {m.group(1) for page in PAGES for m in MARKED.finditer(page.read_text()) if not m.group(2)}
    assert shown == set(results)
    for result in results.values():
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", result.date)
        assert re.fullmatch(r"[0-9a-f]{64}", result.code["sha256"])
        assert result.machine and all(result.command)
        for figure in result.figures:
            data = (ROOT / "docs" / figure["file"]).read_bytes()
            assert hashlib.sha256(data).hexdigest() == figure["sha256"], figure["file"]


def test_results_of_older_code_say_so_where_they_are_shown(results):
    for page in PAGES:
        text = page.read_text()
        for match in MARKED.finditer(text):
            name, value = match.groups()
            older = is_older(ROOT, results[name])
            if value is None:
                assert ("Measured on older code" in match.group()) == older
            elif value == "code":
                assert ("(older code)" in match.group()) == older


def test_the_readme_names_the_code_of_every_number(results):
    text = (ROOT / "README.md").read_text()
    cited = {(m.group(1), m.group(2)) for m in MARKED.finditer(text)}
    assert cited and all(value for _, value in cited)
    assert {name for name, value in cited if value == "code"} == {name for name, _ in cited}


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


def prose(text: str) -> str:
    """What is written by hand: no code, no rendered place, no link target, no table's code."""
    text = MARKED.sub("", FENCE.sub("", text)).replace("Apache-2.0", "")
    text = re.sub(r"^    .*$", "", text, flags=re.MULTILINE)
    return re.sub(r"`[^`]*`|\]\([^)]*\)", "", text)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_no_measured_number_is_typed(page):
    numbers = re.findall(r"\d+\.\d+|\d[\d.,]* ?(?:%|nats|DN|e-|Mpx|seconds|minutes)", prose(page.read_text()))
    assert not set(numbers) - ALLOWED, "state it in docs/results and cite it"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_no_line_of_a_paragraph_begins_with_a_mark(page):
    """Markdown takes a line that begins with a comment for the end of the paragraph before it."""
    text = FENCE.sub("", page.read_text())
    assert not re.findall(r"^ *(?:- )?<!-- results: \w+\.\w+ -->.*", text, re.MULTILINE)


def small(tmp_path, **changes):
    """A checkout with one result, one page that shows it, and one source file."""
    (tmp_path / FOLDER).mkdir(parents=True)
    (tmp_path / "code.py").write_text("a = 1\n")
    (tmp_path / "README.md").write_text("Seen: <!-- results: one.seen -->?<!-- end -->.\n")
    (tmp_path / "docs" / "page.md").write_text("# Page\n\n<!-- results: one --><!-- end -->\n")
    table = {"columns": ["what", "value"], "rows": [["a|b", 3]], "values": {"seen": 7}, "code": ["code.py"]}
    file = tmp_path / "table.json"
    file.write_text(json.dumps({**table, **changes}))
    return take(tmp_path, file, "one", "One", ["bin/x"])


def test_a_result_is_taken_in_rendered_and_grows_old_with_its_code(tmp_path):
    write_result(tmp_path, small(tmp_path))
    assert bench_docs.run(tmp_path, check=True) and not (tmp_path / "README.md").read_text().count("7")
    bench_docs.run(tmp_path)
    page = (tmp_path / "docs" / "page.md").read_text()
    assert "Seen: <!-- results: one.seen -->7<!-- end -->." in (tmp_path / "README.md").read_text()
    assert r"| a\|b | 3 |" in page and "`bin/x`" in page and "older" not in page
    assert bench_docs.run(tmp_path) == []
    (tmp_path / "code.py").write_text("a = 2\n")
    assert [p.name for p in bench_docs.run(tmp_path)] == ["page.md"]
    assert "Measured on older code" in (tmp_path / "docs" / "page.md").read_text()


def test_the_table_of_a_suite_is_taken_in(tmp_path):
    """Numbers with their intervals; a cell of the table can be cited."""

    def cell(value, low=None, high=None):
        return {"value": value, "low": low, "high": high, "seeds": 1, "patches": 10}

    row = {"is told": "all", "excess KL": cell(0.00312, 0.001, 0.005), "std ratio": cell(1.02)}
    suite = {
        "schema": "cannoise/evaluation/1", "patches": 10, "seeds": 1, "interval": "scenes",
        "tables": [{"note": "", "columns": ["is told", "excess KL", "std ratio"], "rows": {"no U-Net": row}}],
    }  # fmt: skip
    file = tmp_path / "ablation.json"
    file.write_text(json.dumps(suite))
    result = take(tmp_path, file, "one", "One", ["bin/x"])
    assert result.columns == ("", "excess KL", "std ratio")
    assert result.rows == (("no U-Net", "0.00312 (0.00100 to 0.00500)", "1.02"),)
    assert result.values["no_u_net_excess_kl"] == "0.00312"
    names = [f"q{n}" for n in range(9)]
    suite["tables"] = [{"note": "", "columns": names, "rows": {"IP": {n: cell(2.0) for n in names}}}]
    file.write_text(json.dumps(suite))
    result = take(tmp_path, file, "one", "One", ["bin/x"])  # too wide for a page: turned about
    assert result.columns == ("", "IP") and result.rows[3] == ("q3", "2.00")


def test_source_hash_sees_names_and_content(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.py").write_text("1")
    seen = {source_sha256(tmp_path, ["a"])}
    (tmp_path / "a" / "notes.txt").write_text("not code")
    assert source_sha256(tmp_path, ["a"]) in seen
    (tmp_path / "a" / "b.py").rename(tmp_path / "a" / "c.py")
    seen.add(source_sha256(tmp_path, ["a"]))
    (tmp_path / "a" / "c.py").write_text("2")
    seen.add(source_sha256(tmp_path, ["a"]))
    assert len(seen) == 3


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "{}",
        "[1]",
        '{"schema": "cannoise/published/2"}',
        f'{{"schema": "{SCHEMA}", "title": "t"}}',
        f'{{"schema": "{SCHEMA}", "title": "t", "command": ["c"], "machine": "m", "date": "d", '
        '"code": {"paths": ["a"], "sha256": "0"}, "columns": ["a", "b"], "rows": [["1"]]}',
        "\x00",
    ],
)
def test_a_file_that_is_no_result_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "r.json"
    path.write_text(text)
    with pytest.raises(BadInput) as refused:
        read_result(path)
    assert "\n" not in str(refused.value) and str(path) in str(refused.value)


def test_marks_that_name_nothing_or_stay_open_are_refused(tmp_path):
    write_result(tmp_path, small(tmp_path))
    page, known = tmp_path / "README.md", read_results(tmp_path)
    for text in (
        "<!-- results: two --><!-- end -->",
        "<!-- results: one.lost --><!-- end -->",
        "<!-- results: one --> open",
    ):
        with pytest.raises(BadInput, match=r"README.md"):
            bench_docs.render(text, tmp_path, page, known)


def test_what_cannot_be_taken_is_refused(tmp_path, capsys):
    (tmp_path / "x.json").write_text('{"rows": []}')
    at = str(tmp_path / "x.json")
    assert bench(["docs", "--take", at, "--name", "x"]) == 2
    assert bench(["docs", "--take", at, "--name", "x", "--command", "c"]) == 2
    assert bench(["docs", "--take", at, "--name", "../x", "--command", "c"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and all(line.startswith("bin/bench: ") for line in lines)
    for content, said in (
        ("[]", "its values are of other kinds"),
        ('{"rows": [["a"]]}', "'code' is missing"),
    ):
        (tmp_path / "x.json").write_text(content)
        assert bench(["docs", "--take", at, "--name", "x", "--command", "c"]) == 2
        assert f"({said})" in capsys.readouterr().err
    assert bench(["docs", "--take", str(tmp_path / "none"), "--name", "x", "--command", "c"]) == 2
    assert "(no such file or directory)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--name", "x"], "--name is of a result that --take makes"),
        (["--title", "x"], "--title is of a result that --take makes"),
        (["--figure", "x.png"], "--figure is of a result that --take makes"),
        (["--check", "--take", "x", "--name", "x", "--command", "c"], "--check writes nothing"),
        (["--take", "x", "--name", "x", "--command", "c", "--caption", "c"], "--caption is that of --figure"),
    ],
)
def test_flags_that_would_be_passed_over_are_refused(flags, said, monkeypatch, capsys):
    monkeypatch.setattr(bench_docs, "run", lambda *_: pytest.fail("pages were written"))
    assert bench(["docs", *flags]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_relative_links_lead_somewhere():
    for page in WORDS:
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def shown_commands():
    """Every command line of the pages: its name, and the flags it is given."""
    for page in WORDS:
        for line in page.read_text().splitlines():
            if match := re.match(r"    bin/(\w+)\b(.*)", line):
                yield page.name, match.group(1), match.group(2).split("#")[0].split()
    for template in (ROOT / "cannoise_jax").rglob("*.jinja"):
        for name, arguments in re.findall(r"<code>bin/(\w+) ([^<]*)</code>", template.read_text()):
            yield template.name, name, arguments.split()


def test_commands_on_the_pages_have_the_flags_they_are_shown_with(capsys):
    helps: dict[tuple[str, ...], str] = {}
    for page, name, arguments in shown_commands():
        if name == "test":  # hands what it does not know on to pytest
            continue
        call = (name, *arguments[:1]) if name in ("bench", "blind", "denoise") else (name,)
        if call not in helps:
            module = importlib.import_module(f"cannoise_jax.commands.{name}")
            try:
                module.main([*call[1:], "--help"])
            except SystemExit as ended:
                assert ended.code == 0
            helps[call] = capsys.readouterr().out
        for flag in (a.split("=")[0] for a in arguments if a.startswith("--")):
            known = flag in helps[call] or flag == "--help" or flag.startswith("--config.")
            assert known, f"{page}: bin/{name} has no {flag}"
    assert len(helps) > 8


def test_python_on_the_pages_imports_what_is_there():
    for page in WORDS:
        for language, code in FENCE.findall(page.read_text()):
            if language != "python":
                continue
            compile(code, str(page), "exec")
            for home, names in re.findall(r"^from ([\w.]+) import (.+)$", code, re.MULTILINE):
                if home == "droop":  # the reader's own, which that page writes first
                    continue
                module = importlib.import_module(home)
                assert all(hasattr(module, name.strip()) for name in names.split(",")), (page.name, names)


def run_examples(wanted) -> dict:
    names: dict[str, object] = {}
    text = (ROOT / "docs" / "python.md").read_text()
    for language, code in FENCE.findall(text):
        assert language == "python"
        if wanted(code):
            exec(compile(code, "docs/python.md", "exec"), names)
    return names


def test_the_examples_of_the_python_page_run():
    names = run_examples(lambda code: "diagnose" not in code)
    assert names["frames"].shape == (8, 64, 96) and names["another_unit"].cfa == "RGGB"
    assert [r.kind for r in names["capture"].recordings] == ["dark", "flat"]


@pytest.mark.slow
def test_the_example_of_an_own_simulator_finds_what_it_lacks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_examples(lambda code: True)
    found = {step.named.mechanism for step in names["found"].fitted.steps}
    assert "row_noise" in found and names["found"].model is names["extended"]
    assert (tmp_path / "report" / "report.html").is_file()


def test_the_site_is_built_without_warnings(tmp_path):
    for package in ("mkdocs", "material", "mkdocstrings"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed: pip install 'cannoise-jax[docs]'")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "-f", str(ROOT / ".mkdocs.yml"), "-d", str(tmp_path)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        timeout=120,
    )
    said = [line for line in built.stderr.splitlines() if re.match(r"(WARNING|ERROR|Aborted)", line)]
    assert built.returncode == 0 and not said, said or built.stderr[-800:]
    assert (tmp_path / "index.html").is_file()
    api = (tmp_path / "api.html").read_text()
    assert "sample_noise" in api and "black_level" in api
