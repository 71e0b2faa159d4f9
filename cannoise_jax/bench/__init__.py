"""Speeds of the networks side by side, and the same networks in PyTorch to compare with. Only bin/bench uses
it; nothing else of the package imports it, and PyTorch is imported in its own processes only."""
