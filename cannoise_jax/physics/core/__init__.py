"""The sensor model: what a mechanism is, the grammar, the signal chain, settings, presets, `sensor.json`."""
