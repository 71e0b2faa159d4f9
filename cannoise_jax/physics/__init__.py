"""Camera physics: the sensor model, its likelihood, photon transfer, and synthetic recordings."""
