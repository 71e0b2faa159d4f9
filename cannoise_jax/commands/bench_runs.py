"""What bin/bench runs: timings beside other simulators, and accuracies against brute force."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from cannoise_jax.bench.side_by_side import load
from cannoise_jax.commands.outputs import check_file
from cannoise_jax.mechanisms import LISTED
from cannoise_jax.mechanisms.coverage import coverage, format_rows
from cannoise_jax.mechanisms.peers import GETFRAMES, TOGETHER
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.recordings.atomic import new_folder, texts_in_place
from cannoise_jax.recordings.recording import BadInput

GAIN, READ_E, BLACK, WHITE = 0.8, 2.5, 200.0, 4095.0
"""The camera of the speed comparison: DN/e-, e-, DN, DN (12 bit)."""
EXPOSURE_S = 1.0
CODE = ("cannoise_jax/physics", "cannoise_jax/mechanisms")
"""What the tables depend on."""


SPEEDS = ("effects", "side, px", "signal, e-", "Mpx/s", "ratio to getframes")
COVERED = ("mechanism", "parameter", "truth", "covered, %")


class Speed(NamedTuple):
    """Best megapixels per second; peer: getframes as its manual shows, fast: in float32 with its buffers
    reused."""

    effects: str
    side: int
    electrons: float
    ours: float
    peer: float | None
    fast: float | None

    @property
    def ratio(self) -> float:
        """To the faster of the peer's two ways; nan without it."""
        return np.nan if self.peer is None or self.fast is None else self.ours / max(self.peer, self.fast)

    @property
    def cells(self) -> tuple[str, ...]:
        """A row of the table."""
        sides = (str(self.side), f"{self.electrons:g}", f"{self.ours:.1f}")
        return (self.effects, *sides, "" if np.isnan(self.ratio) else f"{self.ratio:.2f}")


MOST_SIDE = 16384
"""Pixels; frames of more would not fit the memory."""


def run_simulate(arguments: argparse.Namespace) -> None:
    """Speed of the simulator beside others."""
    if not 2 <= min(arguments.sizes) <= max(arguments.sizes) <= MOST_SIDE:
        raise BadInput(f"simulate: sizes from 2 to {MOST_SIDE}")
    if arguments.frames < 1 or arguments.repeats < 1:
        raise BadInput("simulate: frames and repeats from 1")
    check_table(arguments)
    if not all(0 <= e * GAIN < WHITE - BLACK for e in arguments.electrons):
        raise BadInput(f"simulate: --electrons from 0 to {(WHITE - BLACK) / GAIN:g}, the white level")
    print(f"{jax.default_backend()}, {os.cpu_count()} cores, load {load():.1f}; best of {arguments.repeats}")
    print(f"calls of {arguments.frames} frames, taken in turn; one warm-up call each is not counted; Mpx/s.")
    print(f"{'effects':<34}{'side':>6}{'e-':>7}{'ours':>9}{'getframes':>11}{'its float32':>13}{'ratio':>8}")
    # One size tells what a single effect costs; the sums are timed at all.
    single = [side for side in arguments.sizes if side <= 1024][-1:] or arguments.sizes[:1]
    measured = []
    plan = [((), arguments.sizes), *(((e,), single) for e in GETFRAMES), (TOGETHER, arguments.sizes)]
    for effects, sizes in plan:
        for side in sizes:
            for electrons in arguments.electrons:
                s = speed(effects, side, electrons, arguments.frames, arguments.repeats)
                measured.append(s)
                line = f"{s.effects:<34}{s.side:>6}{s.electrons:>7g}{s.ours:>9.1f}"
                if s.peer is None or s.fast is None:
                    print(line + "   getframes is not installed: pip install 'cannoise-jax[peers]'")
                else:
                    print(f"{line}{s.peer:>11.1f}{s.fast:>13.1f}{s.ours / max(s.peer, s.fast):>8.2f}")
    print("ratio: ours over the faster of getframes' two ways.")
    write_table(
        arguments, SPEEDS, [s.cells for s in measured], {"lowest": f"{min(s.ratio for s in measured):.2f}"}
    )


def speed(effects: tuple[str, ...], side: int, electrons: float, frames: int, repeats: int) -> Speed:
    """Times both simulators on one flat scene: shot noise, read noise, rounding, clipping, and `effects`."""
    calls = [_our_call(side, electrons, frames, effects), *_peer_calls(side, electrons, frames, effects)]
    best = [np.inf] * len(calls)
    for call in calls:
        call(0)
    for repeat in range(repeats):
        for i, call in enumerate(calls):
            start = time.perf_counter()
            call(repeat + 1)
            best[i] = min(best[i], time.perf_counter() - start)
    rates = [frames * side * side / 1e6 / b for b in best]
    name = "+ " + ", ".join(effects) if effects else "shot, read, rounding, clipping"
    return Speed(name, side, electrons, rates[0], *(rates[1:] or (None, None)))


def our_model(side: int, effects: tuple[str, ...] = ()) -> SensorModel:
    """The camera of the comparison with some of `GETFRAMES`, its maps drawn once."""
    model = SensorModel.poisson_gaussian(GAIN, READ_E, BLACK, WHITE, "MONO")
    mechanisms: dict[str, dict[str, float]] = {}
    for effect in effects:
        mechanisms |= GETFRAMES[effect][0]
    for id, parameters in mechanisms.items():
        model = model.with_mechanism(id, **parameters)  # type: ignore[arg-type]
    return model.with_maps((side, side)) if effects else model


def _our_call(side: int, electrons: float, frames: int, effects: tuple[str, ...]) -> Callable[[int], object]:
    model = our_model(side, effects)
    clean = jax.numpy.full((side, side), electrons * GAIN / (WHITE - BLACK), jax.numpy.float32)
    settings = Settings(iso=100.0, exposure_s=EXPOSURE_S, frames=frames)
    return lambda seed: np.asarray(model.sample(jax.random.key(seed), clean, settings))


def peer_config(side: int, effects: tuple[str, ...] = ()):
    """The same camera for getframes; None where that package is not installed."""
    try:
        import getframes
    except ImportError:
        return None
    options: dict[str, Any] = {}
    for effect in effects:
        options |= GETFRAMES[effect][1]
    return getframes.CameraConfig(
        name="comparison",
        sensor_type=getframes.SensorType.CMOS,
        resolution=(side, side),
        pixel_size_um=3.0,
        quantum_efficiency=1.0,
        full_well_e=1e6,
        bit_depth=12,
        gain_e_per_adu=1 / GAIN,
        bias_offset_adu=BLACK,
        read_noise_e=READ_E,
        **{"dark_current_e_per_s": 0.0, **options},
    )


def _peer_calls(
    side: int, electrons: float, frames: int, effects: tuple[str, ...]
) -> list[Callable[[int], object]]:
    config = peer_config(side, effects)
    if config is None:
        return []
    import getframes

    rate = np.full((side, side), electrons / EXPOSURE_S)
    plain = getframes.Camera(config, seed=0)
    quick = getframes.Camera(config, seed=0, precision="float32")
    scratch, out = getframes.DetectorWorkspace(), np.empty((side, side), np.uint32)

    def by_manual(seed: int):
        return [plain.expose(rate, EXPOSURE_S).data for _ in range(frames)]

    def reusing(seed: int):
        for _ in range(frames):
            quick.expose(rate, EXPOSURE_S, include_truth=False, workspace=scratch, out=out)

    return [by_manual, reusing]


def run_coverage(arguments: argparse.Namespace) -> None:
    """Coverage of the intervals of the estimators."""
    known = {entry.id for entry in LISTED if entry.examples.cases}
    wanted = set(arguments.mechanisms or known)
    if wanted - known:
        raise BadInput(
            f"coverage: no case for {', '.join(sorted(wanted - known))}; known: {', '.join(sorted(known))}"
        )
    if arguments.simulations < 1:
        raise BadInput("coverage: --simulations from 1")
    check_table(arguments)
    rows = []
    for entry in (e for e in LISTED if e.id in wanted):
        for case in entry.examples.cases:
            rows += coverage(entry, case, arguments.simulations, arguments.seed)
            print(f"{entry.id} {case.note}", file=sys.stderr, flush=True)
    print(format_rows(rows))
    shares = [100 * r.coverage for r in rows if not r.exact]
    cells = [
        (
            r.mechanism.replace("_", " "),
            r.parameter.replace("_", " "),
            f"{r.truth:g}",
            f"{100 * r.coverage:.1f}",
        )
        for r in rows
    ]
    n = arguments.simulations
    values = {"simulations": str(n), "standard_error": f"{100 * (0.9 * 0.1 / n) ** 0.5:.1f}"}
    if shares:
        values |= {"lowest": f"{min(shares):.1f}", "highest": f"{max(shares):.1f}"}
    write_table(arguments, COVERED, cells, values)


def run_train(arguments: argparse.Namespace) -> None:
    """Speed of training here."""
    if min(arguments.batch, arguments.steps) < 1 or arguments.patch % 16 or not 16 <= arguments.patch <= 1024:
        raise BadInput("train: --batch and --steps from 1, --patch a multiple of 16 up to 1024")
    rate = train_speed(arguments.width, arguments.batch, arguments.patch, arguments.steps)
    side = arguments.patch
    print(
        f"{rate:.1f} patches of {side} x {side} x 4 per second: width {arguments.width:g}, "
        f"batch {arguments.batch}, {jax.default_backend()}, {os.cpu_count()} cores, load {load():.1f}"
    )


def train_speed(width: float, batch: int, patch: int, steps: int) -> float:
    """Patches per second of the training step of configs/default.py; two steps before are not timed."""
    from cannoise_jax.commands import train
    from cannoise_jax.training.state import init_state
    from cannoise_jax.training.step import make_train_step

    config = train.default_config()
    config.update({"width": width, "batch_size": batch, "patch": patch})
    rng = np.random.default_rng(0)
    names = ("clean", "noisy", "anchor", "positive", "negative")
    shape = (batch, patch, patch, 4)
    data: dict[str, np.ndarray] = {name: rng.uniform(0, 1, shape).astype(np.float32) for name in names}
    data |= {name: np.full((batch, 4), 1e-3, np.float32) for name in ("shot", "read")}
    data["camera"] = np.arange(batch, dtype=np.int32) % 2
    state, step = init_state(config, 2), make_train_step(config, cameras=2)
    for _ in range(2):
        state, _ = step(state, data)
    jax.block_until_ready(state)
    start = time.perf_counter()
    for _ in range(steps):
        state, _ = step(state, data)
    jax.block_until_ready(state)
    return steps * batch / (time.perf_counter() - start)


def check_table(arguments: argparse.Namespace) -> None:
    """Raises BadInput, before the work, where the table could not be written."""
    if arguments.out is not None:
        check_file(arguments.out, ".json", arguments.force)


def write_table(
    arguments: argparse.Namespace,
    columns: tuple[str, ...],
    rows: Sequence[tuple[str, ...]],
    values: dict[str, str],
    code: Sequence[str] = CODE,
    machine: str | None = None,
) -> None:
    """The table as `bin/bench docs --take` reads it, where --out names a file. code: what it depends on.
    machine: where it was measured, if it may be taken elsewhere."""
    if arguments.out is not None:
        table = {"columns": columns, "rows": rows, "values": values, "code": code}
        table |= {"machine": machine} if machine else {}
        text = json.dumps(table, indent=1, ensure_ascii=False) + "\n"
        with new_folder(arguments.out.parent), texts_in_place({arguments.out: text}):
            pass
