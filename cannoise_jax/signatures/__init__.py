"""The statistics kit: fields of noise, statistics of them and the laws by which they are judged. Knows no
mechanism."""
