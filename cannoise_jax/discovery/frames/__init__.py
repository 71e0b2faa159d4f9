"""From frames to the statistics that signatures read: groups, contrasts, baseline, draws."""
