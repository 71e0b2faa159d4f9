"""Camera physics: mechanisms of noise, the sensor model, its estimators, likelihood and photon transfer."""
