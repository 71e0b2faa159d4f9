"""One thin module per command in `bin/`: parse flags, call one function, print."""
