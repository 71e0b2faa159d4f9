"""How close synthetic noise is to recorded noise: divergences, baselines, tables, figures."""
