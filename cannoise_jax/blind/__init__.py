"""Blind trials of discovery: hidden effects, the cameras made with them, and the score of what was found."""
