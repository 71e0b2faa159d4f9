"""Estimators: the parameters of a mechanism from recordings that show it, with errors.

Each takes the statistics of a camera's recordings (any kinds, it picks what it needs) and the baseline, and
returns estimates by parameter name, as the mechanism names them, or `NotMeasurable` with what to record.
"""
