"""The vocabulary is complete, consistent, and imports nothing."""

import ast
from pathlib import Path

import pytest

from cannoise_jax import vocabulary
from cannoise_jax.vocabulary import CLASSES, VOCABULARY, Term, contains, core_ids, of_kind

CORE_SENSOR = (
    "gain_error read_noise_error prnu dsnu column_gain nonlinearity saturation black_clipping crosstalk"
    " dark_current amp_glow hot_pixels heavy_tails pixel_read_noise_map rts row_noise column_noise row_fpn"
    " column_fpn pink_noise row_pink_noise banding offset_drift channel_offset amplifier_mismatch"
    " green_imbalance quantization missing_codes in_camera_denoising"
)


def test_core_sensor_mechanisms():
    assert " ".join(of_kind("sensor", core=True)) == CORE_SENSOR
    others = {"flicker", "illumination_drift", "reference_error", "bookkeeping"}
    assert set(core_ids()) == {*CORE_SENSOR.split(), *others}


def test_classes_partition_the_ids():
    ids = [i for kind in CLASSES for i in of_kind(kind)]
    assert sorted(ids) == sorted(VOCABULARY)
    assert of_kind("unknown") == ("unknown",)


@pytest.mark.parametrize("term", VOCABULARY.values(), ids=lambda t: t.id)
def test_entry_is_well_formed(term: Term):
    assert term.id.islower() and term.definition.endswith(".") and "\n" not in term.definition
    assert term.amplitude and term.unit
    assert term.entry is None or 1 <= term.entry <= 50
    for outer in term.within:
        assert outer in VOCABULARY and not contains(term.id, outer), "containment must be without cycles"


def test_amplitude_units_follow_the_scaling():
    for additive in ("row_noise", "column_noise", "dsnu", "row_fpn", "pink_noise", "offset_drift", "rts"):
        assert VOCABULARY[additive].unit == "DN" and "rms" in VOCABULARY[additive].amplitude
    for sinusoid in ("banding", "flicker"):
        assert "peak" in VOCABULARY[sinusoid].amplitude
    for multiplicative in ("prnu", "column_gain", "illumination_drift"):
        assert VOCABULARY[multiplicative].unit == "1" and "rms" in VOCABULARY[multiplicative].amplitude


def test_contains():
    assert contains("row_pink_noise", "row_noise") and not contains("row_noise", "row_pink_noise")
    assert contains("prnu", "column_gain") and contains("dsnu", "dsnu")
    assert not contains("heavy_tails", "rts")


def test_imports_nothing_of_the_package():
    tree = ast.parse(Path(vocabulary.__file__).read_text())
    names = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    names |= {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert names <= {"__future__", "dataclasses", "typing"}
