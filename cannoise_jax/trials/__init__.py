"""Studies of the whole analysis: concealed effects, size, real recordings, what takes the truth to know."""
