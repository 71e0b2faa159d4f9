"""What the time of a step on an accelerator goes to: kernels by kind, from the profiler's own trace.

Every instant in which at least one kernel runs counts once, for the kernel that began first; what is left of
the time is idle. So the shares of a step add up to its length however many streams there are.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from cannoise_jax.bench.items import ITEMS

_LAYOUT = r"nchwtonhwc|nhwctonchw|tensortransform|copy|memcpy|transpose|pad|concatenate|slice"
_PRODUCT = r"conv(?!ert)|gemm|cudnn|cutlass|xmma|nvjet|wgrad|dgrad|implicit|winograd|sm\d\d_|dot"
KINDS: tuple[tuple[str, str], ...] = (
    # Libraries rearrange what their products then read; XLA names its own kernels after the operation.
    ("layouts, copies, padding", _LAYOUT),
    ("convolutions and matrix products", _PRODUCT),
    ("reductions, among them those of norms", r"reduce|norm|cub::|scan|sort"),
    ("random numbers", r"rng|random|threefry|bits"),
)
REST = "element by element"
IDLE = "no kernel runs"


class Kernel(NamedTuple):
    """One run of a kernel: name, and when it began and ended, ns."""

    name: str
    begun: float
    ended: float


class Profile(NamedTuple):
    """Seconds of one call: in all, by kind of kernel, and of the longest kernels with how often each ran."""

    seconds: float
    kinds: dict[str, float]
    longest: list[tuple[str, float, int]]


def kind_of(name: str) -> str:
    """Which of `KINDS` a kernel is, by its name."""
    return next((kind for kind, pattern in KINDS if re.search(pattern, name.lower())), REST)


def shares(kernels: Iterable[Kernel], calls: int) -> tuple[dict[str, float], list[tuple[str, float, int]]]:
    """Seconds a call by kind, time between kernels as `IDLE`, and the longest kernels, numbers in their names
    taken out."""
    spent: dict[str, float] = defaultdict(float)
    alone: dict[str, float] = defaultdict(float)
    times: Counter[str] = Counter()
    until = None
    for kernel in sorted(kernels, key=lambda k: (k.begun, k.ended)):
        if until is None:
            until = kernel.begun
        spent[IDLE] += max(0.0, kernel.begun - until)
        counted = max(0.0, kernel.ended - max(kernel.begun, until))
        spent[kind_of(kernel.name)] += counted
        name = re.sub(r"[._]\d+", "", kernel.name)
        alone[name] += counted
        times[name] += 1
        until = max(until, kernel.ended)
    of_a_call = {kind: ns * 1e-9 / calls for kind, ns in _most(spent)}
    longest = [(name, ns * 1e-9 / calls, times[name] // calls) for name, ns in _most(alone)[:20]]
    return of_a_call, longest


def _most(spent: dict[str, float]) -> list[tuple[str, float]]:
    return sorted(spent.items(), key=lambda one: -one[1])


def kernels_in(folder: Path) -> list[Kernel]:
    """What ran on the device, from a folder that `jax.profiler.trace` wrote. Empty where it saw no device."""
    from jax.profiler import ProfileData

    found = []
    for path in folder.rglob("*.xplane.pb"):
        for plane in ProfileData.from_file(str(path)).planes:
            if not re.match(r"/device:(GPU|TPU|CUDA|ROCM)", plane.name, re.IGNORECASE):
                continue
            for line in plane.lines:
                if line.name is None or not line.name.startswith("Stream"):
                    continue  # lines that the profiler derives say the same again
                found += [Kernel(e.name, e.start_ns, e.end_ns) for e in line.events]
    return found


def profile(name: str, calls: int, say: Callable[[str], None] = lambda line: None) -> Profile:
    """One of `ITEMS`, calls in a row after warming up. Raises RuntimeError where no kernel is seen."""
    import jax

    from cannoise_jax.bench.worker import ours

    with tempfile.TemporaryDirectory(prefix="cannoise-bench-") as place:
        call: Callable[[int], Any]
        call, started = ours(ITEMS[name], Path(place) / "weights.npz")
        say(f"{name}: first call {started['first']:.1f} s")
        call(2)
        begun = time.perf_counter()
        call(calls)
        plain = (time.perf_counter() - begun) / calls
        with jax.profiler.trace(place):
            call(calls)
        found = kernels_in(Path(place))
    if not found:
        raise RuntimeError(f"{name}: the profiler saw no kernel")
    kinds, longest = shares(found, calls)
    say(f"{name}: {1e3 * plain:.2f} ms a call, {1e3 * sum(kinds.values()):.2f} ms under the profiler")
    return Profile(plain, kinds, longest)
