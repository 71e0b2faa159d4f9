"""bin/denoise test: every denoiser of a workdir on the same held-out darks, as a table and a record."""

from __future__ import annotations

import importlib.metadata
import json
import shlex
import time
from typing import Any

from cannoise_jax.commands.denoise_kept import capture_of, check_alike, check_recordings
from cannoise_jax.commands.denoise_sources import said_of, slug, verdicts_of
from cannoise_jax.commands.outputs import check_file
from cannoise_jax.commands.parser import overrides
from cannoise_jax.recordings.atomic import texts_in_place
from cannoise_jax.recordings.recording import BadInput

ORDER = ("gaussian", "pg", "calibrated", "discovered", "ours_on_discovered", "real_darks")
"""As the noise models are expected: each no worse than the one before."""


def judge(arguments, argv) -> None:
    """Every denoiser of the workdir on the held-out darks; writes denoising.json and prints a table."""
    import jax
    import numpy as np

    from cannoise_jax.evaluation.denoising import in_order, psnr, ssim, summary
    from cannoise_jax.recordings.packing import pack
    from cannoise_jax.training.denoise import denoised, load_denoiser
    from cannoise_jax.training.denoise_data import dim_scenes, half_real, held_out_images, stamp

    started = time.monotonic()
    every = {p: load_denoiser(p) for p in sorted((arguments.workdir / "denoisers").glob("*/*.npz"))}
    capture = capture_of(arguments.recordings, overrides(arguments))
    path = arguments.workdir / f"denoising_{slug(capture.camera)}.json"
    found = {p: d for p, d in every.items() if d.about["camera"] == capture.camera}
    if not found:
        raise BadInput(f"{arguments.workdir}: no denoiser for {capture.camera}: bin/denoise train makes them")
    check_file(path, ".json", arguments.force)
    check_recordings(found, stamp(capture))
    exposures = sorted({d.about["exposure_s"] for d in found.values()})
    tables = {e: {p: d for p, d in found.items() if d.about["exposure_s"] == e} for e in exposures}
    for table in tables.values():
        check_alike(table)
    out: dict[str, Any] = {}
    for exposure, table in tables.items():
        own = list(table.values())
        data = half_real(capture, exposure, own[0].about["full_scale_e"])
        clean = dim_scenes(jax.random.key(2), "test", arguments.scenes, data.test.shape[1:], data.cfa)
        noisy = held_out_images(data, clean, jax.random.key(3))
        truth, shown = (pack(np.asarray(x, np.float32), data.cfa) for x in (clean, noisy))
        made: dict[str, dict[str, dict[int, list[float]]]] = {"psnr_db": {}, "ssim": {}}
        for d in own:
            images = denoised(d, shown)
            for metric, function in (("psnr_db", psnr), ("ssim", ssim)):
                rows = made[metric].setdefault(d.about["noise"], {})
                rows[d.about["seed"]] = [function(t, i) for t, i in zip(truth, images, strict=True)]
        seeds = sorted(set.intersection(*(set(rows) for rows in made["psnr_db"].values())))
        if not seeds:
            raise BadInput(f"{arguments.workdir}: no seed is there for all noise models: train the rest")
        result: dict[str, Any] = {
            "seeds": len(seeds),
            "scenes": arguments.scenes,
            "steps": own[0].recipe.steps,
        }
        result["test_frames"] = len(data.test)
        result["noisy"] = {
            "psnr_db": float(np.mean([psnr(t, i) for t, i in zip(truth, shown, strict=True)])),
            "ssim": float(np.mean([ssim(t, i) for t, i in zip(truth, shown, strict=True)])),
        }
        for metric, by_noise in made.items():
            numbers = {name: np.array([rows[s] for s in seeds]) for name, rows in by_noise.items()}
            result[metric] = summary(numbers, "pg", "real_darks")
            result[f"{metric}_order"] = in_order(numbers, ORDER)
        result["seconds_of_training"] = {
            name: round(float(np.mean([d.about["seconds"] for d in own if d.about["noise"] == name])), 1)
            for name in made["psnr_db"]
        }
        result["learned_part"] = verdicts_of(arguments.workdir, capture.camera, exposure, made["psnr_db"])
        out[f"{exposure:g}"] = result
        print(_table(f"{capture.camera}, {exposure:g} s", result), flush=True)
    record = {
        "schema": "cannoise/denoising/1", "camera": capture.camera, "exposures_s": out,
        "command": f"bin/denoise {shlex.join(argv)}", "version": importlib.metadata.version("cannoise-jax"),
        "interval": "90 %, seeds and scenes drawn again", "seconds": round(time.monotonic() - started, 1),
    }  # fmt: skip
    with texts_in_place({path: json.dumps(record, indent=1, allow_nan=False) + "\n"}):
        print(path)


def _table(title: str, result: dict[str, Any]) -> str:
    """PSNR and SSIM by noise model, with what each gains over PG."""
    lines = [
        f"{title}: {result['seeds']} seeds, {result['scenes']} test scenes, {result['steps']} steps; noisy "
        f"{result['noisy']['psnr_db']:.2f} dB",
        f"{'trained on':<26}{'PSNR dB':>9}{'over pg [90 %]':>26}{'gap':>7}{'SSIM':>8}{'over pg [90 %]':>28}",
    ]
    for name, row in sorted(result["psnr_db"].items(), key=lambda item: item[1]["mean"]["value"]):
        other = result["ssim"][name]
        gap = f"{row['gap_closed']:.0%}" if "gap_closed" in row else "-"
        lines.append(
            f"{name:<26}{row['mean']['value']:>9.2f}{_gain(row, 2):>26}{gap:>7}"
            f"{other['mean']['value']:>8.4f}{_gain(other, 4):>28}"
        )
    for step in result["psnr_db_order"]:
        lines.append(f"  {step['upper']} against {step['lower']}: {step['outcome']}")
    lines += [f"  {name}: {said_of(verdict)}" for name, verdict in result["learned_part"].items()]
    return "\n".join(lines) + "\n"


def _gain(row: dict[str, Any], digits: int) -> str:
    if "over_pg" not in row:
        return "-"
    value, low, high = (row["over_pg"][k] for k in ("value", "low", "high"))
    return f"{value:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"
