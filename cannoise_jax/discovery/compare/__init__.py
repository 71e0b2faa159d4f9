"""Compare: recordings against what a simulator draws at equal settings, statistic by statistic, before any
cause is named. Two-sided: too little and too much are told apart."""

from cannoise_jax.discovery.compare.report import Comparison, compare, document
from cannoise_jax.discovery.compare.score import Better, better
from cannoise_jax.discovery.compare.table import Difference

__all__ = ["Better", "Comparison", "Difference", "better", "compare", "document"]
