"""Mechanisms of noise, one file a family."""
