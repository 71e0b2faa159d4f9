"""The likelihood of stored codes under a camera model."""
