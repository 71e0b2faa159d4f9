"""What verbs are called with, refused in one line where it cannot be used."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.physics.core.ranges import BRIGHTEST, DARKEST, NOT_NORMALISED, check_key
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.metadata import check_fields
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording


def checked_capture(capture: Any) -> CaptureSet:
    """The capture set as given. Raises TypeError for anything else, BadInput for one without recordings,
    with some that hold no arrays, or images in DN, or of several cameras or colour orders."""
    if not isinstance(capture, CaptureSet):
        raise TypeError(
            f"capture is a {type(capture).__name__}: expected a CaptureSet, of load_capture_set(folder) or "
            "CaptureSet(camera, recordings)"
        )
    if isinstance(capture.recordings, Recording):
        raise TypeError("capture.recordings is a single Recording: give a tuple of recordings")
    odd = next((r for r in capture.recordings if not isinstance(r, Recording)), None)
    if odd is not None:
        raise TypeError(f"capture.recordings holds a {type(odd).__name__}: expected recordings alone")
    if not capture.recordings:
        raise BadInput(f"{capture.path or capture.camera}: holds no recordings")
    for recording in capture.recordings:
        check_fields(recording)
        _check_normalised(recording)
    place = capture.path or capture.camera
    for name, what in (("camera", "cameras"), ("cfa", "colour orders")):
        values = list(dict.fromkeys(str(getattr(r, name)) for r in capture.recordings))
        if len(values) > 1:
            raise BadInput(f"{place}: recordings of several {what} ({', '.join(values)}): give those of one")
    return capture


def check_one_size(capture: CaptureSet) -> None:
    """Raises BadInput for frames of several sizes, whose patterns cannot be held against one another."""
    sizes = list(dict.fromkeys(f"{h} x {w}" for h, w in (r.size for r in capture.recordings)))
    if len(sizes) > 1:
        place = capture.path or capture.camera
        raise BadInput(f"{place}: frames of several sizes ({', '.join(sizes)} pixels): give those of one")


def _check_normalised(recording: Recording) -> None:
    """Raises BadInput for a noise-free image in DN; single pixels may be dead, so its median tells."""
    clean: Any = recording.clean
    if clean is None or clean.ndim not in (2, 3) or 0 in clean.shape or clean.dtype.kind not in "fiu":
        return
    middle = float(median(np.asarray(clean if clean.ndim == 2 else clean[0])))
    if not DARKEST <= middle <= BRIGHTEST and np.isfinite(middle):
        place = recording.path or recording.camera
        raise BadInput(f"{place}: clean has median {middle:.4g}, {NOT_NORMALISED}")


def seed_of(key: jax.Array) -> int:
    """The number that makes the key (`jax.random.key`), or its words as one number where none does."""
    typed = jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
    words = np.asarray(jax.random.key_data(key) if typed else key)
    return int.from_bytes(words.astype(">u4").tobytes(), "big")


def checked_key(key: Any) -> jax.Array:
    """The key as given, `jax.random.key(0)` for None. Raises TypeError for what is no single key of JAX."""
    if key is None:
        return jax.random.key(0)
    check_key(key)
    return jnp.asarray(key)
