"""The statistics kit: what is measured of fields of noise before anything is named, and the laws by which two
sources of frames are told apart. Knows no mechanism."""
