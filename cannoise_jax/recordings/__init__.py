"""Files in, arrays out."""

from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording

__all__ = ["BadInput", "CaptureSet", "Recording"]
