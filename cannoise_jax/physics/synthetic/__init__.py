"""Recordings with known truth: virtual cameras, computed scenes, real darks under computed light."""
