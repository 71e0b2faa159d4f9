import json
import shutil

import pytest

from cannoise_jax.blind.claims import read_claims, read_manifest, read_truth, run
from cannoise_jax.blind.seal import seal
from cannoise_jax.recordings.recording import BadInput


def quiet(done, total):
    pass


@pytest.fixture(scope="module")
def sealed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sealed")
    seal(folder / "sets", folder / "truth.json", seed=11, sets=3, nulls=1, progress=quiet)
    return folder


def report(capture_set, without, locate_only):
    return {
        "findings": [],
        "frames": sum(r.count for r in capture_set.recordings),
        "locate_only": locate_only,
    }


def test_a_run_needs_no_truth_resumes_and_commits(sealed, tmp_path):
    hidden = (sealed / "truth.json").read_bytes()
    (sealed / "truth.json").unlink()
    try:
        assert run(sealed / "sets", tmp_path / "claims", report, (1, 2), quiet) is None
        first = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "claims").glob("set_*.json")}
        commitment = run(sealed / "sets", tmp_path / "claims", report, (2, 2), quiet)
        assert commitment is not None
        assert run(sealed / "sets", tmp_path / "claims", report, (1, 1), quiet) == commitment
        assert all((tmp_path / "claims" / n).stat().st_mtime_ns == t for n, t in first.items())
    finally:
        (sealed / "truth.json").write_bytes(hidden)
    names = sorted(read_manifest(sealed / "sets")["sets"])
    claims = read_claims(tmp_path / "claims", read_manifest(sealed / "sets"))
    assert sum(c["locate_only"] for c in claims.values()) == 1
    truth = read_truth(sealed / "truth.json", read_manifest(sealed / "sets"))
    assert sorted(truth) == names


def test_changed_claims_and_another_truth_are_refused(sealed, tmp_path):
    run(sealed / "sets", tmp_path / "claims", report, (1, 1), quiet)
    manifest = read_manifest(sealed / "sets")
    names = sorted(manifest["sets"])
    (tmp_path / "claims" / f"{names[0]}.json").write_text(json.dumps({"findings": ["better"]}))
    with pytest.raises(BadInput, match="differ from their commitment"):
        read_claims(tmp_path / "claims", manifest)
    (tmp_path / "claims" / f"{names[0]}.json").write_text(
        json.dumps({"findings": ["better"], "set_sha256": manifest["sets"][names[0]]["sha256"]})
    )
    with pytest.raises(BadInput, match="differ from their commitment"):
        run(sealed / "sets", tmp_path / "claims", report, (1, 1), quiet)
    fewer = {**manifest, "sets": {n: manifest["sets"][n] for n in names[1:]}}
    with pytest.raises(BadInput, match=f"{names[0]} is in the truth or in the manifest only"):
        read_truth(sealed / "truth.json", fewer)
    other = tmp_path / "truth.json"
    other.write_text((sealed / "truth.json").read_text().replace("null", "nulL", 1) + " ")
    with pytest.raises(BadInput, match="not the truth"):
        read_truth(other, manifest)
    with pytest.raises(BadInput, match="no manifest"):
        read_manifest(tmp_path)


def test_sets_that_changed_and_claims_about_others_are_refused(sealed, tmp_path):
    sets, claims = tmp_path / "sets", tmp_path / "claims"
    shutil.copytree(sealed / "sets", sets)
    names = sorted(read_manifest(sets)["sets"])
    run(sets, claims, report, (1, 2), quiet)
    recording = sorted((sets / names[1]).iterdir())[0]
    kept = recording.read_bytes()
    recording.write_bytes(kept[:-1] + bytes([kept[-1] ^ 1]))
    with pytest.raises(BadInput, match=f"{names[1]}: not the files that were sealed"):
        run(sets, claims, report, (1, 1), quiet)
    assert not (claims / f"{names[1]}.json").exists()  # a set that cannot be judged is no failure of the tool
    shutil.rmtree(sets / names[1])
    with pytest.raises(BadInput, match=f"{names[1]}: no such set"):
        run(sets, claims, report, (1, 1), quiet)

    seal(tmp_path / "others", tmp_path / "truth.json", seed=12, sets=3, nulls=1, progress=quiet)
    manifest = read_manifest(tmp_path / "others")
    with pytest.raises(BadInput, match=f"{names[0]}.json: a claim about another set of this name"):
        run(tmp_path / "others", claims, report, (1, 1), quiet)
    (claims / f"{names[1]}.json").write_text("{")
    with pytest.raises(BadInput, match=f"{names[1]}.json: not a report"):
        run(sealed / "sets", claims, report, (1, 1), quiet)
    (claims / f"{names[1]}.json").unlink()
    run(sealed / "sets", claims, report, (1, 1), quiet)
    with pytest.raises(BadInput, match="a claim about another set of this name"):
        read_claims(claims, manifest)
    manifest["sets"][names[0]]["sha256"] = "0"
    with pytest.raises(BadInput, match=f"{names[0]} in the manifest is not the set that was sealed"):
        read_truth(tmp_path / "truth.json", manifest)


def test_a_crash_on_one_set_is_recorded_and_the_rest_goes_on(sealed, tmp_path):
    calls = []

    def fails_once(capture_set, without, locate_only):
        calls.append(1)
        if len(calls) == 1:
            raise RuntimeError("broken")
        return report(capture_set, without, locate_only)

    assert run(sealed / "sets", tmp_path / "claims", fails_once, (1, 1), quiet) is not None
    claims = [json.loads(p.read_text()) for p in sorted((tmp_path / "claims").glob("set_*.json"))]
    assert [c.get("error") for c in claims] == ["RuntimeError: broken", None, None, None]
