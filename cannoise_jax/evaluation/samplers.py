"""A trained model as evaluation takes it: a function of a key, clean patches, references and levels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class Samplers(NamedTuple):
    """A model as `evaluation` takes it, `(key, clean, reference, shot, read) -> noise`, in two ways of use.

    usual: the level as most users have it: off the references, unless the model was trained without.
    given: the level that is handed over; None where the model was trained without.
    """

    usual: Any
    given: Any


class ByCamera(NamedTuple):
    """A sampler that is also told the camera's index of every patch: `sample(..., camera)`."""

    sample: Callable[..., Any]


def samplers(level: str, sample: Callable[..., Any], by_camera: bool = False) -> Samplers:
    """Both from `sample(key, clean, reference, nlf) -> noise` of a model of this `Model.level`; by_camera:
    from `sample(key, clean, reference, nlf, camera)`, for `ByCamera`."""

    def given(key, clean, reference, shot, read, *camera):
        return sample(key, clean, reference, (shot, read), *camera)

    def estimated(key, clean, reference, shot, read, *camera):
        return sample(key, clean, reference, None, *camera)

    made = [ByCamera(f) if by_camera else f for f in (given, estimated)]
    return Samplers(made[level != "given"], None if level == "estimated" else made[0])
