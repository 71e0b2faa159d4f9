"""Camera-aware raw noise in JAX: learn it, simulate it, and find what a simulator leaves out.

The names below are the public face. Each is imported when it is first used, so that reading a file does not
wait for JAX.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cannoise_jax.exports import on_first_use
from cannoise_jax.physics.core import home

if TYPE_CHECKING:
    from cannoise_jax.discovery.diagnose import diagnose
    from cannoise_jax.model_file import load_model
    from cannoise_jax.physics.core.sensor import SensorModel, Settings
    from cannoise_jax.recordings.load import load_capture_set
    from cannoise_jax.recordings.packing import pack, unpack
    from cannoise_jax.recordings.recording import CaptureSet, Recording
    from cannoise_jax.sampling import sample_noise

_HOMES = {
    "CaptureSet": "recordings.recording",
    "Recording": "recordings.recording",
    "SensorModel": "physics.core.sensor",
    "Settings": "physics.core.sensor",
    "diagnose": "discovery.diagnose",
    "load_capture_set": "recordings.load",
    "load_model": "model_file",
    "pack": "recordings.packing",
    "sample_noise": "sampling",
    "unpack": "recordings.packing",
}

__all__ = [
    "CaptureSet",
    "Recording",
    "SensorModel",
    "Settings",
    "diagnose",
    "load_capture_set",
    "load_model",
    "pack",
    "sample_noise",
    "unpack",
]

home.tell(lambda: on_first_use(__name__, {"RECORDS": "mechanisms"}, "RECORDS"))


def __getattr__(name: str) -> Any:
    return on_first_use(__name__, _HOMES, name)


def __dir__() -> list[str]:
    return __all__
