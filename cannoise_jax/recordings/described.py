"""Arrays with a description in JSON as one NPZ file, sealed by a hash of both: trained models, denoisers.

The checksums of the ZIP format tell of flipped bits. The hash tells of what was written anew with other
contents, which is then no longer what was trained.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cannoise_jax.recordings.atomic import file_in_place
from cannoise_jax.recordings.opened import json_of

_DESCRIPTION, _SEAL = "description", "sha256"


class Described(NamedTuple):
    """What a file holds. sealed: whether its hash says that it is as it was written; files of before there
    was one have none."""

    description: dict[str, Any]
    arrays: dict[str, np.ndarray]
    sealed: bool


def write_described(path: str | Path, description: Mapping[str, Any], arrays: Mapping[str, Any]) -> None:
    """Writes the file, complete or not at all. Raises BadInput when it cannot be written."""
    plain = {name: np.asarray(value) for name, value in arrays.items()}
    stated = dict(description)
    text = json.dumps(stated | {_SEAL: _digest(stated, plain)})
    content = io.BytesIO()
    np.savez(content, **{_DESCRIPTION: np.array(text)}, **plain)  # type: ignore[arg-type]
    with file_in_place(Path(path)) as file:
        file.write(content.getbuffer())


def read_described(path: Path) -> Described:
    """What `write_described` wrote; nothing is unpickled.

    Raises ValueError where it is not as it was written or holds what is no number, and what NumPy raises over
    damaged files (`opened.BROKEN_ARRAYS`, KeyError, RecursionError).
    """
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    description = json_of(str(arrays.pop(_DESCRIPTION)))
    if not isinstance(description, dict):
        raise ValueError(_DESCRIPTION)
    seal = description.pop(_SEAL, None)
    if seal is not None and seal != _digest(description, arrays):
        raise ValueError(_SEAL)
    for name, value in arrays.items():
        if not (value.dtype.kind in "fiu" and np.isfinite(value).all()):
            raise ValueError(name)
    return Described(description, arrays, seal is not None)


def _digest(description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    whole = hashlib.sha256(json.dumps(description, sort_keys=True).encode())
    for name in sorted(arrays):
        value = np.ascontiguousarray(arrays[name])
        whole.update(f"{name} {value.dtype.str} {value.shape}".encode())
        whole.update(value.tobytes())
    return whole.hexdigest()
