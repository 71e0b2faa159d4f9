"""Photon transfer: gain, read noise and maps of a camera, and the estimators of its mechanisms."""
