"""Discovery: where a simulator and recordings differ, what physics was left out, and the proof on new
frames."""

from cannoise_jax.discovery.diagnose import Diagnosis, diagnose
from cannoise_jax.discovery.search.limits import mde

__all__ = ["Diagnosis", "diagnose", "mde"]
