import ast
import hashlib
import json
from pathlib import Path

import h5py
import numpy as np
import pytest

import cannoise_jax
from cannoise_jax.blind.compose import SHARES, Spec, compose, concealed_with
from cannoise_jax.blind.listed import NAMES
from cannoise_jax.blind.seal import make, seal
from cannoise_jax.blind.sets import write_set
from cannoise_jax.mechanisms import VOCABULARY
from cannoise_jax.recordings.recording import BadInput

PACKAGE = Path(cannoise_jax.__file__).parent
INJECTORS = (
    "chain",
    "effects",
    "effects_signal",
    "effects_readout",
    "effects_unlisted",
    "listed",
    "sets",
    "shifts",
    "sparse",
    "strength",
)


def imports(path: Path) -> set[str]:
    """Names of the modules a file imports, at any depth of nesting."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


DRAWING = {"cannoise_jax.blind", "cannoise_jax.blind.figures", "cannoise_jax.blind.table"}
"""What renders published results may draw those of a trial; nothing of it makes an effect."""


def test_nothing_but_the_blind_room_and_its_command_reaches_the_injectors():
    for path in PACKAGE.rglob("*.py"):
        relative = path.relative_to(PACKAGE)
        if (
            relative.parts[0] == "blind"
            or relative.match("commands/blind.py")
            or relative.match("commands/blind_flags.py")
            or relative.parts[0] == "trials"
        ):
            continue
        reached = {n for n in imports(path) if n.startswith("cannoise_jax.blind")}
        drawn = DRAWING if relative.match("commands/bench_take.py") else set()
        assert reached <= drawn, relative


@pytest.mark.parametrize("name", [*INJECTORS, "compose", "seal"])
def test_injectors_share_no_code_with_physics_or_discovery(name):
    allowed = ("cannoise_jax.blind", "cannoise_jax.recordings")
    ours = [n for n in imports(PACKAGE / "blind" / f"{name}.py") if n.startswith("cannoise_jax")]
    assert ours or name in ("chain", "listed", "sparse")
    assert all(n.startswith(allowed) for n in ours), ours


def test_the_injectors_names_mean_what_the_vocabulary_says():
    for id, name in NAMES.items():
        assert (name.unit, name.within) == (VOCABULARY[id].unit, VOCABULARY[id].within), id
        assert set(name.within) <= set(NAMES)


def test_seal_commits_to_a_truth_kept_elsewhere(tmp_path):
    sets, truth = tmp_path / "sets", tmp_path / "truth.json"
    commitment = seal(sets, truth, seed=3, sets=2, nulls=0, progress=lambda done, total: None)
    manifest = json.loads((sets / "manifest.json").read_text())
    assert hashlib.sha256(truth.read_bytes()).hexdigest() == commitment == manifest["truth_sha256"]
    opened = json.loads(truth.read_text())
    assert len(opened["salt"]) >= 32 and len(opened["sets"]) == 2 == len(manifest["sets"])
    beside = "".join(p.read_text() for p in sets.rglob("*.json"))
    assert "amplitude" not in beside and "category" not in beside
    with pytest.raises(BadInput, match="not empty"):
        seal(sets, tmp_path / "other.json", 3, 2, 0, lambda done, total: None)
    with pytest.raises(BadInput, match="exists already"):
        seal(tmp_path / "again", truth, 3, 2, 0, lambda done, total: None)
    with pytest.raises(BadInput, match="inside the sets"):
        seal(tmp_path / "again", tmp_path / "again" / "truth.json", 3, 2, 0, lambda done, total: None)


def test_files_look_the_same_with_and_without_an_effect(tmp_path):
    def look(spec: Spec, folder: Path) -> list:
        recordings, _ = make(spec, np.random.default_rng(5))
        write_set(folder, recordings)
        seen: list = []
        for path in sorted(folder.iterdir()):
            with h5py.File(path) as file:
                keys = {k: (np.shape(v), np.asarray(v).dtype.kind) for k, v in file.attrs.items()}
                data = {k: (d.shape, d.dtype) for k, d in file.items()}
                seen.append((path.name, keys, data))
        return seen

    plain = look(Spec("a", "null"), tmp_path / "plain")
    affected = look(Spec("a", "strong", (("row_noise", 4.0), ("prnu", 4.0))), tmp_path / "affected")
    assert plain == affected


def test_composition_has_the_stated_shares_and_decoys():
    specs = compose(np.random.default_rng(0), 400, 300)
    count = {c: sum(s.category == c for s in specs) for c in {s.category for s in specs}}
    assert count["null"] == count["strong"] == count["curve"] == 100
    assert count["double"] == 30 and count["adversarial"] == 30 and count["locate"] == 300
    assert count["unlisted"] + count["concealed"] == 40
    assert sum(SHARES.values()) == pytest.approx(1)
    asked = [s.category for s in specs if s.without]
    assert asked.count("null") == asked.count("concealed") == 20
    assert len({s.name for s in specs}) == 700


def test_concealing_takes_along_what_contains_it():
    assert {"row_noise", "row_pink_noise"} <= set(concealed_with("row_noise"))
    assert "dsnu" in concealed_with("row_fpn") and "row_fpn" not in concealed_with("dsnu")
