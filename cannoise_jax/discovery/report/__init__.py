"""What is written of a diagnosis: the document, cards, wording, pictures, the page."""

FILES = ("report.json", "report.html", "sensor.json")
"""Here, where nothing else is imported: a command refuses to replace them before it waits for JAX."""
