"""bin/bench profile: time of overlapping kernels counts once, kinds follow from names, the table adds up."""

from __future__ import annotations

import json

import jax
import pytest

from cannoise_jax.bench import profile as bench_profile
from cannoise_jax.bench.profile import IDLE, REST, Kernel, Profile, kind_of, shares
from cannoise_jax.commands import bench


def test_overlaps_count_once_and_gaps_are_idle():
    kernels = [
        Kernel("cudnn_conv_fprop_3", 0, 100),
        Kernel("loop_add_fusion_7", 50, 150),  # 50 of it beside the convolution
        Kernel("input_reduce_fusion.2", 200, 260),
        Kernel("loop_add_fusion_8", 210, 250),  # inside another
    ]
    kinds, longest = shares(kernels, calls=2)
    assert sum(kinds.values()) == pytest.approx(260e-9 / 2)
    assert kinds[IDLE] == pytest.approx(25e-9) and kinds[REST] == pytest.approx(25e-9)
    assert longest[0] == ("cudnn_conv_fprop", pytest.approx(50e-9), 0)
    assert {name: times for name, _, times in longest}["loop_add_fusion"] == 1


def test_no_kernel_takes_no_time():
    assert shares([], 1) == ({}, [])


@pytest.mark.parametrize(
    "name, kind",
    [
        ("sm90_xmma_fprop_implicit_gemm_tf32f32", "convolutions and matrix products"),
        ("void cudnn::ops::nchwToNhwcKernel<float>", "layouts, copies, padding"),
        ("wrapped_convert", REST),
        ("loop_multiply_fusion_12", REST),
        ("input_reduce_fusion_3", "reductions, among them those of norms"),
        ("MemcpyD2D", "layouts, copies, padding"),
    ],
)
def test_kinds_by_name(name, kind):
    assert kind_of(name) == kind


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="there is one here")
def test_refused_without_an_accelerator(capsys):
    assert bench.main(["profile"]) == 2
    assert bench.main(["profile", "--only", "nothing"]) == 2
    assert bench.main(["profile", "--calls", "0"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and "no GPU" in lines[0] and "step_paper_64" in lines[1]


def test_the_table(monkeypatch, tmp_path):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setenv("XLA_FLAGS", "")
    found = Profile(4e-3, {REST: 3e-3, IDLE: 1e-3}, [("loop_add_fusion", 3e-3, 5)])
    monkeypatch.setattr(bench_profile, "profile", lambda name, calls, say: found)
    out = tmp_path / "profile.json"
    assert bench.main(["profile", "--only", "step_default", "--out", str(out)]) == 0
    written = json.loads(out.read_text())
    assert written["rows"][0][1:] == [REST, "3.00", "75%"]
    assert written["values"]["step_default_no_kernel_runs"] == "25%"
