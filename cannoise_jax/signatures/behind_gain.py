"""What is added behind the gain of a camera: the same number of codes at every gain setting.

Fields are in DN of the lowest gain setting, in which what comes before the gain has one strength. What comes
behind it has one strength in DN of each recording.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from cannoise_jax.physics.core.mechanism import Scaling
from cannoise_jax.signatures.fields import Fields, native, referred
from cannoise_jax.signatures.handed import Addition, Found, Many, Predicted, Series
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import NO_CLOSED_FORM, Signature

BEHIND = "_behind_gain"
"""End of the name of a signature of what another one finds before the gain."""
AT_EVERY_GAIN = Scaling()
"""Codes that no setting changes."""


def behind(signature: Signature) -> Signature:
    """The signature of what is redrawn in every frame, in DN of each recording. Strengths are in DN of it."""

    def again(fields: Many, found: Score) -> Score | None:
        return signature.score_again(_native(fields), found)

    def absorb(fields: Many, score: Score) -> Many:
        left = signature.absorb(_native(fields), score)
        return tuple(referred(g, f.unit) for f, g in zip(fields, left, strict=True))

    def predict(fields: Many, score: Score) -> Predicted | None:
        found = signature.predict(_native(fields), score)
        return None if found is None else found._replace(scaling="codes")

    def series(field: Fields, score: Score) -> Series | None:
        return signature.series(native(field), score)

    return dataclasses.replace(
        signature,
        name=signature.name + BEHIND,
        axes=dataclasses.replace(signature.axes, scales="codes"),
        score=lambda fields: signature.score(_native(fields)),
        again=again,
        absorb=absorb,
        predict=predict,
        series=series,
        simulate=behind_gain(signature.simulate),
        place=behind_gain(signature.place),
        least=NO_CLOSED_FORM,
        control=False,
    )


def behind_gain(adds: Callable[[Found], Addition | None]) -> Callable[[Found], Addition | None]:
    """What a finding adds to a camera model, the same at every gain setting."""

    def added(found: Found) -> Addition | None:
        more = adds(found._replace(fields=_native(found.fields)))
        return None if more is None else more._replace(scaling=AT_EVERY_GAIN)

    return added


def _native(fields: Many) -> Many:
    return tuple(native(f) for f in fields)
